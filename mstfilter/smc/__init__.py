"""Particle filters for any kind of particle. The package does not depend on images or voxels.

>>> from mstfilter.smc import EssBelow, ParticleFilter, Reweight, Systematic, bootstrap, linear_gaussian
>>> filter = bootstrap(model, n=1000)                                   # a textbook filter
>>> filter = ParticleFilter(initial=prior, transition=move, update=Reweight(log_likelihood),
...                         resampler=Systematic(), trigger=EssBelow(), n=1000)
>>> state, infos = filter.run(observations, seed=0)
>>> state.population.particles, state.population.weights, state.log_evidence

======================  ===================================================================================
`filter`                `ParticleFilter`; `ParticleFilter.step` is one step of the filter
`interfaces`            base classes of components (`Transition`, `Proposal`, `Update`, `Resampler`, ...),
                        `State` and `Info`
`inputs`                time and inputs of models: `WithInput`, an observation with an input
`population`            `Population`: particles, log weights, parents; `Candidates`, particles built on access
`resampling`            schemes that need only weights, with equal output weights
`diverse_resampling`    schemes that keep more distinct particles, with unequal weights
`wrapped_resampling`    wrappers of schemes: sorted, shuffled, merged, tempered
`components`            update by a likelihood, branching, triggers, sizes, equality of particles
`streams`               random streams named by seed, step, slot and index
`history`               collectors: quantities of a run, recorded at every step
`running`               `run_many`: several filters, seeds and data sets
`sweep`                 many runs of a filter at once, as arrays
`first_steps`           examines the functions of a model at the first steps of a run
`checkpoint`            storage of the state of a run in a file
`state_space`           state-space models; bootstrap, guided, auxiliary and resample-move filters
`exact`                 linear-Gaussian and finite models with exact posteriors
`gaussian`              models with Gaussian noise; UKF proposals, Rao-Blackwellised filters
`programs`              filters for probabilistic programs
`distributions`         distributions for models; an adapter for those of scipy
`smoothing`             states given all observations
`conditional`           paths of states by conditional SMC, one at a time
`inference`             parameters of a model: PMMH, particle Gibbs, emcee
`diagnostics`           variance of the estimates of a run, energy distances of populations
======================  ===================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {
    "transition": "Transition",
    "proposal": "Proposal",
    "update": "Update",
    "resampler": "Resampler",
    "trigger": "Trigger",
    "size": "Size",
    "similarity": "Similarity",
    "equivalence": "Equivalence",
    "lookahead": "Lookahead",
    "rejuvenation": "Rejuvenation",
    "codec": "Codec",
}
__components__ = {
    "resampler": {
        "multinomial": "Multinomial",
        "residual": "Residual",
        "stratified": "Stratified",
        "systematic": "Systematic",
        "ssp": "Ssp",
        "killing": "Killing",
        "largest_weights": "LargestWeights",
        "fearnhead_clifford": "FearnheadClifford",
        "chopthin": "Chopthin",
        "clusters": "ClusterStratified",
        "coalesced": "Coalesced",
        "tempered": "Tempered",
        "shuffled": "Shuffled",
        "sized": "Sized",
        "sorted": "Sorted",
        "keep_weights": "KeepWeights",
    },
    "trigger": {"always": "Always", "ess": "EssBelow", "every": "Every", "never": "Never"},
    "size": {"kld": "Kld"},
    "similarity": {"gaussian": "Gaussian"},
    "equivalence": {"bins": "Bins", "exact": "ExactEquality"},
}
