"""The state of a run on disk: written after every step, taken up in a new process to the identical result.

>>> state, infos = filter.run(observations, seed=0, checkpoint="run.npz")     # killed? run it again

The file is an .npz of plain arrays (`allow_pickle=False`). It is written under a temporary name and renamed, so a
process that is killed at any moment leaves the state of one whole step or of the one before. What is drawn depends on
the seed and the step alone, so the rest of the run is that of a run that was never stopped.
"""

from __future__ import annotations

import dataclasses
import json
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.codecs import ArrayCodec
from mstfilter.smc.interfaces import Codec
from mstfilter.smc.population import Population
from mstfilter.smc.state import State
from mstfilter.smc.streams import Key

if TYPE_CHECKING:
    from mstfilter.smc.particle_filter import ParticleFilter

__all__ = ["Checkpoint", "load_state", "save_state"]

FORMAT = 1


def save_state(path: Path, state: State, codec: Codec | None = None, **description: Any) -> None:
    """Write a state as a whole or not at all.

    Parameters
    ----------
    path : Path
        The .npz file; its folder exists.
    state : State
        After at least one step.
    codec : Codec, optional
        For particles other than arrays, mappings of arrays and dataclasses of arrays.
    **description
        JSON-able values to be stored beside.

    Raises
    ------
    InputError
        Where the particles cannot be stored or the file cannot be written.
    """
    population = state.population
    if population is None:
        raise InputError("a state without particles cannot be stored", "store it after a step")
    head = {
        "format": FORMAT,
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
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"cannot write checkpoint {path}: {error.strerror}") from error


def load_state(path: Path, codec: Codec | None = None) -> tuple[State, dict[str, Any]]:
    """The state in a file, and what was stored beside it."""
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        head = json.loads(str(arrays["head"]))
    except FileNotFoundError:
        raise InputError(f"checkpoint is missing: {path}") from None
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"checkpoint cannot be read: {path} ({error})", "remove it to start anew") from error
    if head.get("format") != FORMAT:
        raise InputError(f"checkpoint {path} has format {head.get('format')}, expected {FORMAT}")
    particles = (codec or ArrayCodec()).decode(_below(arrays, "particles/"))
    population = Population(particles, arrays["log_weights"], _below(arrays, "parents/"))
    key = Key(head["seed"], tuple(head["path"]))
    return State(head["t"], population, key, head["properly_weighted"]), head


def _below(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name[len(prefix) :]: a for name, a in arrays.items() if name.startswith(prefix)}


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Where a run keeps its state.

    Parameters
    ----------
    path : Path
        The .npz file.
    codec : Codec, optional
        For particles of your own.
    """

    path: Path
    codec: Codec | None = None

    def save(self, filter: ParticleFilter, state: State) -> None:
        """Write the state of a run of `filter`."""
        save_state(self.path, state, self.codec, filter=_outline(filter))

    def load(self, filter: ParticleFilter, start: State) -> State | None:
        """The state to go on from; None where nothing is stored.

        Raises
        ------
        InputError
            Where the file is of another run: other seed, other components or fields, or earlier than `start`.
            Functions and observations are not compared.
        """
        if not self.path.exists():
            if not self.path.parent.is_dir():
                raise InputError(f"folder of the checkpoint does not exist: {self.path.parent}")
            return None
        state, head = load_state(self.path, self.codec)
        wrong = _difference("seed", state.key, start.key)
        wrong = wrong or _difference("filter", head.get("filter"), _outline(filter))
        if wrong is not None:
            what, found, wanted = wrong
            raise InputError(
                f"checkpoint {self.path} is of another run: its {what} is {found}, that of this run {wanted}",
                "choose another file, or remove this one",
            )
        if state.t < start.t:
            raise InputError(f"checkpoint {self.path} is at step {state.t}, before the state to go on from")
        return state


def _outline(filter: ParticleFilter) -> dict[str, Any]:
    """What can be said of a filter without knowing its models: its components with their plain fields, its sizes."""
    return {
        field.name: _plain(value)
        for field in dataclasses.fields(filter)
        if (value := getattr(filter, field.name)) is not None
    }


def _plain(value: Any) -> Any:
    """A value as JSON keeps it; of what it cannot keep (functions, arrays) the type."""
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
    """The first entry that differs, by name."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for name in {**found, **wanted}:
            first = _difference(f"{what}.{name}", found.get(name), wanted.get(name))
            if first is not None:
                return first
        return None
    return None if found == wanted else (what, found, wanted)
