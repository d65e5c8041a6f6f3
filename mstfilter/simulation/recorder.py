"""Simulate a recording: one call, one integer seed, one folder.

>>> from mstfilter.simulation.families import scene_family
>>> from mstfilter.simulation.recorder import simulate
>>> recording = simulate(scene_family("demo"), seed=7, path="recordings/demo-7")  # doctest: +SKIP
>>> recording.truth(0).shape  # doctest: +SKIP
(80, 80, 30)

The same family and seed give the same bytes (on one machine and build of the libraries). Every part draws
from its own stream, named after the part and its index.


Simulated recordings kept on disk: made once, found again by the content of their recipe.

>>> from mstfilter.formats import open_recording
>>> from mstfilter.simulation.recorder import cached_recording
>>> recording = open_recording(cached_recording("s2", seed=7))  # doctest: +SKIP
>>> small = cached_recording("s2", 7, width=160, height=120, n_actions=1)  # doctest: +SKIP

The name of a recording's folder holds a hash of everything that decides its bytes: every field of the family, the
seed, the version of the simulator and of the physics library. A folder of that name is therefore complete and
right: it is written under another name and renamed. Several processes may ask for the same recording.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.formats import RecordingWriter, open_recording
from mstfilter.scene import Recording
from mstfilter.simulation.arrangement import Things, arrange, draw_things
from mstfilter.simulation.families import GENERATOR_VERSION, SceneFamily, scene_family
from mstfilter.simulation.renderer import Renderer, seen_texel
from mstfilter.simulation.sensor import ColourSensor, DepthSensor
from mstfilter.simulation.shapes import label_voxels
from mstfilter.simulation.textures import Room, draw_room
from mstfilter.simulation.world import FINGER_ID, Effect, Push, World, advance, choose_push, effect, finish

__all__ = ["Progress", "Scene", "cache_folder", "cached_recording", "recipe_key", "record", "simulate"]

TOLERANCE = 0.0002
"""Metres by which what is recorded (pictures, poses and volumes alike) may lag behind trembling physics."""

Progress = Callable[[int, int, str], None]
"""Called with frames done, frames in all, and what is being done."""


def _stream(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """An own stream for each part; parts do not disturb one another."""
    word = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    return np.random.default_rng([seed, word, index])


class Scene:
    """A world with its look and its sensors: what `simulate` records, for use step by step.

    Parameters
    ----------
    family : SceneFamily
    seed : int
        Not negative.
    """

    def __init__(self, family: SceneFamily, seed: int) -> None:
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise InputError(f"seed is {seed!r}, expected an integer of at least 0")
        self.family, self.seed = family, int(seed)
        self.camera, self.grid = family.camera(), family.grid()
        self.things: Things = draw_things(_stream(self.seed, "things"), family.for_seed(self.seed))
        self.world = World(self.things.shapes, family.arm)
        arrange(_stream(self.seed, "arrangement"), self.world, family, self.things.twin_of)
        self.room: Room = draw_room(_stream(self.seed, "room"), seen_texel(self.camera))
        self._renderer = Renderer(
            self.world, self.things.skins, self.room, self.camera, family.supersample, TOLERANCE
        )
        self._colour, self._depth = ColourSensor(), DepthSensor()

    def choose(self, action: int) -> Push:
        """The push of action `action`, from the world as it is now."""
        return choose_push(_stream(self.seed, "push", action), self.world, self.family)

    def see(self, frame: int) -> dict[str, np.ndarray]:
        """What frame number `frame` shows of the world as it is now: rgb, depth, instance, robot_mask."""
        view = self._renderer.render()
        return {
            "rgb": self._colour.read(_stream(self.seed, "colour", frame), view.colour * self.room.exposure),
            "depth": self._depth.read(_stream(self.seed, "depth", frame), view.depth, view.slant),
            "instance": view.instance,
            "robot_mask": view.instance == FINGER_ID,
        }

    def truth(self) -> np.ndarray:
        """(X, Y, Z) uint16 labels of the world as it is now."""
        return label_voxels(self.things.shapes, self.poses(), self.grid)

    def poses(self) -> np.ndarray:
        """(n, 4, 4) T_world_object of the world as it is shown now."""
        self._renderer.stage.follow()
        return self._renderer.stage.poses

    def describe(self) -> dict[str, Any]:
        """What the manifest says of the scene."""
        objects = [
            {
                "id": k + 1,
                "family": s.family,
                "name": s.name,
                "half_m": s.half.tolist(),
                "twin_of": t + 1 if t >= 0 else None,
            }
            for k, (s, t) in enumerate(zip(self.things.shapes, self.things.twin_of, strict=True))
        ]
        return {
            "name": f"{self.family.name}-{self.seed}",
            "generator": "mstfilter.simulation",
            "generator_version": GENERATOR_VERSION,
            "seed": self.seed,
            "family": asdict(self.family),
            "objects": objects,
        }


def simulate(family: SceneFamily, seed: int, path: str | Path, progress: Progress | None = None) -> Recording:
    """Simulate a scene, record it and write the recording.

    Parameters
    ----------
    family : SceneFamily
        What kind of scene; see `families.scene_family`.
    seed : int
        Decides everything else. Not negative.
    path : path
        The recording's folder; it must not exist or be empty. Nothing is left behind on failure.
    progress : callable, optional
        Called after each frame.

    Returns
    -------
    Recording
        Opened from the folder.

    Raises
    ------
    InputError
        If the folder cannot be written, or the objects cannot be arranged or pushed.
    """
    return record(Scene(family, seed), path, progress)


def record(scene: Scene, path: str | Path, progress: Progress | None = None) -> Recording:
    """Act in a scene, record it and write the recording: `simulate` for a scene of one's own.

    Parameters
    ----------
    scene : Scene
        At its first pause. A subclass may arrange it and choose its pushes otherwise.
    path, progress
        See `simulate`.

    Raises
    ------
    InputError
        If the folder cannot be written, or the objects cannot be pushed.
    """
    with RecordingWriter(path, scene.camera, scene.grid, **scene.describe()) as writer:
        _record(scene, writer, progress or (lambda done, total, what: None))
    return open_recording(path)


def _record(scene: Scene, writer: RecordingWriter, progress: Progress) -> None:
    family, world = scene.family, scene.world
    start, index = world.time, 0
    _pause(scene, writer, index, 0.0)
    progress(1, family.n_frames, "pause 0")
    for action in range(family.n_actions):
        push = scene.choose(action)
        before, turn, began = world.positions(), world.rotations(), world.time
        for step in range(1, family.frames_per_clip - 1):
            index += 1
            advance(world, push, (step - 1) / family.fps, step / family.fps)
            _frame(scene, writer, index, began + step / family.fps - start, "action", action=action)
            progress(index + 1, family.n_frames, f"action {action}")
        index += 1
        advance(world, push, (family.frames_per_clip - 2) / family.fps, push.seconds)
        settled = finish(world)
        result = effect(world, before, turn, settled, family)
        _pause(scene, writer, index, world.time - start, action=action, push=_as_json(push, result))
        progress(index + 1, family.n_frames, f"pause {action + 1}")


def _frame(scene: Scene, writer: RecordingWriter, index: int, time_s: float, role: Any, **entry: Any) -> None:
    seen = scene.see(index)
    visible = np.bincount(seen["instance"].ravel(), minlength=256)[1 : scene.world.n_objects + 1]
    poses = {str(k + 1): pose for k, pose in enumerate(scene.poses())}
    entry["visible_pixels"] = visible.tolist()
    writer.add_frame(time_s=round(time_s, 6), role=role, poses=poses, **seen, **entry)


def _pause(scene: Scene, writer: RecordingWriter, index: int, time_s: float, **entry: Any) -> None:
    contacts = [[c.first + 1, c.second + 1] for c in scene.world.contacts()]
    # Objects beyond the workspace have no (or only some) voxels in the truth, whose extent is fixed.
    away = np.flatnonzero(~scene.family.holds(scene.poses()[:, :3, 3])) + 1
    _frame(scene, writer, index, time_s, "static", contacts=contacts, left_workspace=away.tolist(), **entry)
    writer.add_voxels(scene.truth())


def _as_json(push: Push, result: Effect) -> dict[str, Any]:
    return {
        "start_m": list(push.start),
        "end_m": list(push.end),
        "displacement_m": [round(float(d), 6) for d in result.displacement],
        "turned_rad": [round(float(a), 6) for a in result.turned],
        "settled": result.settled,
        "all_kept": result.kept,
    }


def cache_folder() -> Path:
    """Where recordings are kept: MSTFILTER_CACHE, else `mstfilter` in the user's cache folder."""
    own = os.environ.get("MSTFILTER_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mstfilter"


def recipe_key(family: SceneFamily, seed: int) -> str:
    """A hash of everything that decides the bytes of a recording."""
    recipe = {
        "generator": GENERATOR_VERSION,
        "mujoco": version("mujoco"),
        "family": asdict(family),
        "seed": int(seed),
    }
    return hashlib.sha256(json.dumps(recipe, sort_keys=True).encode()).hexdigest()[:16]


def cached_recording(family: str | SceneFamily, seed: int, folder: Path | None = None, **overrides: Any) -> Path:
    """The folder of a simulated recording, made now if it is not there.

    Parameters
    ----------
    family : str or SceneFamily
        A named family, or an own one.
    seed : int
        Not negative.
    folder : path, optional
        Where recordings are kept. Default: `recordings` in `cache_folder()`.
    **overrides
        Fields of the family to change: image size, frames a clip, number of actions, ...

    Raises
    ------
    InputError
        If the family, a field or the seed is wrong, or the folder cannot be written.
    """
    chosen = scene_family(family) if isinstance(family, str) else family
    known = {f.name for f in fields(SceneFamily)}
    unknown = sorted(set(overrides) - known)
    if unknown:
        raise InputError(
            f"scene family {chosen.name!r}: there is no field {unknown[0]!r}",
            f"there are: {', '.join(sorted(known))}",
        )
    chosen = replace(chosen, **overrides)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError(f"seed is {seed!r}, expected an integer of at least 0")
    home = Path(folder) if folder is not None else cache_folder() / "recordings"
    target = home / f"{chosen.name}-{seed}-{recipe_key(chosen, seed)}"
    if not (target / "manifest.json").is_file():
        _make(chosen, seed, target)
    return target


def _make(family: SceneFamily, seed: int, target: Path) -> None:
    from mstfilter.simulation.recorder import simulate

    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # Wherever a user keeps recordings, they never enter version control.
        ignore = target.parent / ".gitignore"
        if not ignore.exists():
            ignore.write_text("*\n")
        work = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        raise InputError(
            f"cannot keep recordings in {target.parent}: {error.strerror}",
            "set MSTFILTER_CACHE to a folder that can be written",
        ) from error
    try:
        made = simulate(family, seed, work / "recording").path
        assert made is not None
        try:
            made.rename(target)
        except OSError:
            if not (target / "manifest.json").is_file():
                raise
            # Another process was quicker; its recording is the same.
    finally:
        shutil.rmtree(work, ignore_errors=True)
