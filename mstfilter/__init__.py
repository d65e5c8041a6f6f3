"""Particle filtering over scene hypotheses.

>>> import mstfilter
>>> recording = mstfilter.Recording.from_arrays(rgb, depth, K)     # depth in metres
>>> state, infos = mstfilter.preset("mst").run(recording.clips(), seed=0)
>>> mstfilter.Belief(state.population).estimate().volumes()

`mstfilter.runs.presets` has assembled filters, `mstfilter.smc` has the particle filter, and `mstfilter.scene` has
cameras, recordings and hypotheses.
"""

import logging

from mstfilter.base.lazy import attach

logging.getLogger("mstfilter").addHandler(logging.NullHandler())  # the application decides what is shown
__version__ = "0.2.0"
__getattr__, __dir__, __all__ = attach(__name__, __file__)
