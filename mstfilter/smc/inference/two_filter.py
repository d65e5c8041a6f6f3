"""Two-filter smoothing: a filter from the beginning meets a filter from the end.

What is known about x_t from all observations is a product: what y_0 .. y_{t-1} say, and what y_t .. y_T say. A second
filter runs backwards in time for the latter, p(y_t .. y_T | x_t). This is no density of x_t, so the filter multiplies
it by an artificial prior g(x_t), which is divided out again where the two meet (Briers, Doucet, Maskell 2010):

    p(x_t | y_0 .. y_T) proportional to  sum_i W_i f(x_t | x_i)  *  g(x_t) p(y_t .. y_T | x_t)  /  g(x_t)

The particles of the result come from the filter that has seen the future. So it is the smoother of choice where the
filter itself has few particles in the right place, as before a sharp observation.

>>> from mstfilter.smc import Normal, StateSpaceModel, bootstrap, two_filter
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.8 * x, 0.6), lambda x: Normal(x, 0.5))
>>> smoothed = two_filter(
...     bootstrap(model, n=500), [0.3, -0.1, 0.8], model, prior=Normal(0.0, 1.0),
...     proposal=lambda later, y: Normal(0.8 * later, 0.6))      # the same chain backwards, as it is stationary
>>> means = [p.weights @ p.particles for p in smoothed]                                 # E[x_t | y_0 .. y_2]
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from mstfilter.base.errors import check_choice
from mstfilter.smc.components import EssBelow
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inference.smoothing import Backward, keep
from mstfilter.smc.inputs import check_observations, split_input
from mstfilter.smc.interfaces import Distribution, Proposal, Transition, Update
from mstfilter.smc.models.distributions import as_distribution
from mstfilter.smc.models.state_space import Dynamics, StateSpaceModel
from mstfilter.smc.population import Population, log_mean_exp, take
from mstfilter.smc.resampling import independent_draws, search
from mstfilter.smc.streams import Key

TwoFilterMethod = Literal["exact", "linear"]


def two_filter(
    filter: ParticleFilter,
    observations: Iterable[Any],
    model: StateSpaceModel,
    prior: Any,
    proposal: Callable[[Any, Any], Any],
    seed: int = 0,
    method: TwoFilterMethod = "exact",
) -> tuple[Population, ...]:
    """Smoothing distributions of x_t at each time t, as weighted populations (without paths).

    Parameters
    ----------
    filter : ParticleFilter
        The filter that runs forwards: any properly weighted filter of the model. The backward filter has its `n`,
        resampler and trigger.
    model : StateSpaceModel
        The model with its log densities.
    prior : Distribution or callable
        The artificial prior g, or ``t -> distribution``. It must not have lighter tails than p(y_t .. y_T | x_t); a
        good one is close to the distribution of x_t without observations.
    proposal : callable
        ``(later, y) -> distribution`` of x_t, one row for each particle x_{t+1} in `later`, where y is y_t or None.
    method : "exact" or "linear"
        "exact" sums over all pairs of particles, n^2 densities per step. "linear" draws n pairs by weight and weights
        them by f (Fearnhead, Wyncoll, Tawn 2010): fast, with a larger variance.
    """
    check_choice("method", method, get_args(TwoFilterMethod))
    ys = list(check_observations(observations))
    key = Key(seed).child("two filters")
    forward = keep(filter, ys, filter.start(key.child("forward")))
    reverse = _Reverse(model, prior, proposal, ys)
    backward = keep(
        ParticleFilter(
            initial=_Last(reverse),
            transition=_Earlier(reverse),
            update=_Weigh(reverse),
            resampler=filter.resampler,
            trigger=filter.trigger if filter.resample == "before" else EssBelow(),
            n=filter.n,
        ),
        ys[::-1],
        filter.start(key.child("backward")),
    )
    kernel, smoothed = Backward(Dynamics(model)), []
    for t, later in enumerate(reversed(backward.populations)):
        later = later.realised().labelled({})
        rest = -reverse.prior_at(t).log_prob(later.particles)
        if t == 0:
            start = reverse.model_at(0).density("log_initial")
            smoothed.append(later.reweighted(rest + start(later.particles)))
            continue
        moves = kernel.moves(forward.populations[t - 1].realised(), later.particles, ys[t], t - 1)
        if method == "exact":
            parts = [[log_mean_exp(row) for row in lw] for _, lw in moves.blocks(np.arange(len(later)), strict=False)]
            smoothed.append(later.reweighted(rest + np.concatenate(parts)))
            continue
        rng, n = key.child("pairs", t).generator(), len(later)
        weighted = later.reweighted(rest)
        rows = independent_draws(rng, weighted.weights, n)
        index = search(moves.population.weights, rng.random(n))  # in random order
        smoothed.append(Population(take(later.particles, rows), moves.log_density(index, rows)))
    return tuple(smoothed)


@dataclass(frozen=True, eq=False)
class _Reverse:
    """The model in the order of the backward filter, whose step s belongs to time T - s for the last time T."""

    model: StateSpaceModel
    prior: Any
    proposal: Callable[[Any, Any], Any]
    ys: list[Any]

    def time(self, s: int) -> int:
        return len(self.ys) - 1 - s

    def prior_at(self, t: int) -> Distribution:
        given = self.prior
        return as_distribution(given(t) if callable(given) and not isinstance(given, Distribution) else given)

    def model_at(self, t: int) -> StateSpaceModel:
        return self.model.at_step(t, split_input(self.ys[t])[1])


@dataclass(frozen=True)
class _OfReverse:
    """A part of the backward filter, at the time of a step."""

    reverse: _Reverse
    t: int = 0

    @property
    def depends_on_step(self) -> bool:
        return True

    def at_step(self, t: int, u: Any = None) -> Any:
        return replace(self, t=self.reverse.time(t))


@dataclass(frozen=True)
class _Last(_OfReverse, Proposal):
    """Draws the last state from the artificial prior."""

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        return Population(self.reverse.prior_at(self.t).sample(rng, n))


@dataclass(frozen=True)
class _Earlier(_OfReverse, Transition):
    """Draws x_t given x_{t+1}, and weights by g(x_t) f(x_{t+1} | x_t) / (g(x_{t+1}) q)."""

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        later, reverse, t = population.particles, self.reverse, self.t
        q = as_distribution(reverse.proposal(later, observation))
        new = q.sample(rng, len(population))
        gain = reverse.prior_at(t).log_prob(new) - reverse.prior_at(t + 1).log_prob(later) - q.log_prob(new)
        gain = gain + reverse.model_at(t + 1).density("log_transition")(new, later)
        return population.moved(new).reweighted(gain)


@dataclass(frozen=True)
class _Weigh(_OfReverse, Update):
    """Weights by p(y_t | x_t)."""

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Any
    ) -> Population:
        assert predicted is not None
        return predicted.reweighted(self.reverse.model_at(self.t).log_likelihood(predicted.particles, observation))
