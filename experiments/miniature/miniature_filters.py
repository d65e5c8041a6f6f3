"""Exact filtering of the miniature world, properly weighted filters of it, and distances between the two.

>>> exact = exact_filter(world, observations)
>>> exact.posterior[-1] @ world.states.same_object         # (P,) probability that two cells are one object
>>> exact.log_evidence[-1]                                 # log p(y_0 .. y_T)
>>> state, infos = guided_filter(world, n=500).run(observations, seed=0)
>>> p = state_weights(world, state.population)             # (S,), equal states summed
>>> total_variation(p, exact.posterior[-1])

The filters consist of the ordinary components, and their particles are hypotheses. `guided_filter` draws from
p(x_t | x_{t-1}, y_t), so its log evidence of a single observation is exact.

**Calibration.** A world is drawn from the prior and simulated, a filter runs on the observations, and a scalar of the
true state is ranked among those of `N_RANK_DRAWS` draws from the filter's answer; ties are broken at random. If the
answers are exact posteriors, the ranks are uniform (Cook, Gelman, Rubin 2006; Talts et al. 2018). Overconfident
answers give too many ranks at both ends, biased answers at one end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from miniature_world import Miniature, Observation, draw_states
from scipy import stats

from mstfilter.scene import Occupancy
from mstfilter.smc import ParticleFilter, Population, Proposal, Reweight, Transition

N_RANK_DRAWS = 9  # ranks 0 .. 9: ten bins
#: Keys of the result of `posterior_errors`.
POSTERIOR_ERRORS = ("tv", "same_object_error", "occupancy_error", "same_object_brier", "occupancy_brier", "p_truth")


class ExactPosterior(NamedTuple):
    """p(x_t | y_0 .. y_t) (T, S) and log p(y_0 .. y_t) (T,)."""

    posterior: np.ndarray
    log_evidence: np.ndarray


def exact_filter(world: Miniature, observations: Sequence[Observation | None]) -> ExactPosterior:
    """The forward algorithm over all states. None is a missing observation; its push is unknown too."""
    p, total = world.prior, 0.0
    posterior, evidence = [], []
    for t, observation in enumerate(observations):
        if t:
            p = world.predict(p, None if observation is None else observation.action)
        log_g = world.log_likelihood(observation)
        joint = p * np.exp(log_g - log_g.max())
        total += np.log(joint.sum()) + log_g.max()
        p = joint / joint.sum()
        posterior.append(p)
        evidence.append(total)
    return ExactPosterior(np.array(posterior), np.array(evidence))


@dataclass(frozen=True)
class PriorProposal(Proposal):
    """Hypotheses from the prior."""

    world: Miniature

    def sample(self, rng: np.random.Generator, observation: Observation | None, n: int) -> Population:
        return Population(self.world.states.take(self.world.draw_prior(rng, n)))


@dataclass(frozen=True)
class PushTransition(Transition):
    """Moves the hypotheses by the push of the observation; by random pushes if it is missing.

    Parameters
    ----------
    world : Miniature
    rearranged : bool
        Whether the table may be rearranged. False: objects are only pushed, as a tracker assumes.
    """

    world: Miniature
    rearranged: bool = True

    def predict(
        self, rng: np.random.Generator, population: Population, observation: Observation | None
    ) -> Population:
        states = self.world.states
        action = None if observation is None else observation.action
        new = self.world.move(rng, states.index(population.particles), action, self.rearranged)
        return Population(states.take(new), population.log_weights, population.parents)


@dataclass(frozen=True)
class GuidedPrior(Proposal):
    """Hypotheses from p(x_0 | y_0) with weights p(y_0) / g(y_0 | x_0), so that the likelihood makes them equal."""

    world: Miniature

    def sample(self, rng: np.random.Generator, observation: Observation | None, n: int) -> Population:
        log_g = self.world.log_likelihood(observation)
        q = self.world.prior * np.exp(log_g)
        x = draw_states(rng, q, n)
        return Population(self.world.states.take(x), np.log(q.sum()) - log_g[x])


@dataclass(frozen=True)
class GuidedPush(Transition):
    """Moves by the optimal proposal p(x_t | x_{t-1}, y_t), and adds log f - log q to the log weights.

    The distribution is a mixture of three: the push, the slip and the rearranged table. Each is weighted by the
    likelihood of the resulting state. If the observation is missing, the moves are those of `PushTransition`.
    """

    world: Miniature

    def predict(
        self, rng: np.random.Generator, population: Population, observation: Observation | None
    ) -> Population:
        world, n = self.world, len(population)
        if observation is None:
            return PushTransition(world).predict(rng, population, None)
        old = world.states.index(population.particles)
        pushed = world.pushed[observation.action][old]
        log_g = world.log_likelihood(observation)
        g = np.exp(log_g)
        rearranged, kept = world.prior * g, 1 - world.rearranged
        stays, moves = world.slip * g[old], (1 - world.slip) * g[pushed]
        components = np.stack([kept * moves, kept * stays, np.full(n, world.rearranged * rearranged.sum())], axis=1)
        total = components.sum(axis=1)
        which = (np.cumsum(components, axis=1) <= (rng.random(n) * total)[:, None]).sum(axis=1)
        new = np.choose(np.minimum(which, 2), [pushed, old, draw_states(rng, rearranged, n)])
        gain = np.log(total) - log_g[new]
        return Population(world.states.take(new), population.log_weights + gain, population.parents)


def likelihood_update(world: Miniature) -> Reweight:
    """The update by log p(y | x)."""
    return Reweight(lambda particles, y: world.log_likelihood(y)[world.states.index(particles)])


def bootstrap_filter(world: Miniature, n: int, **changes: Any) -> ParticleFilter:
    """A filter that draws from the prior and the motion model. `changes` are fields of the `ParticleFilter`."""
    return ParticleFilter(
        initial=PriorProposal(world),
        transition=PushTransition(world),
        update=likelihood_update(world),
        n=n,
        **changes,
    )


def guided_filter(world: Miniature, n: int, **changes: Any) -> ParticleFilter:
    """A filter that draws from p(x_0 | y_0) and p(x_t | x_{t-1}, y_t). `changes` as in `bootstrap_filter`."""
    return ParticleFilter(
        initial=GuidedPrior(world),
        transition=GuidedPush(world),
        update=likelihood_update(world),
        n=n,
        **changes,
    )


def state_weights(world: Miniature, population: Population) -> np.ndarray:
    """(S,) sum of the weights of the particles in each state.

    A particle that is unsure of cells is divided among states: each of its objects is a level set of its
    probabilities, independently of the others.
    """
    p = np.zeros(len(world.states))
    for hypothesis, weight in zip(population.particles, population.weights.tolist(), strict=True):
        if hypothesis.occupancy is None:
            p[world.states.index_of_labels(hypothesis.labels)] += weight
        else:
            for labels, share in level_sets(hypothesis.occupancy):
                p[world.states.index_of_labels(labels)] += weight * share
    return p


def level_sets(occupancy: Occupancy) -> list[tuple[np.ndarray, float]]:
    """Label grids, and their probabilities, if each object is a level set of its probabilities."""
    found = [(np.zeros(occupancy.owner.shape, np.uint16), 1.0)]
    for k in np.unique(occupancy.owner[occupancy.probability > 0]):
        p = np.where(occupancy.owner == k, occupancy.probability, 0).astype(np.float64)
        levels = np.unique(np.append(p, [0.0, 1.0]))
        sets = [(p >= high, high - low) for low, high in pairwise(levels.tolist())]
        found = [(np.where(own, k, labels), q * share) for labels, q in found for own, share in sets]
    return found


def iid_weights(rng: np.random.Generator, p: np.ndarray, n: int) -> np.ndarray:
    """(S,) relative frequencies of `n` independent draws from p: a bound for `n` equally weighted particles."""
    return rng.multinomial(n, p / p.sum()) / n


def total_variation(p: np.ndarray, q: np.ndarray) -> float:
    """Total variation distance ``sum_i |p_i - q_i| / 2``, in [0, 1]."""
    return 0.5 * float(np.abs(p - q).sum())


def posterior_errors(world: Miniature, p: np.ndarray, exact: np.ndarray, truth: int) -> dict[str, Any]:
    """Distances of a distribution p over the states from the exact one, and its scores against the true state.

    Returns
    -------
    dict
        ``tv``; mean absolute error of the probabilities that two cells are one object (over pairs) and that a cell
        is occupied (over cells); the Brier scores of both against the truth; the probability of the truth.
    """
    s = world.states
    same, occupied = p @ s.same_object, p @ s.occupied
    return {
        "tv": total_variation(p, exact),
        "same_object_error": float(np.abs(same - exact @ s.same_object).mean()),
        "occupancy_error": float(np.abs(occupied - exact @ s.occupied).mean()),
        "same_object_brier": float(((same - s.same_object[truth]) ** 2).mean()),
        "occupancy_brier": float(((occupied - s.occupied[truth]) ** 2).mean()),
        "p_truth": float(p[truth]),
    }


def state_statistics(world: Miniature) -> dict[str, np.ndarray]:
    """Scalars (S,) of the states: objects, occupied cells, size of the object in the middle cell, joined pairs."""
    s = world.states
    cell = s.labels.shape[1] // 2
    middle = s.labels[:, cell]
    return {
        "n_objects": s.n_objects.astype(np.float64),
        "occupied": s.occupied.sum(axis=1).astype(np.float64),
        "size_in_the_middle": np.where(middle > 0, (s.labels == middle[:, None]).sum(axis=1), 0).astype(np.float64),
        "joined_pairs": s.same_object.sum(axis=1).astype(np.float64),
    }


def rank_of_truth(rng: np.random.Generator, statistic: np.ndarray, p: np.ndarray, truth: int) -> int:
    """Rank 0 .. N_RANK_DRAWS of the true state's statistic among those of draws from p (S,); ties at random."""
    drawn = statistic[draw_states(rng, p, N_RANK_DRAWS)]
    below, ties = int((drawn < statistic[truth]).sum()), int((drawn == statistic[truth]).sum())
    return below + int(rng.integers(ties + 1))


def rank_uniformity(ranks: np.ndarray) -> float:
    """p value of the chi-square test that ranks 0 .. N_RANK_DRAWS are uniform."""
    return float(stats.chisquare(np.bincount(ranks, minlength=N_RANK_DRAWS + 1)).pvalue)
