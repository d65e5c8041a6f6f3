"""Assembled filters by name.

>>> import mstfilter
>>> mst = mstfilter.preset("mst")
>>> mst = mstfilter.preset("mst", "n=10", "resampler=multinomial", "transition.rule=paper")

``mst`` is the default, ``paper`` the published algorithm, ``authors`` the program of its authors. A preset is a TOML
file with the fields of `ParticleFilter`, one table for each component. It may extend another preset:

    base = "mst"                            # all other fields are those of mst
    wrap = ["update.fusion=union"]          # the update of mst becomes the field `fusion` of the component `union`
    overrides = ["transition=identity"]     # changes, as on the command line
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

from mstfilter import (
    baselines,
    belief,
    completion,
    crossover,
    formats,
    frontends,
    oracles,
    partition,
    scene,
    segmentation,
    smc,
    tracking,
)
from mstfilter.errors import InputError, suggestion
from mstfilter.reading import read_toml
from mstfilter.registry import Registry
from mstfilter.resources import find_preset
from mstfilter.smc import ParticleFilter

#: Packages that declare components.
PACKAGES = (
    *(smc, scene, segmentation, completion, tracking, partition, crossover, belief),
    *(frontends, formats, baselines, oracles),
)
#: All components that presets and overrides can name.
REGISTRY = Registry(*PACKAGES)

_META = ("description", "source")
_FIELDS = (
    *("n", "n_proposed", "resample"),
    *("initial", "transition", "proposal", "update", "resampler", "trigger", "size", "lookahead", "rejuvenation"),
)


def preset(name: str = "mst", *overrides: str, allow_files: bool = True) -> ParticleFilter:
    """The filter of a preset, by name or path of a TOML file, with overrides ``path=value``."""
    return build_filter(load_config(name, overrides, allow_files=allow_files), allow_files=allow_files)


def load_config(name: str, overrides: Iterable[str] = (), *, allow_files: bool = True) -> dict[str, Any]:
    """The configuration of a preset with overrides. Unknown names raise InputError; no component is imported."""
    config = _read(name)
    for override in overrides:
        _override(config, override)
    unknown = set(config) - {*_META, *_FIELDS}
    if unknown:
        name = min(unknown)
        raise InputError(
            f"a filter has no field {name!r}", *suggestion(name, _FIELDS), f"fields: {', '.join(_FIELDS)}"
        )
    REGISTRY.check_names(ParticleFilter, config, allow_files)
    return config


def _read(name: str, parents: tuple[str, ...] = ()) -> dict[str, Any]:
    """The content of a preset's file, added to that of its base."""
    path = find_preset(name)
    config = read_toml(path, "a preset")
    base, wraps, changes = config.pop("base", ""), config.pop("wrap", []), config.pop("overrides", [])
    if not isinstance(base, str) or any(not isinstance(v, list) for v in (wraps, changes)):
        raise InputError(f"preset {path}: base must be a name, wrap and overrides lists of path=value")
    if base in (*parents, name):
        raise InputError(f"preset {path} extends itself: {' -> '.join((*parents, name, base))}")
    if base:
        config = {**_read(base, (*parents, name)), **config}
    for wrap in wraps:
        path_text, _, component = str(wrap).partition("=")
        slot, _, field = path_text.partition(".")
        if slot not in config or not field or not component:
            raise InputError(
                f"preset {path}: wrap {wrap!r} is not slot.field=component of a slot that is set",
                "for example update.fusion=union",
            )
        config[slot] = {"component": component, field: config[slot]}
    for change in changes:
        _override(config, str(change))
    return config


def build_filter(config: Mapping[str, Any], *, allow_files: bool = False) -> ParticleFilter:
    """The filter of a configuration."""
    fields = {k: v for k, v in config.items() if k not in _META and v is not None}
    return REGISTRY.make(ParticleFilter, fields, allow_files=allow_files)


def describe_filter(filter: ParticleFilter) -> dict[str, Any]:
    """The configuration that builds a filter again, defaults included."""
    config = REGISTRY.describe(filter)
    config.pop("component")
    return config


def settings(overrides: Iterable[str]) -> dict[str, Any]:
    """Nested settings from ``path=value`` texts."""
    config: dict[str, Any] = {}
    for override in overrides:
        _override(config, override)
    return config


def _override(config: dict[str, Any], text: str) -> None:
    """Apply ``path=value``. Naming a component resets its fields; naming a field keeps the others."""
    path, equals, value = text.partition("=")
    parts = path.strip().split(".")
    if not equals or not all(parts) or not value.strip():
        raise InputError(
            f"override {text!r} is not of the form path=value",
            "for example resampler=systematic or transition.rule=paper",
        )
    table = config
    for part in parts[:-1]:
        inner = table.get(part, {})
        if not isinstance(inner, (str, Mapping)):
            raise InputError(f"override {text!r}: {part} is {inner!r}, which has no fields")
        table[part] = {"component": inner} if isinstance(inner, str) else dict(inner)
        table = table[part]
    table[parts[-1]] = _value(value.strip())


def _value(text: str) -> Any:
    """The value of a text in TOML syntax, or the text itself if it is not valid TOML."""
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text
