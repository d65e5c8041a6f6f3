"""What to keep of a run: numbers, arrays, functions of your own; and their table over many runs.

>>> history = collect(filter.iterate(observations, 0), ess=ess, mean=mean)
>>> history["ess"]                                   # (T,)
>>> table = history.to_xarray()                      # where xarray is installed

A collector is a function ``(state, info) -> number or array``, called after every step. `ess`, `unique_ancestors`,
`weight_entropy`, `log_evidence` and `mean` are here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError, MissingLibraryError
from mstfilter.smc.state import Info, State

__all__ = [
    "Collector",
    "History",
    "collect",
    "ess",
    "log_evidence",
    "mean",
    "n_particles",
    "resampled",
    "unique_ancestors",
    "weight_entropy",
]

Collector = Callable[[State, Info], Any]


def ess(state: State, info: Info) -> float:
    """Effective sample size after the update."""
    return info.ess


def unique_ancestors(state: State, info: Info) -> int:
    """Different particles of the previous population that have descendants."""
    return info.unique_ancestors


def weight_entropy(state: State, info: Info) -> float:
    """Entropy of the normalised weights in nats: log n where they are equal, 0 where one has all."""
    assert state.population is not None
    w = state.population.weights
    w = w[w > 0]
    return float(-(w @ np.log(w)))


def log_evidence(state: State, info: Info) -> float:
    """Log evidence so far; NaN where the filter does not report it."""
    found = state.log_evidence
    return np.nan if found is None else found


def resampled(state: State, info: Info) -> bool:
    """Whether the resampler was called."""
    return info.resampled


def n_particles(state: State, info: Info) -> int:
    """Particles after the step."""
    return info.n


def mean(state: State, info: Info) -> Any:
    """Weighted mean of particles that are an array."""
    assert state.population is not None
    if not isinstance(state.population.particles, np.ndarray):
        raise InputError(
            f"the mean of particles of type {type(state.population.particles).__name__} is not defined",
            "write a collector: lambda state, info: state.population.weights @ state.population.particles['x']",
        )
    return np.tensordot(state.population.weights, state.population.particles, axes=1)


@dataclass(frozen=True, eq=False)
class History(Mapping[str, np.ndarray]):
    """What was collected.

    Parameters
    ----------
    values_ : mapping
        Name -> array whose first axes are `dims`.
    dims : tuple of str
        ``("time",)`` for one run, ``("arm", "seed", "time")`` for many.
    coords : mapping
        Labels along the axes.
    state : State or None
        The last state of a single run.
    """

    values_: Mapping[str, np.ndarray]
    dims: tuple[str, ...] = ("time",)
    coords: Mapping[str, Any] = None  # type: ignore[assignment]
    state: State | None = None

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.values_:
            raise KeyError(f"nothing was collected as {name!r}; there is {', '.join(self.values_) or 'nothing'}")
        return self.values_[name]

    def __iter__(self) -> Any:
        return iter(self.values_)

    def __len__(self) -> int:
        return len(self.values_)

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` with the dimensions named.

        Raises
        ------
        MissingLibraryError
            Where xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise MissingLibraryError(
                "to_xarray needs the library xarray, which is not installed", "pip install 'mstfilter[xarray]'"
            ) from None
        data = {
            name: ((*self.dims, *(f"{name}_{k}" for k in range(a.ndim - len(self.dims)))), a)
            for name, a in self.values_.items()
        }
        return xarray.Dataset(data, coords=dict(self.coords or {}))


def collect(steps: Iterable[tuple[State, Info]], /, **collectors: Collector) -> History:
    """Go through a run and keep what the collectors return.

    Parameters
    ----------
    steps : iterable of (State, Info)
        ``filter.iterate(observations, seed)``.
    **collectors
        Name -> function of (state, info); its result has the same shape at every step.
    """
    rows: dict[str, list[Any]] = {name: [] for name in collectors}
    state, times = None, []
    for state, info in steps:
        times.append(info.t)
        for name, collector in collectors.items():
            rows[name].append(np.asarray(collector(state, info)))
    values = {name: _stack(name, row) for name, row in rows.items()}
    return History(values, ("time",), {"time": np.array(times, dtype=np.int64)}, state)


def _stack(name: str, rows: list[np.ndarray]) -> np.ndarray:
    shapes = {row.shape for row in rows}
    if len(shapes) > 1:
        raise InputError(
            f"collector {name!r} returned arrays of different shapes: {sorted(shapes)}",
            "reduce them to one shape, for example to a mean",
        )
    return np.stack(rows) if rows else np.zeros(0)
