"""RGB-D scenes: what a camera saw, and hypotheses about what is there.

>>> from mstfilter.scene import Hypothesis, Recording, project
>>> recording = Recording.from_arrays(rgb, depth, K)  # depth in metres  # doctest: +SKIP
>>> clip = recording.clips()[-1]                      # the frames from one pause to the next  # doctest: +SKIP
>>> clip.after.points                                 # (H, W, 3) world points in metres  # doctest: +SKIP
>>> hypothesis = Hypothesis.from_labels(labels, clip.grid)  # an object for every voxel  # doctest: +SKIP
>>> project(hypothesis, clip.after.camera)            # the label image that it predicts  # doctest: +SKIP

A `Recording` is a video with pauses, at which nothing moves. What a filter observes is a `Clip`, the frames from one
pause to the next, and each `Frame` is an image with its `Camera`. Hypotheses live on a `VoxelGrid` above the table.

Units are metres, radians and seconds. A rigid motion is a scipy `RigidTransform`, named ``T_to_from`` after its axes;
z of the world points up, and the table is at z = 0. This room depends neither on filters nor on file formats.

=====================================  ===============================================================
`camera`, `frame`, `recording`         pinhole cameras; images, clips; videos with pauses
`from_arrays`, `pauses`                what `Recording.from_arrays` checks; the interface of rules that find pauses
`voxels`, `occupancy`, `partitions`    grids and hypotheses; probabilities; renumbered and refined labels
`planes`, `heights`, `support`         the table and walls; readings above it; which pixels belong to objects
`geometry`                             voxels in the image, the workspace
`rendering`, `outlines`, `evidence`    hypotheses seen by a camera, with the outlines of an image; free space, scores
`plausibility`, `alignment`            faults of the input, found before a run; its measurements in several frames
`encoding`, `arrays`                   hypotheses as arrays; content keys
`cache`                                results that depend on the images alone, computed once
=====================================  ===============================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"free_space": "Projection", "evidence": "Evidence"}
__components__ = {"free_space": {"projective": "FreeSpace", "none": "NoFreeSpace"}}
