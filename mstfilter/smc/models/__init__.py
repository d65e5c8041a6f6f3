"""Models of number particles, and the filters that a model has.

`state_space`    a model from densities or functions; bootstrap, guided and auxiliary filters
`programs`       the same filters for a model written as a probabilistic program
`simulation`     states and observations drawn from a model, to try a filter on
`distributions`  what models are made of; any distribution of scipy.stats fits in, too
`families`       Gamma, LogNormal, Beta, Dirichlet, Poisson, Binomial, VonMises
`combined`       mixtures, truncated distributions, products of independent ones
`exact`          linear-Gaussian and finite models, whose posterior is known
`gaussian`       models with Gaussian noise: UKF proposals, Rao-Blackwellised filters
`quasi`          Sobol points in place of random numbers (SQMC)

All public names are imported from `mstfilter.smc`.
"""
