"""From a study to its runs: grids multiplied out, everything checked, every run named by all it depends on.

>>> plan = make_plan(load_study("study.toml"))
>>> [run.name for run in plan.runs]

A run's identity is a hash of its resolved configuration, what recording it reads (the recipe of a simulated one,
the content of a folder, its truth included), its seed, and the version of the code and the libraries that it
reaches. Two studies that share a run share its identity; a run whose identity is unchanged is never repeated.
"""

from __future__ import annotations

import glob
import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError
from mstfilter.presets import REGISTRY, build_filter, describe_filter
from mstfilter.runs.run import files_of, versions
from mstfilter.runs.run_folder import plain
from mstfilter.runs.sources import open_source
from mstfilter.scene import content_key
from mstfilter.study.code_version import code_version
from mstfilter.study.config import SceneEntry, StudyConfig
from mstfilter.study.grid import Asked, expand

__all__ = ["Arm", "Plan", "StudyRun", "StudyScene", "make_plan"]

# What every run goes through besides its components.
_ALWAYS = ("mstfilter.smc.filter", "mstfilter.scene.recording", "mstfilter.runs.run_folder")


@dataclass(frozen=True)
class Arm:
    """A filter to compare.

    Parameters
    ----------
    name : str
    config : dict
        Resolved: every field of every component.
    key : str
        Hash of the configuration, users' files and code.
    ours : bool
        Whether all components are of this package or of a file, so that their version is known.
    modules : tuple of str
        Where the code begins that its runs reach.
    beside : bool
        No part of the comparisons that are adjusted together.
    """

    name: str
    config: dict[str, Any]
    key: str
    ours: bool
    modules: tuple[str, ...]
    beside: bool = False


@dataclass(frozen=True)
class StudyScene:
    """A recording to filter.

    Parameters
    ----------
    name : str
    group : str
        Its family in the tables.
    source : dict
        ``{"family", "seed", "set"}`` of a simulated one, path and how it is read of any other.
    key : str
        Names recipe or content.
    """

    name: str
    group: str
    source: dict[str, Any]
    key: str


@dataclass(frozen=True)
class StudyRun:
    """An arm on a scene with a seed of the filter."""

    arm: Arm
    scene: StudyScene
    seed: int
    identity: str

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.arm.name} on {self.scene.name}, seed {self.seed}"

    @property
    def folder(self) -> str:
        """Name of its folder: readable, and one a run."""
        words = re.sub(r"[^\w.=-]+", "-", f"{self.arm.name}_{self.scene.name}_{self.seed}").strip(".-")
        return f"{words[:100]}_{self.identity[:10]}"


@dataclass(frozen=True)
class Plan:
    """All runs of a study, scene by scene."""

    config: StudyConfig
    arms: tuple[Arm, ...]
    scenes: tuple[StudyScene, ...]
    runs: tuple[StudyRun, ...]

    @property
    def reference(self) -> str:
        """The arm that the others are compared with."""
        return self.config.reference or self.arms[0].name


def make_plan(study: StudyConfig, overrides: Sequence[str] = (), *, allow_files: bool = True) -> Plan:
    """The runs of a study.

    Parameters
    ----------
    study : StudyConfig
    overrides : sequence of str
        Applied to every arm after its own; a comma makes a grid.
    allow_files : bool
        Whether components may come from ``./file.py:Class``.

    Raises
    ------
    InputError
        A wrong arm, two arms that are the same, a grid without runs, a recording that cannot be read.
    """
    arms = tuple(_arm(asked, allow_files) for asked in expand(study, overrides))
    for what, found in (("arm", arms), ("scene", study.scenes), ("seed", study.seeds)):
        if not found:
            raise InputError(f"study {study.name} has no {what}, so there is nothing to run")
    _all_different("arms", [(arm.name, arm.key) for arm in arms])
    scenes = _told_apart([scene for entry in study.scenes for scene in _scenes(entry, study.folder, allow_files)])
    _all_different("scenes", [(scene.name, scene.key) for scene in scenes])
    if len(set(study.seeds)) < len(study.seeds):
        raise InputError(f"study {study.name} names a seed twice: {list(study.seeds)}")
    if study.reference and study.reference not in [arm.name for arm in arms]:
        raise InputError(
            f"reference is {study.reference!r}, which is no arm", f"there are: {', '.join(a.name for a in arms)}"
        )
    runs = tuple(
        StudyRun(arm, scene, seed, _hash([arm.key, scene.key, seed]))
        for scene in scenes
        for seed in study.seeds
        for arm in arms
    )
    return Plan(study, arms, scenes, runs)


def _arm(asked: Asked, allow_files: bool) -> Arm:
    with asked.named():
        filter = build_filter(asked.config(allow_files), allow_files=allow_files)
    config = plain(describe_filter(filter))
    modules = (*sorted(_modules(filter)), *_ALWAYS)
    ours = all(module.split(".")[0].startswith("mstfilter") for module in modules)
    key = _hash([config, files_of(filter), versions(), code_version(modules)])
    return Arm(asked.name, config, key, ours, modules, asked.beside)


def _scenes(entry: SceneEntry, folder: Path, allow_files: bool) -> Iterator[StudyScene]:
    if entry.family:
        from mstfilter.simulation import recipe_key, scene_family

        family = scene_family(entry.family)
        family = REGISTRY.make(type(family), entry.set, f"scene family {entry.family!r}", base=family)
        changed = {name: getattr(family, name) for name in entry.set}
        group = entry.group or entry.family
        for seed in entry.seeds:
            source = {"family": entry.family, "seed": seed, "set": changed}
            yield StudyScene(f"{group}-{seed}", group, source, recipe_key(family, seed))
        return
    for pattern in entry.recordings:
        paths = sorted(glob.glob(str(folder / pattern)))
        if not paths:
            raise InputError(f"recording does not exist: {folder / pattern}")
        for path in paths:
            source = {"path": str(Path(path).resolve()), "format": entry.format, "pauses": entry.pauses}
            source |= {"options": list(entry.options)}
            recording = open_source(Path(path), entry.format, entry.options, entry.pauses, allow_files=allow_files)
            # The truth counts: figures depend on it, and all that oracles do.
            key = content_key(recording.key, recording.truth_key).hex()
            yield StudyScene(Path(path).name, entry.group or "recordings", source, key)


def _told_apart(scenes: list[StudyScene]) -> tuple[StudyScene, ...]:
    """Scenes of one name in several groups get their group's name in front."""
    often = Counter(scene.name for scene in scenes)
    return tuple(replace(s, name=f"{s.group}-{s.name}") if often[s.name] > 1 else s for s in scenes)


def _all_different(what: str, named: list[tuple[str, str]]) -> None:
    """No name and no key twice."""
    seen: dict[str, str] = {}
    for name, key in named:
        if key in seen:
            raise InputError(
                f"two {what} are the same: {seen[key]!r} and {name!r}", "leave one out, or change what it sets"
            )
        if name in seen.values():
            raise InputError(
                f"two {what} are called {name!r}",
                "give each a name" if what == "arms" else "give each a group of its own",
            )
        seen[key] = name


def _modules(component: Any) -> set[str]:
    """Modules of a component's class and of those of its parts."""
    if isinstance(component, tuple):
        return set().union(*(_modules(part) for part in component))
    if not is_dataclass(component):
        return set()
    return {type(component).__module__}.union(*(_modules(getattr(component, f.name)) for f in fields(component)))


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()[:32]
