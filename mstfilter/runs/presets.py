"""Presets: filters with a name, assembled from components.

>>> import mstfilter
>>> mst = mstfilter.preset("mst")
>>> mst = mstfilter.preset("mst", "n=10", "resampler=multinomial", "transition.rule=paper")

``mst`` is the default, ``paper`` the published algorithm, and ``authors`` the program of its authors. A preset is a
TOML file with the fields of `ParticleFilter`, one table for each component, and it can extend another one, so that it
lists only the differences. The files are in ``models/`` beside the package (installed as ``mstfilter/_models``);
``base.toml`` there has what `mst` and its baselines share; as it has no update, it is no preset by itself. In a file
that extends another,

=======================================  =============================================================================
``base = "base"``                        fields that are not named in the file are those of the base
``transition = "identity"``              naming a component resets its fields
``proposal.completer = "extrude"``       naming a field keeps the other fields
``wrap = { proposal = "first_pause" }``  the base's proposal becomes the field `proposal` of this component
=======================================  =============================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mstfilter import formats, scene, smc
from mstfilter.base.errors import InputError, suggestion
from mstfilter.base.reading import read_toml
from mstfilter.base.registry import Registry, merged, settings
from mstfilter.base.resources import find_preset
from mstfilter.lab import baselines, oracles
from mstfilter.mst import belief, completion, crossover, frontends, partition, segmentation, tracking
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
    *("initial", "transition", "proposal", "update", "resampler", "trigger", "lookahead", "rejuvenation"),
)


def preset(name: str = "mst", *overrides: str, allow_files: bool = True) -> ParticleFilter:
    """The filter of a preset.

    Parameters
    ----------
    name : str
        The preset, such as "mst", or the path of a TOML file.
    *overrides : str
        Changes ``path=value``, such as "n=10", "resampler=systematic" or "transition.rule=paper". Naming a component
        resets its fields; one of your own is ``./mine.py:Mine``, and the file is executed.
    allow_files : bool
        Whether components may be named by files.

    Raises
    ------
    InputError
        If a preset, component or field is unknown, or a library that a component needs is missing.
    """
    return build_filter(load_config(name, overrides, allow_files=allow_files), allow_files=allow_files)


def load_config(name: str, overrides: Iterable[str] = (), *, allow_files: bool = True) -> dict[str, Any]:
    """The configuration of a preset with overrides. Unknown names raise InputError. No component is imported."""
    config = settings(overrides, _read(name))
    unknown = set(config) - {*_META, *_FIELDS}
    if unknown:
        name = min(unknown)
        raise InputError(
            f"a filter has no field {name!r}", *suggestion(name, _FIELDS), f"fields: {', '.join(_FIELDS)}"
        )
    REGISTRY.check_names(ParticleFilter, config, allow_files)
    return config


def _read(name: str, parents: tuple[str, ...] = ()) -> dict[str, Any]:
    """The configuration in a preset file, merged into the configuration of the file's base."""
    path = find_preset(name, to_extend=bool(parents))
    config = read_toml(path, "a preset")
    base, wraps = config.pop("base", ""), config.pop("wrap", {})
    if not isinstance(base, str) or not isinstance(wraps, Mapping):
        raise InputError(f"preset {path}: base must be a name, and wrap a table of components by slot")
    if base in (*parents, name):
        raise InputError(f"preset {path} extends itself: {' -> '.join((*parents, name, base))}")
    extended = _read(base, (*parents, name)) if base else {}
    for slot, component in wraps.items():
        if slot not in extended:
            raise InputError(f"preset {path}: wrap.{slot} names no slot that its base sets")
        extended[slot] = {"component": component, slot: extended[slot]}
    return merged(extended, config)


def build_filter(config: Mapping[str, Any], *, allow_files: bool = False) -> ParticleFilter:
    """The filter of a configuration."""
    fields = {k: v for k, v in config.items() if k not in _META and v is not None}
    return REGISTRY.make(ParticleFilter, fields, allow_files=allow_files)


def describe_filter(filter: ParticleFilter) -> dict[str, Any]:
    """The configuration that builds an equal filter, including defaults."""
    config = REGISTRY.describe(filter)
    config.pop("component")
    return config
