"""A particle filter whose particles are whole hypotheses about a scene.

An RGB-D camera watches a cluttered table while somebody moves the objects. At every pause, the filter answers with a
few weighted hypotheses, each of which says which object every voxel belongs to:

>>> import mstfilter
>>> recording = mstfilter.Recording.from_arrays(rgb, depth, K)     # depth in metres
>>> state, infos = mstfilter.preset("mst").run(recording.clips(), seed=0)
>>> belief = mstfilter.Belief(state.population)
>>> belief.estimate().volumes()                                    # the best single answer
>>> belief.same_object_at_pixels(recording.frames[-1].camera, (310, 200), (340, 210))    # a probability

The package has nine rooms, and each imports only from those below it. (A few methods, such as ``plot``, look up their
code in a higher room when they are called.)

===========  =========================================================================================
`app`        what people start: the command line, reports
`runs`       filters at work: presets, one run in its folder, live streams, studies
`lab`        worlds whose truth is known: simulation, oracles, baselines
`mst`        the method: segmentation, completion, tracking, the update, beliefs
`scoring`    how good hypotheses are; paired statistics
`formats`    readers and writers of recordings
`scene`      RGB-D geometry: cameras, frames, clips, voxels, hypotheses
`smc`        the particle filter itself, for particles of any kind; needs numpy and scipy only
`base`       what all rooms share: errors, files, the registry of components
===========  =========================================================================================
"""

import logging

from mstfilter.base.lazy import attach

logging.getLogger("mstfilter").addHandler(logging.NullHandler())  # the application decides what is shown
__version__ = "0.2.0"
__getattr__, __dir__, __all__ = attach(__name__, __file__)
