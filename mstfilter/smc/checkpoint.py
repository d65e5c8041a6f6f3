"""Stores the state of a run, so that a new process can continue the run with identical results.

The random numbers of a step are named by seed, step and component (`mstfilter.smc.streams`), and no generator runs
along. So the rest of a run depends on the `State` alone: the number of observations, the weighted particles, and the
key of the seed. That is what the file holds:

>>> from mstfilter.smc import Normal, StateSpaceModel, bootstrap, load_state, save_state
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> states, observations = model.simulate(50, seed=1)
>>> filter = bootstrap(model, n=100)
>>> for state, info in filter.iterate(observations[:20], seed=0):
...     save_state("run.npz", state)                                 # killed after 20 steps
>>> state = load_state("run.npz")                                    # later, or in another process
>>> state, infos = filter.run(observations[state.t:], state)
>>> state.log_evidence == filter.run(observations, seed=0)[0].log_evidence
True

The file is an .npz of plain arrays, read and written without pickle. Loading it never imports code. The file is
written under a temporary name and then renamed, so it holds the state of a complete step even if the process is
killed. The file stores no filter and no observations: pass both to the continued run. Particles that are neither
arrays nor mappings of arrays need a `Codec`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, reason
from mstfilter.base.files import atomic_path, writing
from mstfilter.base.reading import read_arrays
from mstfilter.smc.interfaces import Codec, State
from mstfilter.smc.population import Population
from mstfilter.smc.streams import Key

_FORMAT = 1


def save_state(path: Path | str, state: State, codec: Codec | None = None, *, compress: bool = False) -> None:
    """Write a state to an .npz file, atomically. The run must have made a step, and the folder must exist.

    `codec` encodes particles that `ArrayCodec` cannot store. `compress` makes the file smaller and writing slower.
    Raises InputError if the particles cannot be stored or the file cannot be written.
    """
    path, population = Path(path), state.population
    if population is None:
        raise InputError("a state without particles cannot be stored", "store it after a step")
    head = {
        "format": _FORMAT,
        "t": state.t,
        "seed": state.key.seed,
        "path": list(state.key.path),
        "properly_weighted": state.properly_weighted,
    }
    arrays = {
        "head": np.array(json.dumps(head)),
        "log_weights": population.log_weights,
        **{f"parents/{name}": index for name, index in population.parents.items()},
        **{f"particles/{name}": a for name, a in (codec or ArrayCodec()).encode(population.particles).items()},
    }
    with writing(f"checkpoint {path}"), atomic_path(path) as partial, partial.open("wb") as file:
        (np.savez_compressed if compress else np.savez)(file, allow_pickle=False, **arrays)


def load_state(path: Path | str, codec: Codec | None = None, *, limit: int = 2**40) -> State:
    """The state stored in a file.

    Raises InputError if the file is missing, damaged or no checkpoint, or if its arrays need more than `limit` bytes.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"checkpoint is missing: {path}")
    arrays = read_arrays(path, "a checkpoint", _DAMAGED, limit=limit)
    try:
        head = json.loads(str(arrays["head"]))
        if head.get("format") != _FORMAT:
            raise InputError(f"checkpoint {path} has format {head.get('format')}, expected {_FORMAT}")
        particles = (codec or ArrayCodec()).decode(_below(arrays, "particles/"))
        population = Population(particles, arrays["log_weights"], _below(arrays, "parents/"))
        key = Key(int(head["seed"]), tuple(head["path"]))
        return State(int(head["t"]), population, key, bool(head["properly_weighted"]))
    except InputError as error:
        if str(path) in error.message:
            raise
        raise error.with_message(f"checkpoint {path}: {error.message}") from error
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path} is not a checkpoint of a filter ({type(error).__name__}: {reason(error)})", _DAMAGED
        ) from error


_DAMAGED = "remove it to start again, or choose another file"


def _below(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name[len(prefix) :]: a for name, a in arrays.items() if name.startswith(prefix)}


@dataclasses.dataclass(frozen=True)
class ArrayCodec(Codec):
    """Stores an array of particles as ``x``, and a mapping of arrays as ``x/NAME``."""

    def encode(self, particles: Any) -> dict[str, np.ndarray]:
        if isinstance(particles, np.ndarray):
            return {"x": _storable(particles, "the particles")}
        if isinstance(particles, Mapping):
            return {f"x/{name}": _storable(np.asarray(a), f"{name!r}") for name, a in particles.items()}
        kinds = sorted({type(p).__qualname__ for p in particles})
        raise InputError(f"particles of type {', '.join(kinds)} cannot be stored", _HINT)

    def decode(self, arrays: Mapping[str, np.ndarray]) -> Any:
        return arrays["x"] if "x" in arrays else {name.removeprefix("x/"): a for name, a in arrays.items()}


_HINT = "pass codec=, a mstfilter.smc.Codec that stores them as arrays"


def _storable(array: np.ndarray, what: str) -> np.ndarray:
    if array.dtype.hasobject:
        raise InputError(f"{what} is an array of Python objects, which cannot be stored", _HINT)
    return array
