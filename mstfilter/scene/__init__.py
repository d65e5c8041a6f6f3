"""RGB-D scenes: cameras, frames, clips, voxel grids, hypotheses, recordings.

>>> from mstfilter.scene import Hypothesis, Recording, project
>>> recording = Recording.from_arrays(rgb, depth, K)  # doctest: +SKIP
>>> clip = recording.clips()[-1]                      # the frames from one pause to the next  # doctest: +SKIP
>>> hypothesis = Hypothesis.from_labels(labels, clip.grid)  # doctest: +SKIP
>>> project(hypothesis, clip.after.camera)            # label image of the hypothesis  # doctest: +SKIP

Units are metres, radians and seconds. A rigid motion is a scipy `RigidTransform`, named ``T_to_from`` after its axes.
`mstfilter.scene` does not depend on filters or file formats.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"free_space": "Projection", "evidence": "Evidence"}
__components__ = {"free_space": {"projective": "FreeSpace", "none": "NoFreeSpace"}}
