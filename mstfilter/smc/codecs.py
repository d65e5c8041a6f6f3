"""Particles as named arrays and back, bit for bit; no pickle.

>>> arrays = ArrayCodec().encode({"x": np.zeros(3), "regime": np.array([0, 1, 1])})
>>> particles = ArrayCodec().decode(arrays)

`ArrayCodec` stores arrays, mappings of arrays, and sequences of dataclasses or mappings whose fields are arrays,
numbers, strings or None. A dataclass is made again from its fields by a class of that name which the running program
has loaded; stored data never import code. Particles of any other kind need a `Codec` of your own.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.interfaces import Codec
from mstfilter.smc.trace import Trace

__all__ = ["ArrayCodec"]

_FORM = "form"


@dataclasses.dataclass(frozen=True)
class ArrayCodec(Codec):
    """Arrays, mappings of arrays, and sequences of dataclasses or traces of arrays.

    Parameters
    ----------
    particle : type, optional
        The dataclass of the particles, where it cannot be found by name (it is defined inside a function).
    """

    particle: type | None = None

    def encode(self, particles: Any) -> dict[str, np.ndarray]:
        """Named arrays; ``form`` says in JSON what they were."""
        if isinstance(particles, np.ndarray):
            return {_FORM: _json({"kind": "array"}), "x": _storable(particles, "the particles")}
        if isinstance(particles, Mapping):
            arrays = {f"x/{name}": _storable(np.asarray(a), f"{name!r}") for name, a in particles.items()}
            return {_FORM: _json({"kind": "mapping", "names": list(particles)}), **arrays}
        return self._encode_objects(particles)

    def _encode_objects(self, particles: Sequence[Any]) -> dict[str, np.ndarray]:
        kind = type(particles[0])
        if any(type(p) is not kind for p in particles):
            names = sorted({type(p).__qualname__ for p in particles})
            raise InputError(f"particles of several types cannot be stored: {', '.join(names)}", _HINT)
        if kind is Trace:
            rows, form = [dict(p) for p in particles], {"kind": "traces"}
        elif dataclasses.is_dataclass(kind):
            rows = [{f.name: getattr(p, f.name) for f in dataclasses.fields(kind)} for p in particles]
            form = {"kind": "dataclass", "type": f"{kind.__module__}:{kind.__qualname__}"}
            if self.particle is not kind:
                _find(form["type"], kind)
        else:
            raise InputError(f"particles of type {kind.__qualname__} cannot be stored", _HINT)
        # Shared objects are stored once: resampled particles are references.
        first: dict[int, int] = {}
        index: list[int] = []
        described: list[dict[str, Any]] = []
        arrays: dict[str, np.ndarray] = {}
        for particle, row in zip(particles, rows, strict=True):
            k = first.setdefault(id(particle), len(first))
            index.append(k)
            if k < len(described):
                continue
            fields = {}
            for name, value in row.items():
                what = f"field {name!r} of {kind.__qualname__}"
                fields[name] = _describe(value, what)
                if isinstance(value, (np.ndarray, np.generic)):
                    arrays[f"x/{k}/{name}"] = _storable(np.asarray(value), what)
            described.append(fields)
        arrays["index"] = np.array(index, np.int64)
        return {_FORM: _json({**form, "rows": described}), **arrays}

    def decode(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """The particles."""
        form = json.loads(str(arrays[_FORM]))
        if form["kind"] == "array":
            return arrays["x"]
        if form["kind"] == "mapping":
            return {name: arrays[f"x/{name}"] for name in form["names"]}
        make: Any = Trace
        if form["kind"] == "dataclass":
            cls = self.particle or _find(form["type"])

            def make(row: dict[str, Any]) -> Any:
                return cls(**row)

        made = []
        for k, fields in enumerate(form["rows"]):
            row = {name: _restore(how, arrays.get(f"x/{k}/{name}")) for name, how in fields.items()}
            made.append(make(row))
        return tuple(made[k] for k in arrays["index"].tolist())


_HINT = "pass codec= a mstfilter.smc.interfaces.Codec that stores them as arrays"


def _describe(value: Any, what: str) -> Any:
    """A value as JSON: arrays by kind, tuples and dicts marked, the rest as it is (JSON keeps floats exactly)."""
    if isinstance(value, np.ndarray):
        return {"is": "array"}
    if isinstance(value, np.generic):
        return {"is": "number"}
    if isinstance(value, tuple):
        return {"is": "tuple", "of": [_describe(v, what) for v in value if not _is_array(v, what)]}
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    raise InputError(f"{what} is of type {type(value).__qualname__}, which cannot be stored", _HINT)


def _is_array(value: Any, what: str) -> bool:
    if isinstance(value, (np.ndarray, np.generic)):
        raise InputError(f"{what} is a tuple that holds arrays, which cannot be stored", _HINT)
    return False


def _restore(described: Any, array: np.ndarray | None) -> Any:
    if not isinstance(described, dict):
        return described
    if described["is"] == "tuple":
        return tuple(_restore(v, None) for v in described["of"])
    assert array is not None
    if described["is"] == "number":
        return array[()]
    array.flags.writeable = False
    return array


def _storable(array: np.ndarray, what: str) -> np.ndarray:
    if array.dtype.hasobject:
        raise InputError(f"{what} is an array of Python objects, which cannot be stored", _HINT)
    return array


def _json(value: Any) -> np.ndarray:
    return np.array(json.dumps(value))


def _find(location: str, expected: type | None = None) -> type:
    """A dataclass by name among the modules that are loaded already."""
    module, _, path = location.partition(":")
    found: Any = sys.modules.get(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    usable = isinstance(found, type) and dataclasses.is_dataclass(found)
    if not usable or (expected is not None and found is not expected):
        raise InputError(
            f"dataclass {location} cannot be found by its name",
            "define it at the top of a module that is imported before, or pass codec=ArrayCodec(TheClass)",
        )
    return found
