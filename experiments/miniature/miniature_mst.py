"""MST on the miniature world: its presets, and a properly weighted version.

>>> filter = adapt_to_miniature(mstfilter.preset("paper"), world, n=5, weight_rule="p")
>>> filter = balanced_filter(world, n=500)              # exact: no crossover, weights f g / q
>>> state, infos = filter.run(observations, seed=0)

The parts that need images are replaced: tracking by the motion model, tree cuts by cuts of the reported
segmentation, and free space by the cells in front of the depth reading. Crossover, weights and resampler are those of
the preset; the mode filter is sized to the grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from miniature_filters import PriorProposal, PushTransition, state_weights
from miniature_world import Miniature, Observation, draw_states

from mstfilter.scene import Hypothesis, Projection
from mstfilter.smc import ParticleFilter, Population, Proposal, Update, child, log_mean_exp, union


@dataclass(frozen=True)
class DepthFreeSpace(Projection):
    """Clears the cells in front of the depth reading; Q is the fraction of cells that remain."""

    def project(self, hypothesis: Hypothesis, frame: Any) -> tuple[Hypothesis, float]:
        free = np.arange(hypothesis.labels.shape[1])[None, :, None] < np.reshape(frame.depth, (-1, 1, 1))
        if not (free & (hypothesis.shares.probability > 0)).any():
            return hypothesis, 1.0
        occupied = hypothesis.labels != 0
        return hypothesis.without(free), 1.0 - float((occupied & free).sum() / max(occupied.sum(), 1))


class Cuts(NamedTuple):
    """The distribution that `CutProposal` draws from.

    Attributes
    ----------
    states : (m,) int
        Outcomes; a state may occur more than once.
    probability : (m,)
        Probability of each outcome; sums to one.
    log_cut : (m,)
        Log probability of the cut without completion, relative to the best cut.
    """

    states: np.ndarray
    probability: np.ndarray
    log_cut: np.ndarray


def cut_distribution(world: Miniature, observation: Observation, completion: float) -> Cuts:
    """The distribution of cuts of the reported segmentation, with the cells behind the surface completed.

    Pixels with a surface are placed at the measured depth. Two neighbouring ones are one object with the posterior
    probability that the error rates of the sensor give, for even prior odds. From the surface backwards, each next
    cell is filled with probability `completion` until one is left free.
    """
    Y = world.shape[1]
    merge, join = world.join_probability
    same_surface = np.where(observation.joined, join / (join + merge), (1 - join) / (2 - join - merge))
    hit = observation.depth < Y
    edges = np.flatnonzero(hit[1:] & hit[:-1])
    columns = np.flatnonzero(hit).tolist()
    n_behind = [range(Y - int(observation.depth[x])) for x in columns]  # how many cells behind are filled
    states, probability, cut = [], [], []
    for kept in product((False, True), repeat=len(edges)):
        p_cut = float(np.prod(np.where(kept, same_surface[edges], 1 - same_surface[edges])))
        kept_edges = set(edges[np.array(kept, bool)].tolist())
        objects = np.cumsum([x - 1 not in kept_edges for x in columns]).tolist()
        for fill in product(*n_behind):
            labels, p = np.zeros(world.shape, np.uint16), p_cut
            for x, behind, label in zip(columns, fill, objects, strict=True):
                end = int(observation.depth[x]) + behind + 1
                labels[x, end - behind - 1 : end] = label
                p *= completion**behind * (1 - completion if end < Y else 1.0)
            states.append(world.states.index_of_labels(labels))
            probability.append(p)
            cut.append(p_cut)
    log_cut = np.log(cut)
    return Cuts(np.array(states), np.array(probability), log_cut - log_cut.max())


@dataclass(frozen=True)
class CutProposal(Proposal):
    """Hypotheses from the observation alone: cuts of the sensed segmentation.

    Parameters
    ----------
    world : Miniature
    weight_rule : {"equal", "p"}
        "equal": draws from p carry p already. "p": log weight ``log p(c) - log p(c*)``; p then counts twice.
    include_optimal : bool
        Replace the first sample's cut by the best cut.
    completion : float
        Probability that an object fills the next cell behind its surface.
    prior_share : float
        Fraction of samples that are drawn from the prior instead. Above 0 every state can be proposed.
    """

    world: Miniature
    weight_rule: Literal["equal", "p"] = "equal"
    include_optimal: bool = False
    completion: float = 0.4
    prior_share: float = 0.0

    properly_weighted: ClassVar[bool] = False

    def sample(self, rng: np.random.Generator, observation: Observation, n: int) -> Population:
        cuts = cut_distribution(self.world, observation, self.completion)
        k = draw_states(rng, cuts.probability, n)
        if self.include_optimal:
            k[0] = int(np.argmax(np.where(cuts.log_cut == 0, cuts.probability, -1.0)))
        states = cuts.states[k]
        if self.prior_share > 0:
            prior = self.world.draw_prior(rng, n)
            states = np.where(rng.random(n) < self.prior_share, prior, states)
        weights = cuts.log_cut[k] if self.weight_rule == "p" else np.zeros(n)
        return Population(self.world.states.take(states), weights)

    def state_probability(self, observation: Observation) -> np.ndarray:
        """(S,) probability of each state in a sample that is not replaced by the best cut."""
        cuts = cut_distribution(self.world, observation, self.completion)
        q = np.bincount(cuts.states, cuts.probability, len(self.world.states))
        return (1 - self.prior_share) * q + self.prior_share * self.world.prior


def adapt_to_miniature(
    filter: ParticleFilter,
    world: Miniature,
    n: int,
    weight_rule: Literal["equal", "p"] = "equal",
    include_optimal: bool = False,
) -> ParticleFilter:
    """A filter of MST on the miniature world, with `n` particles and `n` samples per step.

    The update of `filter` must be a `CrossoverUpdate`. `weight_rule` and `include_optimal` are fields of
    `CutProposal`; give those of the preset's proposal.
    """
    crossover = filter.update.crossover
    small = replace(crossover.mode_filter, window=3, isolation=27)  # the window holds 27 cells: none is isolated
    update = replace(
        filter.update,
        free_space=DepthFreeSpace(),
        crossover=replace(crossover, mode_filter=small),
    )
    return replace(
        filter,
        transition=PushTransition(world, rearranged=False),
        proposal=CutProposal(world, weight_rule, include_optimal),
        update=update,
        n=n,
        n_proposed=n,
    )


def predictive_distribution(world: Miniature, predicted: Population | None) -> np.ndarray:
    """(S,) p(x_t | past): a mixture of the weighted, moved particles and the prior."""
    if predicted is None:
        return world.prior
    return (1 - world.rearranged) * state_weights(world, predicted) + world.rearranged * world.prior


@dataclass(frozen=True)
class BalancedUpdate(Update):
    """The union of moved hypotheses and samples of the new image, weighted so that the filter is exact.

    Together they are draws from the mixture q = share q_samples + (1 - share) q_moved, so each is weighted by
    p(x | past) g(y | x) / q(x): the marginal particle filter of Klaas, de Freitas and Doucet (2005) with the balance
    heuristic. The transition does not rearrange the table; the samples account for that.

    Parameters
    ----------
    world : Miniature
    samples : CutProposal
        Draws one sample per moved hypothesis. Needs `prior_share` > 0, so that every state can be drawn.
    share : float
        Weight of the samples in the mixture.
    """

    world: Miniature
    samples: CutProposal
    share: float = 0.5

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Observation,
    ) -> Population:
        world = self.world
        assert predicted is not None
        n = len(predicted)
        samples = self.samples.sample(child(rng, "samples"), observation, n)
        if observation.action < 0:  # the first step: the particles are draws from the prior
            past = moved = world.prior
        else:
            moved = state_weights(world, predicted)
            past = predictive_distribution(world, predicted)
        q = (1 - self.share) * moved + self.share * self.samples.state_probability(observation)
        both = union(predicted, samples)
        with np.errstate(divide="ignore"):
            base = np.concatenate([np.log((1 - self.share) * predicted.weights), np.full(n, np.log(self.share / n))])
            ratio = np.log(past) + world.log_likelihood(observation) - np.log(q)
        level = log_mean_exp(predicted.log_weights) + np.log(len(both))
        return replace(both, log_weights=level + base + ratio[world.states.index(both.particles)])


def balanced_filter(world: Miniature, n: int, **changes: Any) -> ParticleFilter:
    """MST without crossover, properly weighted: `n` moved hypotheses and `n` samples per step.

    No observation may be missing.
    """
    return ParticleFilter(
        initial=PriorProposal(world),
        transition=PushTransition(world, rearranged=False),
        update=BalancedUpdate(world, CutProposal(world, prior_share=0.1)),
        n=n,
        **changes,
    )
