"""Schemes that round n W_i to a neighbouring whole number, and killing.

===================  ===============================================  ==================================
scheme               N_i                                              variance of N_i, f = frac(n W_i)
===================  ===============================================  ==================================
residual-systematic  floor or ceil, from one uniform                  f (1 - f)
SSP                  floor or ceil, fractions decided pair by pair    f (1 - f)
killing              survive with w_i / max w, else multinomial       see `Killing`
===================  ===============================================  ==================================

>>> import numpy as np
>>> Ssp().select(np.random.default_rng(0), np.log([0.5, 0.3, 0.2]), 10)[0]
array([0, 0, 0, 0, 0, 1, 1, 1, 2, 2])

SSP needs no order of the particles to be consistent, unlike systematic resampling. Killing leaves most particles
in their place where weights are nearly equal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.resampling import _from_points, _from_shifts, checked_weights, ordered_uniforms, whole_copies

__all__ = ["Killing", "ResidualSystematic", "Ssp"]

_SETTLED = 1e-12  # a fraction this close to 0 or 1 is 0 or 1 but for rounding


@dataclass(frozen=True)
class ResidualSystematic(Resampler):
    """Residual-systematic resampling (RSR): floors and remainder in one pass (Bolic, Djuric, Hong 2004).

    The published loop carries the uniform on: N_i = floor(n W_i - u) + 1, u <- u + N_i - n W_i. Solved for the
    counts it says N_i = floor(n W_i) + ceil(F_i - u) - ceil(F_{i-1} - u), F the cumulated fractions, which is
    computed here for all particles at once. In exact arithmetic the counts are those of systematic resampling
    and of residual resampling with a systematic remainder, from the same uniform.
    """

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        """Choose."""
        copies, fractions, rest = whole_copies(checked_weights(log_weights, n), n)
        u = rng.random()
        if rest > 0:
            copies += np.bincount(_from_shifts(np.cumsum(fractions), rest, u), minlength=len(copies))
        return np.repeat(np.arange(len(copies)), copies), None


@dataclass(frozen=True)
class Ssp(Resampler):
    """Srinivasan sampling process: N_i is floor or ceil of n W_i whatever the order of particles.

    Two fractions a and b meet: with probability down / (up + down), up = min(1-a, b), down = min(a, 1-b), a takes
    `up` from b, else b takes `down` from a. One of them is then 0 or 1 and settled, the other meets the next.
    Here all pairs of a round meet at once, as in a tournament: log2(n) rounds instead of n steps (Gerber, Chopin,
    Whiteley 2019, "Negative association, ordering and convergence of resampling methods").
    """

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        """Choose."""
        weights = checked_weights(log_weights, n)
        copies, fractions, rest = whole_copies(weights, n)
        index = np.flatnonzero(fractions > _SETTLED)
        value = fractions[index]
        while len(index) > 1:
            pairs = len(index) // 2
            a, b = value[: 2 * pairs : 2], value[1 : 2 * pairs : 2]
            up, down = np.minimum(1 - a, b), np.minimum(a, 1 - b)
            lift = rng.random(pairs) * (up + down) < down
            value[: 2 * pairs : 2] = np.where(lift, a + up, a - down)
            value[1 : 2 * pairs : 2] = np.where(lift, b - up, b + down)
            full = value >= 1 - _SETTLED
            copies[index[full]] += 1
            rest -= int(full.sum())
            alive = ~full & (value > _SETTLED)
            index, value = index[alive], value[alive]
        if rest > 0 and len(index):  # the fractions add up to a whole number: the last one is 0 or 1 up to rounding
            copies[index[0]] += 1
            rest -= 1
        if rest > 0:  # rounding lost a copy of the order of 1e-12 in probability
            copies[np.argmax(weights)] += rest
        return np.repeat(np.arange(len(copies)), copies), None


@dataclass(frozen=True)
class Killing(Resampler):
    """A particle survives in its place with probability w_i / max w; the killed are replaced by draws by weight.

    Del Moral (2004), "Feynman-Kac formulae", section 5.6 (there for as many particles out as in). Here n may
    differ from m: each of n slots belongs to one particle, floor(n / m) or that plus one slots to each, the
    extra ones to a random subset; every slot then goes through survival or replacement. E[N_i] = n W_i for
    any n. For n = m, with p = w / max w,
    var N_i = p_i (1 - p_i) (1 - 2 W_i) + W_i^2 sum p (1 - p) + (m - sum p) W_i (1 - W_i).
    """

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        """Choose; survivors keep their order, and their slots where n = m."""
        weights = checked_weights(log_weights, n)
        m = len(weights)
        slots = np.tile(np.arange(m), n // m)
        if n % m:
            slots = np.concatenate([slots, np.sort(rng.choice(m, n % m, replace=False, shuffle=False))])
        killed = np.flatnonzero(rng.random(n) >= weights[slots])
        cumulative = np.cumsum(weights)
        if len(killed):
            slots[killed] = _from_points(cumulative, ordered_uniforms(rng, len(killed)) * cumulative[-1])
        return slots, None
