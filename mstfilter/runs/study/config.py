"""A study as a TOML file, and the arms (configurations of the filter) that it compares.

>>> study = load_study("experiments/main/study.toml")
>>> study.arms[0].preset, study.scenes[0].family
>>> [arm.name for arm in expand_arms(study)]

``docs/studies.md`` has an example of a file.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from mstfilter.base.errors import InputError, naming
from mstfilter.base.reading import read_toml
from mstfilter.runs.presets import load_config

_MOST_SEEDS = 100_000  # of one entry
_MOST_ARMS = 10_000  # of one entry


def _seeds(value: Any) -> Any:
    """A tuple of seeds from a text such as ``"0-4, 7"``, a number or a list of numbers."""
    if isinstance(value, int) and not isinstance(value, bool):
        return (value,)
    if not isinstance(value, str):
        return value
    found: list[int] = []
    for part in value.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdigit() or (dash and not last.strip().isdigit()):
            raise ValueError(f"{value!r} is not of the form 0-4, 7")
        if dash and int(last) < int(first):
            raise ValueError(f"{part.strip()!r} ends before it starts")
        seeds = range(int(first), int(last if dash else first) + 1)
        if seeds.stop - seeds.start + len(found) > _MOST_SEEDS:
            raise ValueError(f"{value!r} are more than {_MOST_SEEDS} seeds")
        found.extend(seeds)
    return tuple(found)


Seeds = Annotated[tuple[Annotated[int, Field(ge=0)], ...], BeforeValidator(_seeds)]


def _several(value: Any) -> Any:
    """A tuple of one text or table."""
    return (value,) if isinstance(value, str | dict) else value


#: A text stands for a tuple of this text.
Texts = Annotated[tuple[str, ...], BeforeValidator(_several)]


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneEntry(_Entry):
    """Scenes: a family with seeds, or recordings of any format that `mstfilter run` reads."""

    family: str = ""  #: a simulated family; `set` changes its fields
    seeds: Seeds = ()  #: one scene for each
    set: dict[str, Any] = Field(default_factory=dict)  #: fields of the family
    objects: str = ""  #: folder of meshes of which the objects of the family are drawn
    recordings: Texts = ()  #: files or folders; a ``*`` stands for any text
    format: str = ""  #: how they are read, as for `mstfilter run`. Default: detected
    options: Texts = ()
    pauses: str = ""
    group: str = ""  #: name of the family in the tables. Default: the family's name, ``recordings`` for folders

    @property
    def group_name(self) -> str:
        """Name of the family in the tables."""
        return self.group or self.family or "recordings"

    @model_validator(mode="after")
    def _one_kind(self) -> SceneEntry:
        if bool(self.family) == bool(self.recordings):
            raise ValueError("needs either family and seeds, or recordings")
        if self.family and not self.seeds:
            raise ValueError(f"family {self.family!r} has no seeds")
        if self.recordings and (self.seeds or self.set or self.objects):
            raise ValueError("recordings have neither seeds, set nor objects")
        return self


class ArmEntry(_Entry):
    """An arm: a preset with changes. Each combination of comma-separated values is an arm of its own."""

    preset: Texts = ("mst",)  #: names, or paths of TOML files
    set: Texts = ()  #: changes ``path=value``, as for `mstfilter run`; ``path=a,b`` makes two arms
    name: str = ""  #: name in the tables. Default: the preset and the values that the grid varies
    #: True for an arm, such as a bound, that is reported but not part of the comparisons with adjusted p values.
    reported_only: bool = False


class StudyConfig(_Entry):
    """A study."""

    name: str  #: default: the name of the file
    description: str = ""
    arms: tuple[ArmEntry, ...] = ()  #: the arms to run
    scenes: tuple[SceneEntry, ...] = ()
    #: Seeds of the filter. For each scene, values are averaged over the seeds before arms are compared.
    seeds: Seeds = (0, 1, 2)
    reference: str = ""  #: the arm that the others are compared with. Default: the first
    #: {"all", "tables"}: keep the folder of each run, from which a report can be made, or only its metrics.
    keep: Annotated[str, Field(pattern="^(all|tables)$")] = "all"
    tries: Annotated[int, Field(ge=1)] = 3  #: how many times a run is started if its worker dies
    #: Time limit of a run in seconds, after which the run is started again, up to `tries` times. 0: no limit.
    timeout_s: Annotated[float, Field(ge=0)] = 0.0
    #: Memory of each worker in GB for intermediate results, which the runs of a recording share; 0: they share none.
    cache_gb: Annotated[float, Field(ge=0)] = 0.8
    #: Own metrics: ``./file.py:Class``, or tables with this as `component`, and fields.
    metric: Annotated[tuple[str | dict[str, Any], ...], BeforeValidator(_several)] = ()
    smoke: dict[str, Any] = Field(default_factory=dict)  #: replaces fields of the study under ``--smoke``
    folder: Path = Path()  # relative paths start here


def load_study(path: str | Path, *, smoke: bool = False) -> StudyConfig:
    """Read a study from a TOML file.

    `smoke` applies the table ``[smoke]``, which defines a small study for a quick test. Raises InputError if the file
    is missing, is not valid TOML, or has an unknown or invalid entry.
    """
    path = Path(path)
    data = read_toml(path, "a study")
    if smoke:
        small = data.get("smoke")
        if not small:
            raise InputError(
                f"study {path} has no table [smoke]", "add the entries that --smoke replaces, e.g. seeds = [0]"
            )
        data = {**data, **small}
    return study_of({"name": path.stem, **data, "folder": path.parent}, str(path))


def study_of(data: dict[str, Any], where: str = "study") -> StudyConfig:
    """A study from plain values, such as the content of a TOML file."""
    try:
        return StudyConfig(**data)
    except ValidationError as error:
        first = error.errors()[0]
        at = ".".join(str(part + 1 if isinstance(part, int) else part) for part in first["loc"])
        known = ", ".join(k for k in StudyConfig.model_fields if k != "folder")
        hints = (
            [f"fields of a study: {known}"] if first["type"] == "extra_forbidden" and len(first["loc"]) == 1 else []
        )
        message = first["msg"].removeprefix("Value error, ")
        raise InputError(f"{where}: {at}: {message[:1].lower()}{message[1:]}", *hints) from error


@dataclass(frozen=True)
class ArmRequest:
    """An arm (configuration of a filter) whose filter is not built yet."""

    name: str
    preset: str  #: name or path
    overrides: tuple[str, ...]
    reported_only: bool  #: reported, but not part of the comparisons

    def config(self) -> dict[str, Any]:
        """The configuration of the arm. Unknown names of components raise InputError."""
        return load_config(self.preset, self.overrides)


def take_metrics(study: StudyConfig, overrides: Sequence[str]) -> tuple[StudyConfig, list[str]]:
    """The study with the own metrics that overrides ``metric=./file.py:Class`` add, and the other overrides."""
    own = [text for text in overrides if text.partition("=")[0].strip() == "metric"]
    added = [one.partition("=")[2] for text in own for one in split_grid(text)]
    return study.model_copy(update={"metric": (*study.metric, *added)}), [o for o in overrides if o not in own]


def check_arm_names(study: StudyConfig, overrides: Sequence[str] = ()) -> None:
    """Raise InputError if an arm names an unknown preset or component. Components are not imported."""
    study, overrides = take_metrics(study, overrides)
    for request in expand_arms(study, overrides):
        with naming(f"arm {request.name!r}"):
            request.config()


def expand_arms(study: StudyConfig, overrides: Sequence[str] = ()) -> Iterator[ArmRequest]:
    """The arms of a study. Each combination of comma-separated values, also in `overrides`, is an arm."""
    for entry in study.arms:
        yield from _expand(entry, study.folder, overrides)


def _expand(entry: ArmEntry, folder: Path, overrides: Sequence[str]) -> Iterator[ArmRequest]:
    names = [name.strip() for text in entry.preset for name in text.split(",")]  # or files in the study's folder
    presets = [str(folder / n) if n.endswith(".toml") and (folder / n).is_file() else n for n in names]
    grids = [split_grid(text) for text in (*entry.set, *overrides)]
    if not presets or not all(presets):
        raise InputError(f"an arm names no preset: {list(entry.preset)}")
    if (n := len(presets) * math.prod(map(len, grids))) > _MOST_ARMS:
        raise InputError(
            f"the grid of an arm has {n} combinations, at most {_MOST_ARMS} are run: {', '.join(entry.set)}",
            "name fewer values, or write the combinations as arms of their own",
        )
    varied = [k for k, grid in enumerate(grids) if len(grid) > 1]
    for preset in presets:
        for chosen in itertools.product(*grids):
            if entry.name:
                words = [entry.name, *([_stem(preset)] if len(presets) > 1 else []), *(chosen[k] for k in varied)]
            else:
                shown = [k for k in range(len(grids)) if k < len(entry.set) or k in varied]
                words = [_stem(preset), *(chosen[k] for k in shown)]
            yield ArmRequest(" ".join(words), preset, chosen, entry.reported_only)


def _stem(preset: str) -> str:
    return Path(preset).stem if preset.endswith(".toml") else preset


def split_grid(text: str) -> list[str]:
    """``"path=a,b"`` as ``["path=a", "path=b"]``. Commas inside brackets and quotes do not separate values."""
    path, equals, values = text.partition("=")
    if not equals:
        return [text]
    parts, depth, quote, begin = [], 0, "", 0
    for k, letter in enumerate(values):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{(":
            depth += 1
        elif letter in "]})":
            depth -= 1
        elif letter == "," and depth == 0:
            parts.append(values[begin:k])
            begin = k + 1
    parts.append(values[begin:])
    if any(not part.strip() for part in parts):
        raise InputError(f"override {text!r} has an empty value", "for example resampler=systematic,residual")
    return [f"{path.strip()}={part.strip()}" for part in parts]
