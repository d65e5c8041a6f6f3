"""Particle filters for any kind of particle. The package does not depend on images or voxels.

A hidden state x_t moves by a model, and is seen only through noisy observations y_t. A particle filter represents
what is known about x_t by weighted particles:

>>> from mstfilter.smc import EssBelow, Normal, ParticleFilter, Reweight, StateSpaceModel, Systematic, bootstrap
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> states, observations = model.simulate(50, seed=1)                          # data to try it on
>>> state, infos = bootstrap(model, n=1000).run(observations, seed=0)          # a textbook filter
>>> state.population.particles.shape, state.population.weights.shape
((1000,), (1000,))
>>> mean, log_evidence = state.population.mean(), state.log_evidence           # of x_t, and of log p(y_0 .. y_t)

The filter is made of components, and each can be replaced by one of your own:

>>> filter = ParticleFilter(initial=prior, transition=move, update=Reweight(log_likelihood),    # doctest: +SKIP
...                         resampler=Systematic(), trigger=EssBelow(), n=1000)

Read first `filter` (the loop), `interfaces` (what a component promises) and `population` (what components exchange).

======================  ===================================================================================
`filter`                `ParticleFilter`; `ParticleFilter.step` is one step of the filter
`interfaces`            base classes of components (`Transition`, `Proposal`, `Update`, `Resampler`, ...),
                        `State` and `Info`
`population`            `Population`: particles, log weights, parents; `Candidates`, particles built on access
`resampling`            schemes that need only weights, with equal output weights
`diverse_resampling`    schemes that keep more distinct particles, with unequal weights
`wrapped_resampling`    wrappers of schemes: sorted, shuffled, merged, tempered, of another size
`components`            update by a likelihood, branching, triggers, sizes, equality of particles
`inputs`                time and inputs of models: `WithInput`, an observation with an input
`streams`               random streams named by seed, step, slot and index
`summaries`             moments, quantiles and circular means of weighted particles
`history`               collectors: quantities of a run, recorded at every step; charts and tables of them
`running`, `sweep`      `run_many`: several filters, seeds and data sets; many runs at once, as arrays
`first_steps`           examines the functions of a model at the first steps of a run
`checkpoint`            storage of the state of a run in a file
`models`                state-space models, programs, distributions, models with exact posteriors
`inference`             smoothing, parameters of a model, variances of the estimates of a run
`testing`               contracts: tests of components of your own
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
