"""Storing the state of a run, so that a new process continues it to the identical result.

>>> state, infos = filter.run(observations, seed=0, checkpoint="run.npz")     # run it again after an interruption

The file is an .npz of plain arrays, read and written without pickle. It is written under a temporary name and
renamed, so that a process that is killed leaves the state of a complete step. All draws depend on the seed and the
step only, so a continued run equals an uninterrupted one.

`ArrayCodec` stores particles that are arrays, mappings of arrays, and sequences of dataclasses or traces whose fields
are arrays, numbers, strings or None. A dataclass is found by its name among the loaded modules; stored data never
import code. Particles of another kind need your own `Codec`.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.files import atomic_path
from mstfilter.smc.interfaces import Codec, State
from mstfilter.smc.population import Population
from mstfilter.smc.programs.sites import Trace
from mstfilter.smc.streams import Key

_FORMAT = 1


def save_state(
    path: Path, state: State, codec: Codec | None = None, *, compress: bool = False, **description: Any
) -> None:
    """Write a state atomically.

    Parameters
    ----------
    path : Path
        The .npz file; its folder exists.
    state : State
        After at least one step.
    codec : Codec, optional
        For particles other than arrays, mappings of arrays and dataclasses of arrays.
    compress : bool
        Compress the arrays: smaller, but slower.
    **description
        Further values to store, of types that JSON represents.

    Raises
    ------
    InputError
        If the particles cannot be stored or the file cannot be written.
    """
    population = state.population
    if population is None:
        raise InputError("a state without particles cannot be stored", "store it after a step")
    head = {
        "format": _FORMAT,
        "t": state.t,
        "seed": state.key.seed,
        "path": list(state.key.path),
        "properly_weighted": state.properly_weighted,
        **description,
    }
    arrays = {
        "head": np.array(json.dumps(head)),
        "log_weights": population.log_weights,
        **{f"parents/{name}": index for name, index in population.parents.items()},
        **{f"particles/{name}": a for name, a in (codec or ArrayCodec()).encode(population.particles).items()},
    }
    try:
        with atomic_path(path) as partial, partial.open("wb") as file:
            (np.savez_compressed if compress else np.savez)(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise InputError(f"cannot write checkpoint {path}: {error.strerror}") from error


def load_state(path: Path, codec: Codec | None = None) -> tuple[State, dict[str, Any]]:
    """The state in a file, and the description stored with it."""
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        head = json.loads(str(arrays["head"]))
    except FileNotFoundError:
        raise InputError(f"checkpoint is missing: {path}") from None
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"checkpoint cannot be read: {path} ({error})", "remove it to start again") from error
    if head.get("format") != _FORMAT:
        raise InputError(f"checkpoint {path} has format {head.get('format')}, expected {_FORMAT}")
    particles = (codec or ArrayCodec()).decode(_below(arrays, "particles/"))
    population = Population(particles, arrays["log_weights"], _below(arrays, "parents/"))
    key = Key(head["seed"], tuple(head["path"]))
    return State(head["t"], population, key, head["properly_weighted"]), head


def _below(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name[len(prefix) :]: a for name, a in arrays.items() if name.startswith(prefix)}


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The file that holds the state of a run.

    Parameters
    ----------
    path : Path
        The .npz file.
    codec : Codec, optional
        For other particles than those of `ArrayCodec`.
    """

    path: Path
    codec: Codec | None = None

    def save(self, filter: Any, state: State) -> None:
        """Write the state of a run of `filter`."""
        save_state(self.path, state, self.codec, filter=_plain(filter))

    def load(self, filter: Any, start: State) -> State | None:
        """The stored state; None if there is no file.

        Raises
        ------
        InputError
            If the file is of another run: another seed, other components or fields, or a step before `start`.
            Functions and observations are not compared.
        """
        if not self.path.exists():
            if not self.path.parent.is_dir():
                raise InputError(f"folder of the checkpoint does not exist: {self.path.parent}")
            return None
        state, head = load_state(self.path, self.codec)
        wrong = _difference("seed", state.key, start.key)
        wrong = wrong or _difference("filter", head.get("filter"), _plain(filter))
        if wrong is not None:
            what, found, wanted = wrong
            raise InputError(
                f"checkpoint {self.path} is of another run: its {what} is {found}, expected {wanted}",
                "choose another file, or remove this one",
            )
        if state.t < start.t:
            raise InputError(f"checkpoint {self.path} is at step {state.t}, before the state to continue from")
        return state


def _plain(value: Any) -> Any:
    """A value as JSON stores it; the type of functions and arrays."""
    if isinstance(value, np.generic):
        return _plain(value.item())
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (tuple, list)):
        return [_plain(v) for v in value]
    if dataclasses.is_dataclass(value):
        fields = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"class": type(value).__qualname__, **fields}
    return type(value).__qualname__


def _difference(what: str, found: Any, wanted: Any) -> tuple[str, Any, Any] | None:
    """Name, found and expected value of the first entry that differs."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for name in {**found, **wanted}:
            first = _difference(f"{what}.{name}", found.get(name), wanted.get(name))
            if first is not None:
                return first
        return None
    return None if found == wanted else (what, found, wanted)


_FORM = "form"


@dataclasses.dataclass(frozen=True)
class ArrayCodec(Codec):
    """Arrays, mappings of arrays, and sequences of dataclasses or traces of arrays.

    Parameters
    ----------
    particle : type, optional
        The dataclass of the particles, if it cannot be found by name because it is defined inside a function.
    """

    particle: type | None = None

    def encode(self, particles: Any) -> dict[str, np.ndarray]:
        """Named arrays; ``form`` describes the particles in JSON."""
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
        # Resampled particles are references: each object is stored once.
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


_HINT = "pass codec=, a mstfilter.smc.Codec that stores them as arrays"


def _describe(value: Any, what: str, in_tuple: bool = False) -> Any:
    """A value as JSON, which keeps floats exactly; arrays and tuples are marked."""
    if isinstance(value, (np.ndarray, np.generic)):
        if in_tuple:
            raise InputError(f"{what} is a tuple that holds arrays, which cannot be stored", _HINT)
        return {"is": "array" if isinstance(value, np.ndarray) else "number"}
    if isinstance(value, tuple):
        return {"is": "tuple", "of": [_describe(v, what, True) for v in value]}
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    raise InputError(f"{what} is of type {type(value).__qualname__}, which cannot be stored", _HINT)


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
    """A dataclass by its name, among the loaded modules."""
    module, _, path = location.partition(":")
    found: Any = sys.modules.get(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    usable = isinstance(found, type) and dataclasses.is_dataclass(found)
    if not usable or (expected is not None and found is not expected):
        raise InputError(
            f"dataclass {location} cannot be found by its name",
            "define it at the top level of a module that is imported first, or pass codec=ArrayCodec(TheClass)",
        )
    return found
