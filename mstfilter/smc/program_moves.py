"""Metropolis-Hastings on the sites of a program: what `Program.resample_move` uses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.distributions import Normal
from mstfilter.smc.population import Particles
from mstfilter.smc.program_runs import PerParticle, Score, Site, kept, run_once
from mstfilter.smc.program_sites import Run
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
        past = None if previous is None else previous[i]
        own = child(rng, "particle", i)
        new, share = _move(own, model.function, particle, past, observation, 1, scale, steps, True)
        moved.append(Trace(new))
        shares.append(share)
    return tuple(moved), float(np.mean(shares))


def _move(
    rng: np.random.Generator,
    model: Callable[[Any, Any], Any],
    particles: Mapping[str, Any],
    previous: Any,
    observation: Any,
    n: int,
    scale: float,
    steps: int,
    single: bool,
) -> tuple[Mapping[str, Any], float]:
    """Steps of all particles at once, or of a single one."""

    def score(values: Mapping[str, Any], bare: bool = False) -> tuple[Run, list[Site]]:
        handler = Score(values, bare)
        return run_once(model, handler, previous, observation, n, single), handler.sites

    now, sites = score(particles, single)
    taken = 0
    for _ in range(steps):
        values, forward = _propose(rng, now.values, sites, scale, n)
        try:
            new, new_sites = score(values)
        except InputError:
            if not single:
                raise
            continue  # a particle of another structure, for which there are no values: refused both ways
        if [s.name for s in new_sites] != [s.name for s in sites]:
            continue
        backward = _log_density(values, now.values, new_sites, scale, n)
        with np.errstate(invalid="ignore"):
            yes = accept(rng, new.gain - now.gain + backward - forward)
        taken += int(yes.sum())
        if yes.all():
            now, sites = new, new_sites
        elif yes.any():
            now, sites = score(choose(yes, new.values, now.values))
    return kept(now), taken / (steps * n)


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
