"""Models of number particles, and the filters that a model has.

A model says how the state moves, x_t ~ f(x_t | x_{t-1}), and how it is seen, y_t ~ p(y_t | x_t). It simulates data,
and filters are made from it:

>>> from mstfilter.smc import Normal, StateSpaceModel, bootstrap
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> states, observations = model.simulate(50, seed=1)
>>> state, infos = bootstrap(model, n=1000).run(observations, seed=0)

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
