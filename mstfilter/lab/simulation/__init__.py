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

Objects are generated, or they are meshes of your own:

>>> simulate_recording(replace(scene_family("s1"), objects="my_objects"), 7, "recordings/mine-7")  # doctest: +SKIP

The lower modules, from bottom to top, are `solids`, `surfaces` and `shapes` (objects), `objects` (folders of meshes),
`sensor` (noise), `families` (parameters of scenes), `world` (MuJoCo physics, pushes), `printing` and `textures`
(appearance). The higher modules are `groups` (objects that stand together), `arrangement` (placement), `lighting` and
`renderer` (ray casting), `recorder` (recordings and their cache) and `push_loop`.

The simulation has no camera motion, no transparent surfaces, no mirror images, no light reflected between objects, no
articulated or soft objects, and no hand. Depth noise, the shadow of the projector and missing readings at edges of
the default sensor are calibrated to real frames; other sensors follow published figures.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
