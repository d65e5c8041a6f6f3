"""Components by name, and components from configuration.

>>> build("resampler", "systematic")
Systematic()
>>> build("update", {"component": "fusion", "eta": 3, "free_space": "none"})

A configuration is a nested mapping: a component is its name, or a mapping with ``component`` and fields. Names
are known without importing what they name. A user's own class is found as ``./file.py:Class`` (where files are
allowed) or by an entry point ``kind.name`` of the group ``mstfilter.components``.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import importlib
import importlib.util
import sys
import typing
from collections.abc import Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError

__all__ = ["COMPONENTS", "ORACLES", "build", "check_names", "describe", "find_class", "known"]

COMPONENTS: dict[str, dict[str, str]] = {
    "transition": {
        "tracking": "mstfilter.tracking:TrackingTransition",
        "identity": "mstfilter.tracking:IdentityTransition",
    },
    "proposal": {
        "tree_cuts": "mstfilter.segmentation:TreeCutProposal",
        "first_pause": "mstfilter.baselines:FirstPause",
        "image_components": "mstfilter.baselines:ImageComponents",
        "occupied_components": "mstfilter.baselines:OccupiedComponents",
        "one_blob": "mstfilter.baselines:OneBlob",
    },
    "update": {
        "fusion": "mstfilter.fusion:FusionUpdate",
        "object_fusion": "mstfilter.baselines:ObjectFusion",
        "projection": "mstfilter.fusion:ProjectionUpdate",
        "samples_only": "mstfilter.baselines:SamplesOnly",
        "tracking_only": "mstfilter.baselines:TrackingOnly",
        "union": "mstfilter.baselines:Union",
    },
    "resampler": {
        "multinomial": "mstfilter.smc:Multinomial",
        "residual": "mstfilter.smc:Residual",
        "stratified": "mstfilter.smc:Stratified",
        "systematic": "mstfilter.smc:Systematic",
        "residual_systematic": "mstfilter.smc:ResidualSystematic",
        "ssp": "mstfilter.smc:Ssp",
        "killing": "mstfilter.smc:Killing",
        "fearnhead_clifford": "mstfilter.smc:FearnheadClifford",
        "clusters": "mstfilter.smc:ClusterStratified",
        "kdpp": "mstfilter.smc:KDpp",
        "greedy_diverse": "mstfilter.smc:GreedyDiverse",
        "coalesced": "mstfilter.smc:Coalesced",
        "tempered": "mstfilter.smc:Tempered",
        "shuffled": "mstfilter.smc:Shuffled",
        "keep_weights": "mstfilter.smc:KeepWeights",
    },
    "trigger": {
        "always": "mstfilter.smc:Always",
        "ess": "mstfilter.smc:EssBelow",
        "every": "mstfilter.smc:Every",
        "never": "mstfilter.smc:Never",
    },
    "size": {
        "fixed": "mstfilter.smc:Fixed",
        "kld": "mstfilter.smc:Kld",
    },
    "similarity": {
        "gaussian": "mstfilter.smc:Gaussian",
        "weighted_coverage": "mstfilter.fusion:WeightedCoverage",
    },
    "equivalence": {
        "bins": "mstfilter.smc:Bins",
        "exact": "mstfilter.smc:Exact",
        "same_segmentation": "mstfilter.fusion:SameSegmentation",
    },
    "boundary": {
        "colour_depth": "mstfilter.segmentation:ColourDepthBoundary",
    },
    "tree": {
        "learned": "mstfilter.segmentation:LearnedTree",
        "ucm": "mstfilter.segmentation:UcmTree",
    },
    "value": {
        "scenecut": "mstfilter.segmentation:SceneCutObjectness",
        "merge_log_odds": "mstfilter.segmentation:MergeLogOdds",
    },
    "sampler": {
        "mh": "mstfilter.segmentation:MetropolisHastingsCuts",
        "exact": "mstfilter.segmentation:ExactCuts",
        "optimal": "mstfilter.segmentation:OptimalCut",
    },
    "completer": {
        "extrude": "mstfilter.completion:Extrude",
        "surface": "mstfilter.completion:SurfaceOnly",
    },
    "rule": {
        "authors": "mstfilter.tracking:AuthorsRule",
        "mst": "mstfilter.tracking:MstRule",
        "paper": "mstfilter.tracking:PaperRule",
    },
    "free_space": {
        "projective": "mstfilter.fusion:FreeSpace",
        "none": "mstfilter.fusion:NoFreeSpace",
    },
    "crossover": {"conflict_graph": "mstfilter.fusion:Crossover"},
    "structure": {
        "one_side_last": "mstfilter.fusion:OneSideLast",
        "random_order": "mstfilter.fusion:RandomOrder",
        "spanning_tree": "mstfilter.fusion:SpanningTree",
    },
    "division": {
        "none": "mstfilter.fusion:NoDivision",
        "rigid_motions": "mstfilter.fusion:RigidMotions",
    },
    "evidence": {"agreement": "mstfilter.fusion:Agreement"},
    "mode_filter": {"majority": "mstfilter.fusion:ModeFilter"},
    "format": {
        "recording": "mstfilter.formats:RecordingFolder",
        "pairs": "mstfilter.formats:PairedImages",
        "tum": "mstfilter.formats:Tum",
        "bop": "mstfilter.formats:Bop",
        "redwood": "mstfilter.formats:Redwood",
        "dsr": "mstfilter.formats:Dsr",
        "bag": "mstfilter.formats:Bag",
    },
    "pauses": {
        "still": "mstfilter.formats:Still",
        "at": "mstfilter.formats:At",
        "listed": "mstfilter.formats:Listed",
        "ends": "mstfilter.formats:Ends",
        "every": "mstfilter.formats:Every",
    },
}
#: Stages replaced by the truth of a recording (`mstfilter.oracles`): found by name as the others are, but of no use
#: without a recording that knows.
ORACLES: dict[str, dict[str, str]] = {
    "transition": {"true_motions": "mstfilter.oracles:TrueMotions"},
    "proposal": {"true_masks": "mstfilter.oracles:TrueMasks"},
    "update": {"true_fusion": "mstfilter.oracles:TrueFusion"},
    "resampler": {"true_best": "mstfilter.oracles:TrueBest"},
    "boundary": {"true_boundary": "mstfilter.oracles:TrueBoundary"},
    "completer": {"true_completion": "mstfilter.oracles:TrueCompletion"},
    "free_space": {"true_free_space": "mstfilter.oracles:TrueFreeSpace"},
    "evidence": {"true_quality": "mstfilter.oracles:TrueQuality"},
}
_SAME = {"initial": "proposal", "scheme": "resampler", "fusion": "update"}
_GROUP = "mstfilter.components"


def known(kind: str) -> dict[str, str]:
    """Names of a kind and where their classes are, entry points included."""
    names = {**COMPONENTS.get(kind, {}), **ORACLES.get(kind, {})}
    for entry in entry_points(group=_GROUP):
        slot, _, name = entry.name.partition(".")
        if slot == kind:
            names.setdefault(name, entry.value)
    return names


def kind_of(field: str) -> str | None:
    """The kind of component that a field of this name holds; None for plain values."""
    kind = _SAME.get(field, field)
    return kind if kind in COMPONENTS else None


def check_names(config: Mapping[str, Any], allow_files: bool = False, where: str = "") -> None:
    """Find unknown component names in a configuration, without importing any component."""
    for field, value in config.items():
        kind = kind_of(field)
        path = f"{where}{field}"
        if kind is not None:
            name = value.get("component") if isinstance(value, Mapping) else value
            for item in value if isinstance(value, list) else [name]:
                inner = item.get("component") if isinstance(item, Mapping) else item
                if isinstance(inner, str):
                    _locate(kind, inner, path, allow_files)
        if isinstance(value, Mapping):
            check_names(value, allow_files, f"{path}.")


def find_class(kind: str, name: str, where: str | None = None, allow_files: bool = False) -> type:
    """The class of a component name; imports it."""
    location = _locate(kind, name, where or kind, allow_files)
    module, _, attribute = location.partition(":")
    if module.endswith(".py"):
        return _from_file(Path(module), attribute)
    try:
        found = getattr(importlib.import_module(module), attribute)
    except ImportError as error:
        raise InputError(f"{where or kind}: component {name!r} cannot be imported: {error}") from error
    return found


def _locate(kind: str, name: str, where: str, allow_files: bool) -> str:
    if ".py:" in name:
        if not allow_files:
            raise InputError(
                f"{where}: {name!r} names a file, which is not loaded here", "only run, study and check load files"
            )
        if not Path(name.partition(":")[0]).is_file():
            raise InputError(f"{where}: file does not exist: {name.partition(':')[0]}")
        return name
    names = known(kind)
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1)
        hints = [f"did you mean {close[0]}?"] if close else []
        raise InputError(
            f"{where}: there is no {kind} {name!r}",
            *hints,
            f"there are: {', '.join(sorted(names))}; or ./file.py:Class",
        )
    return names[name]


def _from_file(path: Path, attribute: str) -> type:
    name = f"mstfilter_user_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{path} cannot be loaded: {type(error).__name__}: {error}") from error
    found = getattr(module, attribute, None)
    if not isinstance(found, type):
        raise InputError(f"{path} has no class {attribute!r}")
    found.__mst_file__ = f"{path}:{attribute}"  # type: ignore[attr-defined]
    found.__mst_source__ = hashlib.sha256(path.read_bytes()).hexdigest()  # type: ignore[attr-defined]
    return found


def build(kind: str, spec: Any, where: str | None = None, allow_files: bool = False, default: Any = None) -> Any:
    """A component from its name, or from a mapping with ``component`` and fields.

    Parameters
    ----------
    kind : str
        Key of `COMPONENTS`.
    spec : str or mapping
        What to build. A mapping without ``component`` changes fields of `default`.
    where : str, optional
        Path in the configuration, for messages.
    allow_files : bool
        Whether ``./file.py:Class`` is loaded.
    default : component, optional
        What a mapping that names no component changes.
    """
    where = where or kind
    if isinstance(spec, str):
        spec = {"component": spec}
    if not isinstance(spec, Mapping):
        raise InputError(f"{where} is {spec!r}, expected the name of a {kind} or a table")
    fields = dict(spec)
    name = fields.pop("component", None)
    if name is None:
        if default is None:
            raise InputError(
                f"{where} names no component", f"add component = one of {', '.join(sorted(known(kind)))}"
            )
        return make(type(default), fields, where, allow_files, default)
    return make(find_class(kind, name, where, allow_files), fields, where, allow_files)


def make(cls: type, fields: Mapping[str, Any], where: str, allow_files: bool = False, base: Any = None) -> Any:
    """An instance of a dataclass from plain values, nested components included; other fields are those of `base`."""
    if not dataclasses.is_dataclass(cls):
        raise InputError(f"{where}: {cls.__name__} is not a dataclass, so its fields cannot be configured")
    own = {f.name: f for f in dataclasses.fields(cls) if f.init}
    hints = typing.get_type_hints(cls)
    values = {}
    for name, value in fields.items():
        path = f"{where}.{name}" if where else name
        if name not in own:
            close = difflib.get_close_matches(name, own, n=1)
            raise InputError(
                f"{path}: {cls.__name__} has no field {name!r}",
                *([f"did you mean {close[0]}?"] if close else []),
                f"fields: {', '.join(own) or 'none'}",
            )
        kind = kind_of(name)
        current = default_of(own[name]) if base is None else getattr(base, name)
        part = current if dataclasses.is_dataclass(current) else None
        if kind is not None and isinstance(value, list):
            values[name] = tuple(build(kind, item, f"{path}[{k}]", allow_files) for k, item in enumerate(value))
        elif kind is not None and value is not None:
            values[name] = build(kind, value, path, allow_files, part)
        elif part is not None and isinstance(value, Mapping):
            # Part of a component that is no component itself: it has fields, but nothing can replace it.
            inner = {k: v for k, v in value.items() if k != "component"}
            values[name] = make(type(part), inner, path, allow_files, part)
        else:
            values[name] = _plain(hints[name], value, path)
    try:
        return cls(**values) if base is None else dataclasses.replace(base, **values)
    except InputError as error:
        raise InputError(f"{where}: {error.message}" if where else error.message, *error.hints) from error
    except TypeError as error:
        raise InputError(f"{where}: {error}") from error


def default_of(field: dataclasses.Field[Any]) -> Any:
    """The default of a dataclass field, made if it has a factory; MISSING where there is none."""
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _plain(hint: Any, value: Any, where: str) -> Any:
    """A plain value checked against a field's annotation."""
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(hint).validate_python(value)
    except ValidationError as error:
        raise InputError(f"{where} is {value!r}: {error.errors()[0]['msg'].lower()}") from error


def describe(component: Any) -> dict[str, Any]:
    """The configuration that builds a component again."""
    cls = type(component)
    out: dict[str, Any] = {"component": name_of(cls)}
    for field in dataclasses.fields(component):
        value = getattr(component, field.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            value = describe(value)
        elif isinstance(value, tuple):
            value = [describe(v) if dataclasses.is_dataclass(v) else v for v in value]
        out[field.name] = value
    return out


def name_of(cls: type) -> str:
    """The registered name of a class, its file, or its import path."""
    file = cls.__dict__.get("__mst_file__")
    if file is not None:
        return str(file)
    package = ".".join(cls.__module__.split(".")[:2])
    location = f"{package}:{cls.__qualname__}"
    for names in (*COMPONENTS.values(), *ORACLES.values()):
        for name, where in names.items():
            if where == location:
                return name
    return f"{cls.__module__}:{cls.__qualname__}"
