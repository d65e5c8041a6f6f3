"""The output of ``mstfilter list``. The command needs only numpy and scipy."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from mstfilter.base.errors import InputError, MissingLibraryError
from mstfilter.base.reading import read_toml
from mstfilter.base.registry import default_of
from mstfilter.base.resources import find_preset, preset_names
from mstfilter.lab.oracles import UsesTruth
from mstfilter.runs.presets import REGISTRY


def print_list(kind: str) -> None:
    """Print presets, scene families and components of one kind, or of all kinds if `kind` is empty."""
    kinds = ["presets", "families", *REGISTRY.kinds]
    wanted = kind.removesuffix("s") if kind.removesuffix("s") in REGISTRY.kinds else kind
    if wanted and wanted not in kinds:
        raise InputError(f"there is no kind of component {kind!r}", f"there are: {', '.join(kinds)}")
    for name in [wanted] if wanted else kinds:
        print(f"{name}:")
        for line in _lines(name):
            print(f"  {line}")


def _lines(kind: str) -> Iterator[str]:
    """One line per preset, scene family or component."""
    if kind == "presets":
        for name in preset_names():
            yield f"{name:<20}{read_toml(find_preset(name), 'a preset').get('description', '')}"
        return
    if kind == "families":
        from mstfilter.lab.simulation import SCENE_FAMILIES

        for name, f in SCENE_FAMILIES.items():
            objects = f"{f.n_objects_min}-{f.n_objects_max}" if f.n_objects_min < f.n_objects_max else f.n_objects_max
            yield (
                f"{name:<20}{objects} objects, {f.n_actions} actions of {f.frames_per_clip} frames, "
                f"{f.width} x {f.height}, voxels {' x '.join(map(str, f.grid().shape))}"
            )
        return
    if not REGISTRY.known(kind):
        yield f"no component of this kind has a name; `mstfilter new {kind} mine.py` writes one"
    for name in REGISTRY.known(kind):
        try:
            cls = REGISTRY.find_class(kind, name)
        except InputError as error:
            why = error.hints[0] if isinstance(error, MissingLibraryError) else error.message
            yield f"{name:<20}not available: {why}"
            continue
        truth = " (uses the ground truth)" if issubclass(cls, UsesTruth) else ""
        summary = (cls.__doc__ or "").strip().split("\n")[0].rstrip(".")
        yield f"{name:<20}{summary}{truth}  [{_fields(cls)}]"


def _fields(cls: type) -> str:
    """Fields of a component and their defaults."""
    parts = []
    for field in dataclasses.fields(cls):
        value: Any = default_of(field)
        if value is dataclasses.MISSING:
            parts.append(field.name)
        elif dataclasses.is_dataclass(value):
            parts.append(f"{field.name}={REGISTRY.name_of(type(value))}")
        else:
            parts.append(f"{field.name}={value}")
    return ", ".join(parts)
