"""Recording of simulated scenes. `simulate_recording` writes a recording folder for an integer seed.

>>> from mstfilter.lab.simulation import scene_family, simulate_recording
>>> recording = simulate_recording(scene_family("demo"), seed=7, path="recordings/demo-7")  # doctest: +SKIP
>>> recording.truth(0).shape  # doctest: +SKIP
(80, 80, 30)

The same family and seed give byte-identical recordings on one machine with the same library versions. Each part of
the simulation has a separate random stream, with a name and an index.

`cached_recording` stores recordings on disk, and later calls return the stored recordings.

>>> from mstfilter import open_recording
>>> from mstfilter.lab.simulation import cached_recording
>>> recording = open_recording(cached_recording("s2", seed=7))  # doctest: +SKIP
>>> small = cached_recording("s2", 7, width=160, height=120, n_actions=1)  # doctest: +SKIP

The name of a cached folder contains a hash (`recipe_key`). A folder is written under a temporary name and renamed
when the recording is complete. Several processes can request the same recording at the same time.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, InputWarning, check_integer
from mstfilter.base.files import atomic_folder, cache_folder, damaged_files, make_folders, sweep, write_text
from mstfilter.base.reading import check_private
from mstfilter.formats import RecordingWriter, open_recording
from mstfilter.lab.simulation.arrangement import SceneObjects, arrange_objects, draw_objects
from mstfilter.lab.simulation.families import GENERATOR_VERSION, SceneFamily, scene_family
from mstfilter.lab.simulation.groups import choose_group_push
from mstfilter.lab.simulation.lighting import Stage
from mstfilter.lab.simulation.renderer import Renderer, View, visible_texel
from mstfilter.lab.simulation.sensor import colour_reading
from mstfilter.lab.simulation.shapes import label_voxels
from mstfilter.lab.simulation.textures import Room, draw_room
from mstfilter.lab.simulation.world import (
    FINGER_ID,
    FingerPush,
    PhysicsWorld,
    PushEffect,
    advance_push,
    choose_push,
    finish_push,
    push_effect,
)
from mstfilter.scene import Recording

#: Metres by which recorded poses (in images, poses and volumes alike) may differ from the physics; see `Stage`.
POSE_TOLERANCE = 0.0002

_DAY_S = 24 * 3600.0
_Progress = Callable[[int, int, str], None]  # called with frames done, frames in all, and a description


def stream(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """The random stream of a part of the simulation."""
    word = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    return np.random.default_rng([seed, word, index])


class SimulatedScene:
    """A simulated scene with physics, textures and sensors, for simulation step by step."""

    def __init__(self, family: SceneFamily, seed: int) -> None:
        check_integer("seed", seed, at_least=0)
        self.family, self.seed = family, int(seed)
        self.camera, self.grid = family.camera(), family.grid()
        pools = family.pool(self.seed), family.object_pool(self.seed)
        self.objects: SceneObjects = draw_objects(stream(self.seed, "things"), family, *pools)
        self.world = PhysicsWorld(self.objects.shapes, family.arm, self.objects.wall)
        arrange_objects(stream(self.seed, "arrangement"), self.world, family, self.objects)
        self.sensor = family.depth_sensor()
        self.room: Room = draw_room(stream(self.seed, "room"), visible_texel(self.camera))
        appearance = self.objects.skins, self.room
        self._renderer = Renderer(self.world, *appearance, self.camera, family.supersample, POSE_TOLERANCE)

    @property
    def stage(self) -> Stage:
        """The poses that are rendered."""
        return self._renderer.stage

    def choose_push(self, action: int) -> FingerPush:
        """Choose the push of action number `action` from the current state."""
        rng = stream(self.seed, "push", action)
        if aim := self.push_aim(action):
            return choose_group_push(rng, self.world, self.family, self.objects.groups, aim)
        return choose_push(rng, self.world, self.family)

    def push_aim(self, action: int) -> str:
        """The aim of the push of an action, one of `PUSH_AIMS`; empty if pushes do not heed groups."""
        aims = self.family.aims()
        if not aims or not self.objects.groups:
            return ""
        return aims[int(stream(self.seed, "aim", action).integers(len(aims)))]

    def play(self, push: FingerPush, on_frame: Callable[[float], None]) -> PushEffect:
        """Simulate a push from one pause to the next. ``on_frame(time)`` is called for each frame."""
        family, world = self.family, self.world
        before, began = world.poses(), world.time
        for step in range(1, family.frames_per_clip - 1):
            advance_push(world, push, (step - 1) / family.fps, step / family.fps)
            on_frame(began + step / family.fps)
        advance_push(world, push, (family.frames_per_clip - 2) / family.fps, push.seconds)
        return push_effect(world, before, finish_push(world), family)

    def frame_images(self, frame: int) -> dict[str, np.ndarray]:
        """Images rgb, depth, instance and robot_mask of the current state. `frame` seeds the sensor noise."""
        view = self._renderer.render()
        return {
            "rgb": colour_reading(stream(self.seed, "colour", frame), view.colour * self.room.exposure),
            "depth": self._depth(stream(self.seed, "depth", frame), view),
            "instance": view.instance,
            "robot_mask": view.instance == FINGER_ID,
        }

    def _depth(self, rng: np.random.Generator, view: View) -> np.ndarray:
        materials = (view.reflectance, view.shine) if self.sensor.sees_materials else ()
        return self.sensor.read(rng, view.depth, view.slant, *materials)

    def truth(self) -> np.ndarray:
        """True labels (X, Y, Z) uint16 of the current state."""
        return label_voxels(self.objects.shapes, self.poses(), self.grid)

    def poses(self) -> np.ndarray:
        """Rendered T_world_object (n, 4, 4) of the objects in the current state."""
        self.stage.follow()
        return self.stage.poses

    def describe(self) -> dict[str, Any]:
        """Description of the scene for the manifest."""
        objects = [
            {
                "id": k,
                "family": s.family,
                "name": s.name,
                "half_m": s.half.tolist(),
                "twin_of": t + 1 if t >= 0 else None,
            }
            for k, (s, t) in enumerate(zip(self.objects.shapes, self.objects.twin_of, strict=True), start=1)
        ]
        return {
            "name": f"{self.family.name}-{self.seed}",
            "generator": "mstfilter.lab.simulation",
            "generator_version": GENERATOR_VERSION,
            "seed": self.seed,
            "family": self.family.described(),
            "objects": objects,
            **({"groups": [group.describe() for group in self.objects.groups]} if self.objects.groups else {}),
        }


def simulate_recording(
    family: SceneFamily, seed: int, path: str | Path, progress: _Progress | None = None
) -> Recording:
    """Simulate the scene of a family and a seed, write the recording to a folder, and open the recording.

    `path` is a folder that is empty or does not exist yet. If the simulation fails, no files are left. `progress` is
    called after each frame with the number of frames done, the number of all frames, and a description. Raises
    InputError if the folder cannot be written, or the objects cannot be arranged or pushed.
    """
    scene = SimulatedScene(family, seed)
    report = progress or (lambda done, total, description: None)
    with RecordingWriter(path, scene.camera, scene.grid, **scene.describe()) as writer:
        start, index = scene.world.time, 0
        _record_pause(scene, writer, index, 0.0)
        report(1, family.n_frames, "pause 0")
        for action in range(family.n_actions):

            def record(time: float, action: int = action) -> None:
                nonlocal index
                index += 1
                _record_frame(scene, writer, index, time - start, "action", action=action)
                report(index + 1, family.n_frames, f"action {action}")

            push = scene.choose_push(action)
            description = _describe_push(push, scene.play(push, record))
            if aim := scene.push_aim(action):
                description["aim"] = aim
            index += 1
            _record_pause(scene, writer, index, scene.world.time - start, action=action, push=description)
            report(index + 1, family.n_frames, f"pause {action + 1}")
    return open_recording(path)


def _record_frame(
    scene: SimulatedScene, writer: RecordingWriter, index: int, time_s: float, role: Any, **entry: Any
) -> None:
    images = scene.frame_images(index)
    visible = np.bincount(images["instance"].ravel(), minlength=256)[1 : scene.world.n_objects + 1]
    poses = {str(k + 1): pose for k, pose in enumerate(scene.poses())}
    entry["visible_pixels"] = visible.tolist()
    writer.add_frame(time_s=round(time_s, 6), role=role, poses=poses, **images, **entry)


def _record_pause(scene: SimulatedScene, writer: RecordingWriter, index: int, time_s: float, **entry: Any) -> None:
    contacts = [[i + 1, j + 1] for i, j in scene.world.contacts()]
    # Objects outside the workspace have no or only some voxels in the true volume.
    away = np.flatnonzero(~scene.family.contains_points(scene.poses()[:, :3, 3])) + 1
    _record_frame(scene, writer, index, time_s, "static", contacts=contacts, left_workspace=away.tolist(), **entry)
    writer.add_voxels(scene.truth())


def _describe_push(push: FingerPush, result: PushEffect) -> dict[str, Any]:
    return {
        "start_m": list(push.start),
        "end_m": list(push.end),
        "displacement_m": [round(float(d), 6) for d in result.displacement],
        "turned_rad": [round(float(a), 6) for a in result.turned],
        "settled": result.settled,
        "all_kept": result.kept,
    }


def recipe_key(family: SceneFamily, seed: int) -> str:
    """A hash of all values that determine a recording: the family, the seed and the software versions."""
    recipe = {
        "generator": GENERATOR_VERSION,
        "mujoco": version("mujoco"),
        "family": family.described(),
        "seed": int(seed),
    }
    return hashlib.sha256(json.dumps(recipe, sort_keys=True).encode()).hexdigest()[:16]


def cached_path(family: SceneFamily, seed: int, folder: Path) -> Path:
    """The path at which `cached_recording` stores a recording in a folder. The folder need not exist."""
    return folder / f"{family.name}-{seed}-{recipe_key(family, seed)}"


def cached_recording(family: str | SceneFamily, seed: int, folder: Path | None = None, **overrides: Any) -> Path:
    """The folder of a simulated recording. The recording is simulated if it does not exist or has changed on disk.

    `overrides` replace fields of the family. Recordings are stored in `folder`, by default `recordings` in
    `cache_folder()`. Raises InputError if the family, a field or the seed is invalid, or the folder cannot be
    written.
    """
    chosen = scene_family(family) if isinstance(family, str) else family
    known = {f.name for f in fields(SceneFamily)}
    unknown = sorted(set(overrides) - known)
    if unknown:
        raise InputError(
            f"scene family {chosen.name!r} has no field {unknown[0]!r}", f"fields: {', '.join(sorted(known))}"
        )
    chosen = replace(chosen, **overrides)
    check_integer("seed", seed, at_least=0)
    target = cached_path(chosen, seed, folder or cache_folder() / "recordings")
    check_private(target.parent)
    if (target / "manifest.json").is_file() and (damage := damaged_files(target)):
        warnings.warn(InputWarning(f"cached recording {target}: {damage[0]}", "it is simulated again"), stacklevel=2)
        shutil.rmtree(target)
    if not (target / "manifest.json").is_file():
        _simulate_into_cache(chosen, seed, target)
    return target


def _simulate_into_cache(family: SceneFamily, seed: int, target: Path) -> None:
    try:
        make_folders(target.parent, 0o700)
        ignore = target.parent / ".gitignore"  # recordings stay out of version control
        if not ignore.exists():
            write_text(ignore, "*\n")
        sweep(target.parent, older_than_s=_DAY_S)  # of simulations that were killed
        with atomic_folder(target, existing="keep") as work:  # another process may write the same recording
            simulate_recording(family, seed, work)
    except OSError as error:
        raise InputError(
            f"cannot keep recordings in {target.parent}: {error.strerror}",
            "set MSTFILTER_CACHE to a folder that can be written",
        ) from error
