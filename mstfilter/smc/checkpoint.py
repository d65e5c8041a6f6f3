"""Storage of the state of a run, so that a new process continues the run with identical results.

>>> state, infos = filter.run(observations, seed=0, checkpoint="run.npz")     # run it again after an interruption

The file is an .npz of plain arrays, read and written without pickle. The file is written under a temporary name and
renamed. So a process that is killed leaves the state of a complete step. All draws depend on the seed and the step
only, so a continued run equals an uninterrupted one. A run with another seed, filter, model or observation is
refused. If the filter contains functions, another version of Python is refused too.

`ArrayCodec` stores particles that are arrays, mappings of arrays, or traces of arrays, numbers, strings and None.
Other particles need a `Codec`. Reading a file never imports code.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from hashlib import blake2b
from pathlib import Path
from types import CodeType, FunctionType, MethodType
from typing import Any

import numpy as np

from mstfilter.errors import InputError, reason
from mstfilter.files import atomic_path, writing
from mstfilter.reading import read_arrays
from mstfilter.smc.interfaces import Codec, State
from mstfilter.smc.population import Population
from mstfilter.smc.streams import Key

_FORMAT = 1


def save_state(
    path: Path, state: State, codec: Codec | None = None, *, compress: bool = False, **description: Any
) -> None:
    """Write a state after at least one step to an .npz file, atomically. The folder must exist.

    `codec` is for particles other than those of `ArrayCodec`. With `compress` the file is smaller, and writing is
    slower. Other values, of types that JSON represents, are stored by name. Raises InputError if the particles cannot
    be stored or the file cannot be written.
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
    with writing(f"checkpoint {path}"), atomic_path(path) as partial, partial.open("wb") as file:
        (np.savez_compressed if compress else np.savez)(file, allow_pickle=False, **arrays)


def load_state(path: Path, codec: Codec | None = None, *, limit: int = 2**40) -> tuple[State, dict[str, Any]]:
    """The state in a file, and the description stored with it.

    Raises InputError if the file is missing, damaged, not a checkpoint, or its arrays need more than `limit` bytes.
    """
    if not path.exists():
        raise InputError(f"checkpoint is missing: {path}")
    arrays = read_arrays(path, "a checkpoint", _DAMAGED, limit=limit)
    with _stored_state(path):
        head = json.loads(str(arrays["head"]))
        if head.get("format") != _FORMAT:
            raise InputError(f"checkpoint {path} has format {head.get('format')}, expected {_FORMAT}")
        particles = (codec or ArrayCodec()).decode(_below(arrays, "particles/"))
        population = Population(particles, arrays["log_weights"], _below(arrays, "parents/"))
        key = Key(int(head["seed"]), tuple(head["path"]))
        return State(int(head["t"]), population, key, bool(head["properly_weighted"])), head


_DAMAGED = "remove it to start again, or choose another file"


@contextmanager
def _stored_state(path: Path) -> Iterator[None]:
    """Turn errors about missing or wrong content in a block into InputError."""
    try:
        yield
    except InputError as error:
        message = error.message if str(path) in error.message else f"checkpoint {path}: {error.message}"
        raise InputError(message, *error.hints) from error
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path} is not a checkpoint of a filter ({type(error).__name__}: {reason(error)})", _DAMAGED
        ) from error


def _below(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name[len(prefix) :]: a for name, a in arrays.items() if name.startswith(prefix)}


class Checkpoint:
    """The .npz file that holds the state of a run, with a description of the filter and a hash of the observations.

    The components of the filter, their fields, functions and arrays are compared with those of the stored run.
    """

    def __init__(self, path: Path, codec: Codec | None, filter: Any, start: State) -> None:
        self.path, self.codec, self.start = path, codec, start
        self._description = _plain(filter)
        self._observed = blake2b(digest_size=16)

    def save(self, state: State, observation: Any) -> None:
        """Write the state after a step, and add the observation of the step to the hash."""
        self._observed.update(digest(observation).encode())
        description = {"filter": self._description, "begin": self.start.t, "observed": self._observed.hexdigest()}
        save_state(self.path, state, self.codec, **description)

    def resume(self, observations: Iterator[Any]) -> State:
        """The stored state, after removal of the observations that it contains; `start` if there is no file.

        Raises InputError if the file belongs to another run, with another seed, first step, filter or observation.
        """
        if not self.path.exists():
            if not self.path.parent.is_dir():
                raise InputError(f"folder of the checkpoint does not exist: {self.path.parent}")
            return self.start
        state, head = load_state(self.path, self.codec)
        wrong = (
            _difference("seed", state.key, self.start.key)
            or _difference("first step", head.get("begin"), self.start.t)
            or _difference("filter", head.get("filter"), self._description)
        )
        if wrong is not None:
            raise InputError(
                f"checkpoint {self.path} is of another run: its {wrong[0]} is {wrong[1]}, expected {wrong[2]}",
                "choose another file, or remove this one",
            )
        for t in range(self.start.t, state.t):
            try:
                self._observed.update(digest(next(observations)).encode())
            except StopIteration:
                raise InputError(
                    f"checkpoint {self.path} is at step {state.t}, and there are only {t} observations"
                ) from None
        if self._observed.hexdigest() != head.get("observed"):
            raise InputError(
                f"checkpoint {self.path} is of another run: its first {state.t - self.start.t} observations differ",
                "give the observations of that run, or choose another file",
            )
        return state


def digest(value: Any) -> str:
    """A hash of data, functions and components that is the same in every process with the same Python version.

    Functions are described by their code, the values that they enclose, and the numbers, arrays and functions of
    their module that they use. Objects are described by their fields. File names and addresses have no effect.
    """
    found = blake2b(digest_size=8)
    _describe_to(found.update, value, frozenset())
    return found.hexdigest()


def _describe_to(add: Callable[[bytes], None], value: Any, outer: frozenset[int]) -> None:
    """Add the description of a value to a hash. `outer` has the ids of the objects that contain it."""
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        add(f"array {value.dtype.str} {value.shape}".encode())
        add(np.ascontiguousarray(value).tobytes())
        return
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes, np.generic)):
        add(f"{type(value).__name__} {value!r};".encode())
        return
    add(f"{_name(value)}(".encode())
    if id(value) not in outer:
        for part in _parts(value):
            _describe_to(add, part, outer | {id(value)})
    add(b")")


def _parts(value: Any) -> Iterable[Any]:
    """The parts that describe a value in addition to its type."""
    if isinstance(value, Mapping):
        return (part for pair in value.items() for part in pair)
    if isinstance(value, (Sequence, np.ndarray)):
        return value
    if isinstance(value, (set, frozenset)):
        return sorted(map(digest, value))
    if isinstance(value, FunctionType):
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        return [value.__code__, value.__defaults__, value.__kwdefaults__, *cells, *_globals(value)]
    if isinstance(value, CodeType):
        return [value.co_code, value.co_names, *value.co_consts]
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, partial):
        return [value.func, value.args, value.keywords]
    if isinstance(value, type) or not hasattr(value, "__dict__"):
        return []
    if dataclasses.is_dataclass(value):
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    return [part for _, part in sorted(vars(value).items())]


def _globals(function: FunctionType) -> Iterator[Any]:
    """Numbers, strings, arrays and functions of its module that a function uses."""
    codes = [function.__code__]
    for code in codes:
        codes += [c for c in code.co_consts if isinstance(c, CodeType)]
    for name in sorted({name for code in codes for name in code.co_names}):
        value = function.__globals__.get(name)
        own = isinstance(value, FunctionType) and value.__module__ == function.__module__
        if own or isinstance(value, (int, float, str, tuple, np.ndarray)):
            yield value


def _name(value: Any) -> str:
    named = value if hasattr(value, "__qualname__") else type(value)
    return f"{named.__module__}.{named.__qualname__}" if hasattr(named, "__module__") else named.__qualname__


def _plain(value: Any) -> Any:
    """A value as JSON stores it. Functions, arrays and other objects are stored by name and hash."""
    if isinstance(value, np.generic):
        return _plain(value.item())
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (tuple, list)):
        return [_plain(v) for v in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"class": type(value).__qualname__, **fields}
    return f"{getattr(value, '__qualname__', type(value).__qualname__)} ({digest(value)})"


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
    """Arrays, mappings of arrays, and traces of programs of single particles."""

    def encode(self, particles: Any) -> dict[str, np.ndarray]:
        """Named arrays; ``form`` describes the particles in JSON."""
        if isinstance(particles, np.ndarray):
            return {_FORM: _json({"kind": "array"}), "x": _storable(particles, "the particles")}
        if isinstance(particles, Mapping):
            arrays = {f"x/{name}": _storable(np.asarray(a), f"{name!r}") for name, a in particles.items()}
            return {_FORM: _json({"kind": "mapping", "names": list(particles)}), **arrays}
        return self._encode_traces(particles)

    def _encode_traces(self, particles: Sequence[Any]) -> dict[str, np.ndarray]:
        from mstfilter.smc.programs.sites import Trace  # the language of programs is imported for programs only

        others = sorted({type(p).__qualname__ for p in particles if type(p) is not Trace})
        if others:
            raise InputError(f"particles of type {', '.join(others)} cannot be stored", _HINT)
        # Resampled particles are references: each object is stored once.
        distinct = {id(p): p for p in particles}
        numbers = {key: k for k, key in enumerate(distinct)}
        arrays = {"index": np.array([numbers[id(p)] for p in particles], np.int64)}
        rows = []
        for k, trace in enumerate(distinct.values()):
            rows.append({name: _describe(value, f"{name!r}") for name, value in trace.items()})
            for name, value in trace.items():
                if isinstance(value, (np.ndarray, np.generic)):
                    arrays[f"x/{k}/{name}"] = _storable(np.asarray(value), f"{name!r}")
        return {_FORM: _json({"kind": "traces", "rows": rows}), **arrays}

    def decode(self, arrays: Mapping[str, np.ndarray]) -> Any:
        form = json.loads(str(arrays[_FORM]))
        if form["kind"] == "array":
            return arrays["x"]
        if form["kind"] == "mapping":
            return {name: arrays[f"x/{name}"] for name in form["names"]}
        from mstfilter.smc.programs.sites import Trace

        made = [
            Trace({name: _restore(how, arrays.get(f"x/{k}/{name}")) for name, how in row.items()})
            for k, row in enumerate(form["rows"])
        ]
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
