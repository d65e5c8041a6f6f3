"""A miniature MST whose exact posterior can be enumerated.

A table of a few cells holds a few objects; a robot pushes; a segmentation and a depth sensor look on, both noisy.
Particles are `Hypothesis` objects, so the crossover, projection, weights and resamplers of MST act on them
unchanged, and properly weighted filters run beside them on the very same data.

>>> import numpy as np
>>> from mstfilter.oracles.miniature.exact import exact_filter
>>> from mstfilter.oracles.miniature.filters import bootstrap_filter
>>> from mstfilter.oracles.miniature.measures import class_weights, total_variation
>>> from mstfilter.oracles.miniature.world import Miniature
>>> world = Miniature()
>>> truth, glances = world.simulate(np.random.default_rng(0), 5)
>>> state, infos = bootstrap_filter(world, 2000).run(glances, seed=0)
>>> exact = exact_filter(world, glances)
>>> total_variation(class_weights(world, state.population), exact.posterior[-1])

Modules: `states` (all configurations), `world` (motion and sensors), `exact` (forward algorithm), `filters`
(properly weighted filters), `shrunk` (the presets of MST on this world), `weighting` (other rules for the weights),
`measures`, `calibration`.
"""
