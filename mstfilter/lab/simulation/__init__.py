"""Simulated recordings of a robot finger that pushes objects on a table, with true volumes.

A scene family and a seed define a recording:

>>> from mstfilter.lab.simulation import cached_recording, scene_family, simulate_recording
>>> recording = simulate_recording(scene_family("demo"), seed=7, path="recordings/demo-7")  # doctest: +SKIP
>>> folder = cached_recording("s1", seed=7)  # found again by the next call  # doctest: +SKIP

A scene can also be simulated step by step:

>>> from mstfilter.lab.simulation import SimulatedScene, play_push
>>> scene = SimulatedScene(scene_family("demo"), seed=7)  # doctest: +SKIP
>>> images, labels = scene.frame_images(0), scene.truth()  # doctest: +SKIP
>>> effect = play_push(scene.world, scene.choose_push(0), scene.family)  # doctest: +SKIP

With a `PushLoop`, a program chooses each push from the belief of a filter.

The lower modules, from bottom to top, are `solids` and `shapes` (objects), `families` (parameters of scenes), `world`
(MuJoCo physics, pushes), `printing` and `textures` (appearance). The higher modules are `arrangement` (placement),
`lighting` and `renderer` (ray casting), `sensor` (noise), `recorder` (recordings and their cache) and `push_loop`.

The simulation has no camera motion, no glossy or transparent surfaces, no light reflected between objects, no
articulated or soft objects, and no hand. Depth noise, the shadow of the projector and missing readings at edges are
calibrated to real frames. Within a surface, depth noise is not correlated between pixels.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
