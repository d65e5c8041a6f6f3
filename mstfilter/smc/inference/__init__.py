"""What is computed from runs of a filter: the past, the parameters of a model, and how far to trust an estimate.

`smoothing`    states given all observations: genealogy, fixed lag, backward sampling
`two_filter`   the same by a second filter that runs backwards
`additive`     smoothed sums while the observations arrive (PaRIS)
`conditional`  one path of states at a time, by conditional SMC
`metropolis`   Metropolis-Hastings kernels, and moves of particles by them
`parameters`   parameters of a model: PMMH, particle Gibbs, emcee
`samplers`     parameters by SMC: tempering, and observation by observation (IBIS)
`smc2`         parameters and states together, observation by observation (SMC^2)
`diagnostics`  variance of estimates from a single run, distances between populations

All public names are imported from `mstfilter.smc`.
"""
