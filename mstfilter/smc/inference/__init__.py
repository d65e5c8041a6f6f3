"""What is computed from runs of a filter: the past, the parameters of a model, and how far to trust an estimate.

>>> import numpy as np
>>> from mstfilter.smc import Dynamics, Normal, StateSpaceModel, Uniform, backward_paths, bootstrap, keep, pmmh
>>> def filter_of(theta):
...     move = lambda x: Normal(theta["rho"] * x, 0.5)
...     return bootstrap(StateSpaceModel.of(Normal(0.0, 1.0), move, lambda x: Normal(x, 1.0)), n=100)
>>> ys = [0.3, -0.1, 0.8, 1.2]
>>> chains = pmmh(filter_of, ys, {"rho": Uniform(-1.0, 1.0)}, scale={"rho": 0.5}, n_iterations=20)     # parameters
>>> filter = filter_of({"rho": 0.9})
>>> model = filter.transition.model
>>> paths = backward_paths(np.random.default_rng(0), keep(filter, ys), Dynamics(model), n=50)          # the past

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
