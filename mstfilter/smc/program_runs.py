"""Ways to run a program: draw, propose by a guide, replay what a guide drew, put means in place of draws, score.

>>> particles, gain = execute(model, Draw(rng), previous, observation, n)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.distribution import Distribution
from mstfilter.smc.population import Particles
from mstfilter.smc.program_sites import _RUN, Handler, Run
from mstfilter.smc.streams import child
from mstfilter.smc.trace import Trace

__all__ = [
    "Centre",
    "Draw",
    "Guide",
    "PerParticle",
    "Replay",
    "Score",
    "Site",
    "execute",
    "kept",
    "per_particle",
    "run_once",
]


@dataclass(frozen=True)
class PerParticle:
    """A program that is run once for every particle; made by `per_particle`.

    Parameters
    ----------
    function : callable
        ``(previous, observation)``; `previous` is the particle's `Trace`.
    """

    function: Callable[[Any, Any], Any]

    def __call__(self, previous: Any, observation: Any) -> Any:
        """Run it."""
        return self.function(previous, observation)


def per_particle(function: Callable[[Any, Any], Any]) -> PerParticle:
    """Mark a program whose set of sites may differ between particles. It runs once for every particle: slower."""
    return PerParticle(function)


class Draw(Handler):
    """Every site is drawn."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def site(
        self, name: str, distribution: Distribution, size: int, rows: np.ndarray | None, branch: bool
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """A draw."""
        return distribution.sample(self.rng, size), None

    def row(self, index: int) -> Draw:
        """A stream of its own."""
        return Draw(child(self.rng, "particle", index))


class Guide(Handler):
    """Draws, and remembers values and their log densities."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.values: dict[str, np.ndarray] = {}
        self.log_q: dict[str, np.ndarray] = {}
        self.rows: list[Guide] = []
        self.n = 0

    def site(
        self, name: str, distribution: Distribution, size: int, rows: np.ndarray | None, branch: bool
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """A draw."""
        value = distribution.sample(self.rng, size)
        log_q = self.log_q.setdefault(name, np.zeros(self.n))
        target: Any = slice(None) if rows is None else rows
        log_q[target] = distribution.log_prob(value)
        return value, None

    def row(self, index: int) -> Guide:
        """A stream of its own."""
        self.rows.append(Guide(child(self.rng, "particle", index)))
        return self.rows[-1]


class Replay(Handler):
    """Takes a guide's draws and weighs them by f / q."""

    def __init__(self, guide: Guide) -> None:
        self.guide = guide

    def site(
        self, name: str, distribution: Distribution, size: int, rows: np.ndarray | None, branch: bool
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The guide's draw."""
        if name not in self.guide.values:
            raise InputError(
                f"the guide has no site {name!r}, which the model samples",
                f'add sample("{name}", ...) to the guide; it has {sorted(self.guide.values)}',
            )
        target: Any = slice(None) if rows is None else rows
        value = self.guide.values[name][target]
        return value, distribution.log_prob(value) - self.guide.log_q[name][target]

    def row(self, index: int) -> Replay:
        """Of one particle."""
        return Replay(self.guide.rows[index])


class Centre(Handler):
    """Every site is the mean of its distribution (mode where discrete)."""

    def site(
        self, name: str, distribution: Distribution, size: int, rows: np.ndarray | None, branch: bool
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The centre."""
        centre = np.asarray(distribution.centre)
        inner = centre.shape[1:] if centre.ndim and len(centre) in (1, size) else centre.shape
        return np.broadcast_to(centre, (size, *inner)), None

    def row(self, index: int) -> Centre:
        """Itself."""
        return self


@dataclass(frozen=True)
class Site:
    """A site as it was met: its distribution, the particles concerned, whether it chose a branch."""

    name: str
    distribution: Distribution
    rows: np.ndarray | None
    branch: bool


class Score(Handler):
    """Takes given values, weighs them by their density, and remembers the sites."""

    def __init__(self, values: Mapping[str, Any], single: bool = False) -> None:
        self.values, self.single = values, single  # single: values of one particle, without the particle axis
        self.sites: list[Site] = []

    def site(
        self, name: str, distribution: Distribution, size: int, rows: np.ndarray | None, branch: bool
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The given value."""
        if name not in self.values:
            raise InputError(f"there is no value for site {name!r}")
        self.sites.append(Site(name, distribution, rows, branch))
        value = np.asarray(self.values[name])[None] if self.single else self.values[name]
        value = value if rows is None else value[rows]
        return value, distribution.log_prob(value)

    def row(self, index: int) -> Score:
        """Not used: moves of per-particle programs score one trace at a time."""
        raise NotImplementedError


def execute(
    model: Callable[[Any, Any], Any],
    handler: Handler,
    previous: Particles | None,
    observation: Any,
    n: int,
    structured_as: Callable[[Any, Any], Any] | None = None,
) -> tuple[Particles, np.ndarray]:
    """Run a program over n particles.

    Parameters
    ----------
    model : callable
        The program, or its guide.
    handler : Handler
        Decides the values of sites.
    previous : particles or None
        x_{t-1}.
    observation : Any
        y_t.
    n : int
        Particles.
    structured_as : callable, optional
        The model that `model` guides: both run for all particles at once, or both one by one.

    Returns
    -------
    particles : mapping of arrays (n, ...), or tuple of n `Trace`
        Values of the sites, and what the program returned.
    gain : (n,) float64
        What the log weights gain.
    """
    other = model if structured_as is None else structured_as
    if isinstance(model, PerParticle) != isinstance(other, PerParticle):
        raise InputError("model and guide must both be per_particle, or neither")
    if not isinstance(model, PerParticle):
        run = run_once(model, handler, previous, observation, n, False)
        return kept(run), run.gain
    runs = [
        run_once(model.function, handler.row(i), None if previous is None else previous[i], observation, 1, True)
        for i in range(n)
    ]
    return tuple(Trace(kept(r)) for r in runs), np.concatenate([r.gain for r in runs])


def run_once(
    function: Callable[[Any, Any], Any], handler: Handler, previous: Any, observation: Any, n: int, single: bool
) -> Run:
    """One pass of a function, `single` without the particle axis."""
    run = Run(handler, n, single)
    if isinstance(handler, Guide):
        handler.n = n
    token = _RUN.set(run)
    try:
        returned = function(previous, observation)
    except ValueError as error:
        if single or "truth value of an array" not in str(error):
            raise
        raise InputError(
            "the program decides by an array that holds all particles (if, and, or, while)",
            "use switch(name, probs, branches), numpy.where, or mark the program with @per_particle",
        ) from error
    finally:
        _RUN.reset(token)
    if isinstance(handler, Guide):
        handler.values = dict(run.values)
    if isinstance(handler, Replay):
        unused = sorted(set(handler.guide.values) - set(run.values))
        if unused:
            raise InputError(
                f"the model has no site {unused[0]!r}, which the guide samples", f"it has {sorted(run.values)}"
            )
    run.returned = _returned(returned, n, single)
    return run


def _returned(returned: Any, n: int, single: bool) -> dict[str, Any]:
    """What a program returns: one row a particle, or a single particle's values as they are."""
    if returned is None:
        return {}
    if not isinstance(returned, Mapping):
        raise InputError(
            f"a program returned a {type(returned).__qualname__}, expected None or a mapping of values to keep"
        )
    if single:
        return {str(name): value for name, value in returned.items()}
    out = {}
    for name, value in returned.items():
        array = np.asarray(value)
        if array.ndim == 0 or len(array) != n:
            raise InputError(f"a program returned {name!r} of shape {array.shape}, expected one row a particle ({n})")
        out[str(name)] = array
    return out


def kept(run: Run) -> dict[str, Any]:
    """What a particle (or all of them) is after a run: values of the sites, and what was returned."""
    values = {name: a[0] for name, a in run.values.items()} if run.single else run.values
    particles = {**values, **run.returned}
    if not particles:
        raise InputError("the program sampled nothing and returned nothing: a particle would be empty")
    return particles
