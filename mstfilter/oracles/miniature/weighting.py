"""Other weights for fused candidates: scored, counted once, weighed by the prediction.

>>> filter = replace(shrunk, update=ScoredFusion(world, shrunk.update, distinct=True, predictive=True))
>>> filter = balanced_filter(world, n=500)              # exact: no crossover, weights f g / q

The weights of MST depend on a candidate's parents, not on the candidate. Here the built candidate x is weighed by the
likelihood g(y | x) of the reading, in three steps that can be taken one by one:

1. the pair's weight leaves Q out (it is computed from the same reading) and the candidate takes g(y | x);
2. `distinct`: each distinct candidate counts once. How often crossover happens to make it says nothing about it;
3. `predictive`: it is weighed by p(x | past) as well, the moved particles' law mixed with the prior of new scenes.

With all three, and candidates that cover what is probable, the weights are those of the exact filter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from typing import ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fusion import FusionUpdate
from mstfilter.oracles.miniature.filters import Prior, Push
from mstfilter.oracles.miniature.shrunk import SampledCuts
from mstfilter.oracles.miniature.world import Glance, Miniature
from mstfilter.smc import (
    EssBelow,
    Multinomial,
    ParticleFilter,
    Population,
    Resampler,
    Systematic,
    Trigger,
    Update,
    child,
    coalesce,
    first_seen,
    log_mean_exp,
    union,
)

__all__ = ["BalancedUpdate", "ScoredFusion", "balanced_filter", "predictive_law"]


def predictive_law(world: Miniature, predicted: Population | None) -> np.ndarray:
    """(S,) p(x_t | past) from particles that a tracker has moved: their weights, and the prior of new scenes."""
    if predicted is None:
        return world.prior
    followed = np.bincount(world.states.index(predicted.particles), predicted.weights, len(world.states))
    return (1 - world.rearranged) * followed + world.rearranged * world.prior


@dataclass(frozen=True)
class ScoredFusion(Update):
    """Two stages: some candidates are drawn by their pairs' weights and built, then weighed themselves.

    Parameters
    ----------
    world : Miniature
    fusion : FusionUpdate
        Makes the candidates.
    first : int
        Candidates that are built, as a multiple of the predicted particles. 0: no crossover (with `parents`).
    distinct : bool
        Each distinct candidate counts once.
    predictive : bool
        Candidates are weighed by p(x | past) too.
    parents : bool
        The moved hypotheses and the samples are candidates themselves.
    """

    world: Miniature
    fusion: FusionUpdate
    first: int = 4
    distinct: bool = False
    predictive: bool = False
    parents: bool = False

    properly_weighted: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.first < 0 or (self.first == 0 and not self.parents):
            raise InputError(f"first is {self.first}, and without parents there would be no candidates")

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Glance,
    ) -> Population:
        """Weighted candidates."""
        world = self.world
        if predicted is None or proposed is None:
            built = union(predicted, proposed)
        else:
            parts = []
            if self.first > 0:
                # Q is of the reading, which the score knows better; the first stage draws by the parents alone.
                fusion = replace(self.fusion, quality_exponent=0.0, evidence=())
                candidates = fusion.update(rng, predicted, proposed, observation)  # type: ignore[arg-type]
                m = self.first * len(predicted)
                chosen, _ = Multinomial().select(child(rng, "first stage"), candidates.log_weights, m)
                parts.append(candidates.take(chosen, np.zeros(m)).realised())
            if self.parents:
                parts += [replace(p, log_weights=np.zeros(len(p))) for p in (predicted, proposed)]
            built = reduce(union, parts)
        states = world.states.index(built.particles)
        score = world.log_likelihood(observation)[states]
        if self.predictive:
            score = score + np.log(predictive_law(world, predicted))[states]
        if not self.distinct:
            return replace(built, log_weights=score)
        representatives, _ = coalesce(np.zeros(len(states)), first_seen(states.tolist()))
        return built.take(representatives, score[representatives])


@dataclass(frozen=True)
class BalancedUpdate(Update):
    """Moved hypotheses and samples of the new image side by side, weighted so that the filter is exact.

    Both are draws of the mixture q = share x (law of the samples) + (1 - share) x (law of the moved particles), so
    each is weighed by p(x | past) g(y | x) / q(x): the marginal particle filter of Klaas, de Freitas and Doucet
    (2005) with the balance heuristic. The transition is one that does not lay the table anew; the samples do.

    Parameters
    ----------
    world : Miniature
    samples : SampledCuts
        Draws as many samples as there are moved hypotheses, where the filter brings none; with `prior_share` > 0, so
        that they reach every state. A filter with a proposal of its own does not count as properly weighted, since
        the driver cannot know that its density is divided out.
    share : float
        Of the samples in the mixture.
    """

    world: Miniature
    samples: SampledCuts
    share: float = 0.5

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Glance,
    ) -> Population:
        """Weighted union; the log mean of the weights goes on to be the log evidence."""
        world = self.world
        if predicted is None:
            raise InputError("the balanced update mixes samples with moved hypotheses, and there are none")
        if proposed is None:
            proposed = self.samples.sample(child(rng, "samples"), observation, len(predicted))
        log_g = world.log_likelihood(observation)
        if observation.action < 0:  # no past: the prior, of which the first particles are draws
            past = followed = world.prior
        else:
            followed = np.bincount(world.states.index(predicted.particles), predicted.weights, len(world.states))
            past = (1 - world.rearranged) * followed + world.rearranged * world.prior
        q = (1 - self.share) * followed + self.share * self.samples.law(observation)
        both = union(predicted, proposed)
        states = world.states.index(both.particles)
        n_new, w_old = len(proposed), predicted.weights
        with np.errstate(divide="ignore"):
            base = np.concatenate([np.log((1 - self.share) * w_old), np.full(n_new, np.log(self.share / n_new))])
            ratio = np.log(past) + log_g - np.log(q)
        level = log_mean_exp(predicted.log_weights) + np.log(len(both))
        return replace(both, log_weights=level + base + ratio[states])


def balanced_filter(
    world: Miniature, n: int, resampler: Resampler | None = None, trigger: Trigger | None = None
) -> ParticleFilter:
    """MST's scheme without crossover, properly weighted: `n` moved hypotheses and `n` samples a step.

    No observation may be missing.
    """
    return ParticleFilter(
        initial=Prior(world),
        transition=Push(world, rearranged=False),
        update=BalancedUpdate(world, SampledCuts(world, prior_share=0.1)),
        resampler=resampler if resampler is not None else Systematic(),
        trigger=trigger if trigger is not None else EssBelow(0.5),
        n=n,
    )
