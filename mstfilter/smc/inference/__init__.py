"""What is computed from runs of a filter: the past, the parameters of a model, and how far to trust an estimate.

`smoothing`    states given all observations
`conditional`  one path of states at a time, by conditional SMC
`metropolis`   Metropolis-Hastings kernels, and moves of particles by them
`parameters`   parameters of a model: PMMH, particle Gibbs, emcee
`diagnostics`  variance of estimates from a single run, distances between populations

All public names are imported from `mstfilter.smc`.
"""
