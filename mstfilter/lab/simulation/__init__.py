"""Simulated recordings: a robot finger pushes objects on a table, and the true volumes are known.

A scene family and a seed determine a recording:

>>> from mstfilter.lab.simulation import cached_recording, scene_family, simulate_recording
>>> recording = simulate_recording(scene_family("demo"), seed=7, path="recordings/demo-7")  # doctest: +SKIP
>>> folder = cached_recording("s1", seed=7)  # found again by the next call  # doctest: +SKIP

The world can also be simulated step by step. With a `PushLoop`, your program chooses each push from the belief of a
filter:

>>> from mstfilter.lab.simulation import SimulatedScene, play_push
>>> scene = SimulatedScene(scene_family("demo"), seed=7)  # doctest: +SKIP
>>> images, labels = scene.frame_images(0), scene.truth()  # doctest: +SKIP
>>> effect = play_push(scene.world, scene.choose_push(0), scene.family)  # doctest: +SKIP

Objects are generated, or they are meshes of your own:

>>> simulate_recording(replace(scene_family("s1"), objects="my_objects"), 7, "recordings/mine-7")  # doctest: +SKIP

From bottom to top, the modules are `solids`, `volumes`, `surfaces` and `shapes` (objects), `objects` (folders of
meshes), `sensor` (noise), `families` (parameters of scenes), `world` (MuJoCo physics, pushes), `printing` and
`textures` (appearance), `groups` (objects that stand together), `arrangement` (placement), `lighting` and `renderer`
(ray casting), `recorder` (recordings and their cache) and `push_loop`.

Depth noise, the shadow of the projector and missing readings at edges of the default sensor are calibrated to real
frames; the other sensors follow published figures. What real scenes have and these do not: a moving camera,
transparent surfaces and mirror images, light reflected between objects, articulated or soft objects, a hand, and
depth noise that is correlated within a surface.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
