"""The presets of MST on the miniature world: the same update, crossover and resampler, on a grid of a few cells.

>>> filter = shrink(mstfilter.preset("paper"), world, n=5, weight_rule="p")
>>> state, infos = filter.run(glances, seed=0)

What the images feed is replaced: tracking by the motion model, tree cuts by cuts of the segmentation that the
sensor reports, free space by the cells in front of the depth reading, and what scores built candidates (where the
preset has such terms) by the likelihood of the reading. What fuses and selects is the preset's own; only the mode
filter is sized to the grid, and what needs a video (motions that part objects, measured surfaces) is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fusion import Claims, Evidence, FusionUpdate, NoDivision, Projection
from mstfilter.oracles.miniature.filters import Push
from mstfilter.oracles.miniature.world import Glance, Miniature, draw
from mstfilter.scene import Hypothesis
from mstfilter.smc import ParticleFilter, Population, Proposal

__all__ = ["CutLaw", "ReadingEvidence", "SampledCuts", "SeenThrough", "cut_law", "shrink"]


@dataclass(frozen=True)
class SeenThrough(Projection):
    """Clears the cells in front of the depth reading; Q is the share of cells that is left."""

    def project(self, hypothesis: Hypothesis, frame: Any) -> tuple[Hypothesis, float]:
        """`frame` is a `Glance`; a hypothesis without cells has quality 1."""
        free = np.arange(hypothesis.labels.shape[1])[None, :, None] < frame.depth[:, None, None]
        occupied = hypothesis.labels != 0
        hit = occupied & free
        if not hit.any():
            return hypothesis, 1.0
        return hypothesis.with_labels(np.where(hit, 0, hypothesis.labels).astype(np.uint16)), float(
            1.0 - hit.sum() / occupied.sum()
        )


@dataclass(frozen=True)
class ReadingEvidence(Evidence):
    """Scores a candidate by the exact log likelihood of the whole reading, depth and segmentation.

    Parameters
    ----------
    world : Miniature
    """

    world: Miniature

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Any) -> np.ndarray:
        """(n,) log p(y | x); `clip` is a `Glance`."""
        return self.world.log_likelihood(clip)[self.world.states.index(hypotheses)]


@dataclass(frozen=True, eq=False)
class CutLaw:
    """Everything that the segmentation proposal can draw.

    Parameters
    ----------
    states : (m,) int
        Hypotheses; the same one may occur more than once.
    probability : (m,)
        Of each; sums to one.
    log_cut : (m,)
        Log probability of the cut alone, completion left out, relative to the best cut.
    """

    states: np.ndarray
    probability: np.ndarray
    log_cut: np.ndarray


def cut_law(world: Miniature, glance: Glance, completion: float) -> CutLaw:
    """Cuts of the sensed segmentation, completed to the cells behind.

    Pixels with a surface are put where the depth says. Two neighbouring ones belong together with the probability
    that the sensor's error rates give to what it reports, at even odds beforehand. Each cell behind a surface is
    filled by the object before it with probability `completion`, unless the one in between is left free.
    """
    X, Y = world.shape
    joins, splits = world.join_law[1], world.join_law[0]
    alike = np.where(glance.joined, joins / (joins + splits), (1 - joins) / (2 - joins - splits))
    hit = glance.depth < Y
    edges = np.flatnonzero(hit[1:] & hit[:-1])
    columns = np.flatnonzero(hit)
    depths = [range(Y - int(glance.depth[x])) for x in columns]  # how many cells behind are filled
    states, probability, cut = [], [], []
    for keep in product((False, True), repeat=len(edges)):
        p_cut = float(np.prod([alike[e] if k else 1 - alike[e] for e, k in zip(edges, keep, strict=True)]))
        kept = set(edges[list(keep)].tolist()) if len(edges) else set()
        label, pixel = 0, np.zeros(X, np.int64)
        for x in columns.tolist():
            label += x - 1 not in kept
            pixel[x] = label
        for fill in product(*depths):
            labels, p = np.zeros((X, Y), np.uint16), p_cut
            for x, behind in zip(columns.tolist(), fill, strict=True):
                d = int(glance.depth[x])
                labels[x, d : d + behind + 1] = pixel[x]
                p *= completion**behind * (1 - completion if d + behind + 1 < Y else 1.0)
            states.append(world.states.index_of_labels(labels))
            probability.append(p)
            cut.append(p_cut)
    log_cut = np.log(cut)
    return CutLaw(np.array(states), np.array(probability), log_cut - log_cut.max())


@dataclass(frozen=True)
class SampledCuts(Proposal):
    """Hypotheses from the observation alone: cuts of the sensed segmentation.

    Parameters
    ----------
    world : Miniature
    weight_rule : {"equal", "p"}
        "equal": draws from p carry p already. "p": log weight ``log p(c) - log p(c*)``; p then counts twice.
    include_optimal : bool
        Put the best cut in place of the first sample's.
    completion : float
        Probability that an object fills the next cell behind the one that is seen.
    prior_share : float
        Share of samples that are drawn from the prior instead. Above 0 every state can be proposed.
    """

    world: Miniature
    weight_rule: Literal["equal", "p"] = "equal"
    include_optimal: bool = False
    completion: float = 0.4
    prior_share: float = 0.0

    @property
    def properly_weighted(self) -> bool:  # type: ignore[override]
        """Whether an update can divide their law out: equal weights, every state in reach."""
        return self.weight_rule == "equal" and not self.include_optimal and self.prior_share > 0

    def sample(self, rng: np.random.Generator, observation: Glance, n: int) -> Population:
        """Draw `n` hypotheses."""
        law = cut_law(self.world, observation, self.completion)
        k = draw(rng, law.probability, n)
        if self.include_optimal:
            k[0] = int(np.argmax(np.where(law.log_cut == 0, law.probability, -1.0)))
        states = law.states[k]
        if self.prior_share > 0:
            prior = self.world.draw_prior(rng, n)
            states = np.where(rng.random(n) < self.prior_share, prior, states)
        weights = law.log_cut[k] if self.weight_rule == "p" else np.zeros(n)
        return Population(self.world.states.take(states), weights)

    def law(self, observation: Glance) -> np.ndarray:
        """(S,) probability of each state (the first sample aside where it is the best cut)."""
        law = cut_law(self.world, observation, self.completion)
        q = np.bincount(law.states, law.probability, len(self.world.states))
        return (1 - self.prior_share) * q + self.prior_share * self.world.prior


def shrink(
    filter: ParticleFilter,
    world: Miniature,
    n: int,
    weight_rule: Literal["equal", "p"] = "equal",
    include_optimal: bool = False,
) -> ParticleFilter:
    """A filter of MST on the miniature world, with `n` particles and as many samples a step.

    Parameters
    ----------
    filter : ParticleFilter
        A preset; its update is a `FusionUpdate`.
    world : Miniature
    n : int
    weight_rule, include_optimal : str, bool
        Those of the preset's proposal.

    Raises
    ------
    InputError
        Where the update is of another kind.
    """
    if not isinstance(filter.update, FusionUpdate):
        raise InputError(
            f"the update is a {type(filter.update).__name__}, expected a FusionUpdate", "give a preset of MST"
        )
    crossover = filter.update.crossover
    small = replace(crossover.mode_filter, window=3, isolation=27)  # the window holds 27 cells: none is isolated
    evidence = (ReadingEvidence(world),) if filter.update.evidence else ()
    update = replace(
        filter.update,
        free_space=SeenThrough(),
        division=NoDivision(),
        claims=Claims(),
        crossover=replace(crossover, mode_filter=small),
        evidence=evidence,
        n_scored=0,
    )
    return replace(
        filter,
        transition=Push(world, rearranged=False),
        proposal=SampledCuts(world, weight_rule, include_optimal),
        update=update,
        n=n,
        n_proposed=n,
    )
