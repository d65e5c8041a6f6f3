"""Metropolis-Hastings on the sites of a program: what `Program.resample_move` uses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.distributions import Normal
from mstfilter.smc.population import Particles
from mstfilter.smc.program_runs import PerParticle, Score, Site, _kept, _run
from mstfilter.smc.rejuvenation import accept, choose
from mstfilter.smc.streams import child
from mstfilter.smc.trace import Trace

__all__ = ["metropolis"]


def metropolis(
    rng: np.random.Generator,
    model: Callable[[Any, Any], Any],
    particles: Particles,
    previous: Particles | None,
    observation: Any,
    n: int,
    scale: float,
    steps: int,
) -> tuple[Particles, float]:
    """Particles after `steps` Metropolis-Hastings steps on all sites, and the share that was accepted."""
    if not isinstance(model, PerParticle):
        return _move(rng, model, particles, previous, observation, n, scale, steps, False)
    moved, shares = [], []
    for i, particle in enumerate(particles):
        rows = {name: np.asarray(value)[None] for name, value in particle.items()}
        past = None if previous is None else previous[i]
        own = child(rng, "particle", i)
        row, share = _move(own, model.function, rows, past, observation, 1, scale, steps, True)
        moved.append(Trace({name: a[0] for name, a in row.items()}))
        shares.append(share)
    return tuple(moved), float(np.mean(shares))


def _move(
    rng: np.random.Generator,
    model: Callable[[Any, Any], Any],
    particles: Mapping[str, np.ndarray],
    previous: Any,
    observation: Any,
    n: int,
    scale: float,
    steps: int,
    single: bool,
) -> tuple[Mapping[str, np.ndarray], float]:
    def score(values: Mapping[str, np.ndarray]) -> tuple[Mapping[str, np.ndarray], np.ndarray, list[Site]]:
        handler = Score(values)
        run = _run(model, handler, previous, observation, n, single)
        return _kept(run), run.gain, handler.sites

    x, taken = particles, 0
    _, log_p, sites = score(x)
    for _ in range(steps):
        values, forward = _propose(rng, x, sites, scale, n)
        try:
            new, new_log_p, new_sites = score(values)
        except InputError:
            if not single:
                raise
            continue  # a particle of another structure, for which there are no values: refused both ways
        if [s.name for s in new_sites] != [s.name for s in sites]:
            continue
        backward = _log_density(values, x, new_sites, scale, n)
        with np.errstate(invalid="ignore"):
            yes = accept(rng, new_log_p - log_p + backward - forward)
        x, log_p, taken = choose(yes, new, x), np.where(yes, new_log_p, log_p), taken + int(yes.sum())
        if taken and steps > 1:
            _, log_p, sites = score(x)
    return x, taken / (steps * n)


def _propose(
    rng: np.random.Generator, x: Mapping[str, np.ndarray], sites: list[Site], scale: float, n: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """New values of all sites, and the log density (n,) of proposing them."""
    values = {name: np.array(a) for name, a in x.items()}
    for site in sites:
        rows: Any = slice(None) if site.rows is None else site.rows
        old = x[site.name][rows]
        if site.branch:
            continue
        if site.distribution.discrete:
            values[site.name][rows] = site.distribution.sample(rng, len(old))
        else:
            values[site.name][rows] = old + scale * site.distribution.sd * rng.standard_normal(old.shape)
    return values, _log_density(x, values, sites, scale, n)


def _log_density(
    old: Mapping[str, np.ndarray], new: Mapping[str, np.ndarray], sites: list[Site], scale: float, n: int
) -> np.ndarray:
    """(n,) log density of proposing `new` at `old`, where the program meets `sites`."""
    total = np.zeros(n)
    for site in sites:
        if site.branch:
            continue
        rows: Any = slice(None) if site.rows is None else site.rows
        to = new[site.name][rows]
        if site.distribution.discrete:
            total[rows] += site.distribution.log_prob(to)
        else:
            total[rows] += Normal(old[site.name][rows], scale * site.distribution.sd).log_prob(to)
    return total
