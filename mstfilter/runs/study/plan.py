"""The runs of a study: every combination of an arm, a scene and a seed, with an identity.

>>> plan = make_plan(load_study("study.toml"))
>>> [run.name for run in plan.runs]

The identity of a run is a hash of its configuration, its recording, its seed, the code of mstfilter and of the user's
files, and the versions of the libraries. Comments and docstrings do not count as code. For a simulated recording, the
family, the seed and the version of the simulator are hashed, for other recordings the content and the ground truth.
A run is not repeated if its identity has not changed. Your own metrics are not part of the identity: a new one is
measured on the hypotheses of the finished runs. (With ``keep = "tables"`` these are gone, so the runs are repeated.)
"""

from __future__ import annotations

import glob
import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mstfilter.base.errors import InputError, naming
from mstfilter.base.registry import nested_components
from mstfilter.formats import open_recording
from mstfilter.lab.oracles import uses_truth
from mstfilter.runs import as_json, code_version, component_files, library_versions
from mstfilter.runs.presets import REGISTRY, build_filter, describe_filter
from mstfilter.runs.study.config import ArmRequest, SceneEntry, StudyConfig, expand_arms, take_metrics
from mstfilter.scene import content_key
from mstfilter.scoring import Metric

if TYPE_CHECKING:
    from mstfilter.lab.simulation import SceneFamily

_MOST_RUNS = 1_000_000


@dataclass(frozen=True)
class Arm:
    """A filter to compare."""

    name: str
    config: dict[str, Any]  #: every field of every component
    key: str  #: hash of the configuration, the code and the files of the user
    uses_truth: tuple[str, ...]  #: classes of its components that use the ground truth
    reported_only: bool = False  #: not part of the comparisons whose p values are adjusted together
    of_one_recording: str = ""  #: classes of its components with files of one recording


@dataclass(frozen=True)
class StudyScene:
    """A recording to filter."""

    name: str
    group: str  #: name of its family in the tables
    #: ``{"family", "seed", "set"}`` of a simulated recording; path, format, options and pauses of other
    #: recordings.
    source: dict[str, Any]
    key: str  #: hash of the recipe or the content


@dataclass(frozen=True)
class StudyRun:
    """A run of an arm on a scene with a seed of the filter."""

    arm: Arm
    scene: StudyScene
    seed: int
    identity: str

    @property
    def name(self) -> str:
        """Name of the run in messages."""
        return f"{self.arm.name} on {self.scene.name}, seed {self.seed}"

    @property
    def folder(self) -> str:
        """Name of the folder of the run."""
        words = re.sub(r"[^\w.=-]+", "-", f"{self.arm.name}_{self.scene.name}_{self.seed}").strip(".-")
        return f"{words[:100]}_{self.identity[:10]}"


@dataclass(frozen=True)
class Plan:
    """All runs of a study, ordered by scene, and the version of the code with which they were planned."""

    config: StudyConfig
    code: str
    arms: tuple[Arm, ...]
    scenes: tuple[StudyScene, ...]
    runs: tuple[StudyRun, ...]
    metrics: dict[str, dict[str, Any]]  #: own metrics: hash of the configuration and the file -> configuration

    @property
    def reference(self) -> str:
        """Name of the arm with which the other arms are compared."""
        return self.config.reference or self.arms[0].name


def make_plan(study: StudyConfig, overrides: Sequence[str] = ()) -> Plan:
    """The runs of a study.

    `overrides` apply to every arm after its own changes. Each combination of comma-separated values is an arm. Raises
    InputError if an arm is invalid, two arms are the same, there are no runs, or a recording cannot be read.
    """
    study, overrides = take_metrics(study, overrides)
    metrics = dict(_metric(spec) for spec in study.metric)
    code = code_version()
    versions = {name: version for name, version in library_versions().items() if name != "mstfilter"}
    arms = tuple(_arm(request, versions, code) for request in expand_arms(study, overrides))
    for what, found in (("arm", arms), ("scene", study.scenes), ("seed", study.seeds)):
        if not found:
            raise InputError(f"study {study.name} has no {what}, so there is nothing to run")
    _check_unique("arms", [(arm.name, arm.key) for arm in arms])
    scenes = _unique_names([scene for entry in study.scenes for scene in _scenes(entry, study.folder)])
    _check_unique("scenes", [(scene.name, scene.key) for scene in scenes])
    if len(set(study.seeds)) < len(study.seeds):
        raise InputError(f"study {study.name} names a seed twice: {list(study.seeds)}")
    if study.reference and study.reference not in [arm.name for arm in arms]:
        raise InputError(
            f"reference is {study.reference!r}, which is not an arm", f"there are: {', '.join(a.name for a in arms)}"
        )
    if (n := len(arms) * len(scenes) * len(study.seeds)) > _MOST_RUNS:
        raise InputError(
            f"study {study.name} has {n} runs, at most {_MOST_RUNS} are planned: {len(arms)} arms, {len(scenes)} "
            f"scenes and {len(study.seeds)} seeds",
            "split the study",
        )
    for arm in arms:
        if arm.of_one_recording and len(scenes) > 1:
            raise InputError(
                f"arm {arm.name!r}: the files of {arm.of_one_recording} belong to one recording, and the study has "
                f"{len(scenes)} scenes",
                "a segmenter in Python serves all scenes: mstfilter.mst.frontends.Segmenter",
                "or make a study for each scene",
            )
    runs = tuple(
        StudyRun(arm, scene, seed, _hash([arm.key, scene.key, seed]))
        for scene in scenes
        for seed in study.seeds
        for arm in arms
    )
    return Plan(study, code, arms, scenes, runs, metrics)


def _arm(request: ArmRequest, versions: dict[str, str], code: str) -> Arm:
    with naming(f"arm {request.name!r}"):
        filter = build_filter(request.config(), allow_files=True)
        files = component_files(filter)
    config = as_json(describe_filter(filter))
    key = _hash([config, files, versions, code])
    own = [type(part).__name__ for part in nested_components(filter) if getattr(part, "of_one_recording", False)]
    return Arm(request.name, config, key, tuple(uses_truth(filter)), request.reported_only, ", ".join(own))


def build_metric(spec: str | Mapping[str, Any]) -> Metric:
    """An own metric from ``./file.py:Class``, or from a table with this as `component`, and fields."""
    name = spec if isinstance(spec, str) else spec.get("component")
    if not isinstance(name, str) or ".py:" not in name:
        raise InputError(f"metric is {spec!r}, expected ./FILE.py:CLASS or a table with it as `component`")
    metric = REGISTRY.build("metric", spec, allow_files=True)
    if not isinstance(metric, Metric):
        raise InputError(f"metric: {name} does not inherit Metric", "from mstfilter.scoring import Metric")
    return metric


def _metric(spec: str | Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    metric = build_metric(spec)
    config = as_json(REGISTRY.describe(metric))
    return _hash([config, component_files(metric)]), config


def family_of(source: Mapping[str, Any]) -> SceneFamily:
    """The scene family of a simulated scene, with its changes."""
    from mstfilter.lab.simulation import scene_family

    family = scene_family(source["family"])
    found: SceneFamily = REGISTRY.make(type(family), source["set"], f"scene family {source['family']!r}", base=family)
    return found


def _scenes(entry: SceneEntry, folder: Path) -> Iterator[StudyScene]:
    if entry.family:
        from mstfilter.lab.simulation import recipe_key

        named = {"objects": str((folder / entry.objects).resolve())} if entry.objects else {}
        source = {"family": entry.family, "set": {**entry.set, **named}}
        family = family_of(source)
        for seed in entry.seeds:
            recipe = {**source, "seed": seed}
            yield StudyScene(f"{entry.group_name}-{seed}", entry.group_name, recipe, recipe_key(family, seed))
        return
    for pattern in entry.recordings:
        paths = sorted(glob.glob(str(folder / pattern)))
        if not paths:
            raise InputError(f"recording does not exist: {folder / pattern}")
        for path in paths:
            source = {"path": str(Path(path).resolve()), "format": entry.format, "pauses": entry.pauses}
            source |= {"options": list(entry.options)}
            recording = open_recording(Path(path), entry.format, entry.options, entry.pauses)
            # Metrics and oracles depend on the ground truth.
            key = content_key(recording.key, recording.truth_key).hex()
            yield StudyScene(Path(path).name, entry.group_name, source, key)


def _unique_names(scenes: list[StudyScene]) -> tuple[StudyScene, ...]:
    """Put the group of a scene before its name if another scene has the same name."""
    count = Counter(scene.name for scene in scenes)
    return tuple(replace(s, name=f"{s.group}-{s.name}") if count[s.name] > 1 else s for s in scenes)


def _check_unique(what: str, named: list[tuple[str, str]]) -> None:
    """Raise InputError if a name or a key occurs twice."""
    name_of: dict[str, str] = {}
    for name, key in named:
        if key in name_of:
            raise InputError(
                f"two {what} are the same: {name_of[key]!r} and {name!r}", "remove one, or change its settings"
            )
        if name in name_of.values():
            hint = "give each a name" if what == "arms" else "give each a different group"
            raise InputError(f"two {what} are called {name!r}", hint)
        name_of[key] = name


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(as_json(value), sort_keys=True).encode()).hexdigest()[:32]
