"""The measurement update of MST: predicted x proposed -> fused candidates (paper, section IV-D, Alg. 1).

>>> update = FusionUpdate(eta=5)
>>> fused = update.update(rng, predicted, proposed, clip)      # |proposed| x |predicted| x eta candidates

Predicted hypotheses are projected onto the free space of the latest frame, which gives each a quality Q. Every
pair of a proposed sample i and a predicted hypothesis j is crossed `eta` times. The weight of a candidate is

    log w = log w_j + log w_i + lambda log Q_j

and depends only on its pair, so candidates are drawn first and built afterwards: those that resampling does not
choose are never built.

With `evidence` the built candidates themselves are judged, in two stages: some are drawn by the weight above, built
and scored; what the first stage has used is divided out, so a drawn candidate's weight is its score.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fusion.claims import Claims
from mstfilter.fusion.crossover import Crossover
from mstfilter.fusion.division import NoDivision, PartRule, take_apart
from mstfilter.fusion.free_space import SMALLEST_QUALITY, FreeSpace, Projection
from mstfilter.fusion.interfaces import Division, Evidence
from mstfilter.scene import Clip, Hypothesis, VoxelGrid
from mstfilter.smc import Candidates, Population, Systematic, Update, child, key_of, union

__all__ = ["FusionUpdate"]


@dataclass(frozen=True)
class FusionUpdate(Update):
    """Free-space projection and conflict-graph crossover.

    Parameters
    ----------
    free_space : Projection
        Projects the predicted hypotheses onto what the latest frame (and, if it has a memory, earlier ones) leaves
        possible.
    crossover : Crossover
        Makes one hypothesis of two.
    eta : int
        Candidates of each pair.
    quality_exponent : float
        lambda: power of Q in the weight.
    division : Division
        Objects of both sides that hold what has moved apart in the clip are parted first, and remembered as such.
    parts : PartRule
        When a part is worth an object.
    claims : Claims
        Which voxels each parent may claim.
    evidence : tuple of Evidence
        Terms by which built candidates are scored; none: candidates are weighted by their pair alone.
    n_scored : int
        Candidates that are built and scored; 0 is four for each predicted hypothesis.
    """

    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    crossover: Crossover = Crossover()  # noqa: RUF009 (frozen)
    eta: int = 5
    quality_exponent: float = 3.0
    division: Division = NoDivision()  # noqa: RUF009 (frozen)
    parts: PartRule = PartRule()  # noqa: RUF009 (frozen)
    claims: Claims = Claims()  # noqa: RUF009 (frozen)
    evidence: tuple[Evidence, ...] = ()
    n_scored: int = 0

    properly_weighted: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.eta < 1 or self.n_scored < 0:
            raise InputError(f"eta is {self.eta} and n_scored {self.n_scored}, expected at least 1 and 0 candidates")
        if not (np.isfinite(self.quality_exponent) and self.quality_exponent >= 0):
            raise InputError(f"quality_exponent is {self.quality_exponent}, expected a number >= 0")

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Clip,
    ) -> Population:
        """Candidates of all pairs, unbuilt.

        Without a prediction the proposed samples pass unchanged; without a proposal the refined predictions do.
        """
        if predicted is None:
            return union(None, proposed)
        refined, quality = self.free_space.refine(predicted.particles, observation)
        doubtful = [self.claims.doubtful(h, r) for h, r in zip(predicted.particles, refined, strict=True)]
        refined = self.parted(refined, observation, proposed=False)
        log_q = self.quality_exponent * np.log(np.maximum(quality, SMALLEST_QUALITY))
        notes = {"quality": quality.tolist(), "eta": self.eta}
        if proposed is None:
            return Population(refined, predicted.log_weights + log_q, predicted.parents, notes)

        i, j = _pairs(child(rng, "order"), len(proposed), len(predicted), self.eta)
        key, crossover = key_of(rng), self.crossover
        samples = self.parted(tuple(proposed.particles), observation, proposed=True)
        claims, exposed = self.claims, self.claims.exposed(observation)
        _check_grids(refined, samples, refined[0].grid if exposed is None else observation.grid)

        def build(candidate: int) -> Hypothesis:
            stream = key.child("candidate", candidate).generator()
            sample, prediction = samples[i[candidate]], refined[j[candidate]]
            wrong = doubtful[j[candidate]]
            prediction = claims.limited(sample, prediction, exposed, wrong)
            return crossover.mix(stream, sample, prediction, claims.predicted_wins(exposed, wrong))

        none_j, none_i = np.full(len(predicted), -1), np.full(len(proposed), -1)
        parents = {
            "previous": predicted.parents.get("previous", none_j)[j],
            "proposed": proposed.parents.get("proposed", none_i)[i],
        }
        log_weights = proposed.log_weights[i] + (predicted.log_weights + log_q)[j]
        fused = Population(Candidates(build, len(i)), log_weights, parents, notes)
        return self._scored(rng, fused, observation, self.n_scored or 4 * len(predicted)) if self.evidence else fused

    def _scored(self, rng: np.random.Generator, fused: Population, clip: Clip, n: int) -> Population:
        """Second stage: `n` candidates drawn by pair weight, weighted by their score."""
        drawn = Systematic().resample(rng, fused, n).realised()
        total, scores = self.scored(tuple(drawn.particles), clip)
        log_weights = drawn.log_weights + total
        parents = {name: index for name, index in drawn.parents.items() if name != "ancestor"}
        notes = {**fused.notes, "scores": scores}
        return Population(drawn.particles, log_weights, parents, notes)

    def scored(self, hypotheses: tuple[Hypothesis, ...], clip: Clip) -> tuple[np.ndarray, dict[str, list[float]]]:
        """What all terms of evidence say together (n,), nats, and what each says, by name, for the notes."""
        total, scores = np.zeros(len(hypotheses)), {}
        for k, term in enumerate(self.evidence):
            name, score = type(term).__name__, term.log_score(hypotheses, clip)
            scores[f"{name} {k}" if name in scores else name] = score.round(3).tolist()
            total += score
        return total, scores

    def parted(self, hypotheses: tuple[Hypothesis, ...], clip: Clip, proposed: bool) -> tuple[Hypothesis, ...]:
        """Hypotheses about the end of a clip, taken apart by what has moved apart in it; the same one once."""
        motions = self.division.divide(clip)
        if motions is None:
            return hypotheses
        known = {id(h): h for h in hypotheses}
        parted = {name: take_apart(h, motions, clip, self.parts, proposed) for name, h in known.items()}
        return tuple(parted[id(h)] for h in hypotheses)


def _check_grids(predicted: tuple[Hypothesis, ...], proposed: tuple[Hypothesis, ...], grid: VoxelGrid) -> None:
    """All hypotheses lie on this grid: said now, not when a candidate of two that do not fit happens to be built."""
    for name, hypotheses in (("predicted", predicted), ("proposed", proposed)):
        for k, hypothesis in enumerate(hypotheses):
            if hypothesis.grid != grid:
                found, wanted = (
                    f"{g.shape} voxels of {g.voxel_size:g} m at {g.origin.tolist()}" for g in (hypothesis.grid, grid)
                )
                raise InputError(
                    f"grid of {name} hypothesis {k} is {found}, expected {wanted}",
                    "all hypotheses of a run share the workspace of its clips",
                )


def _pairs(rng: np.random.Generator, n_proposed: int, n_predicted: int, eta: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample i and prediction j of each candidate, every pair `eta` times in a row.

    Each sample meets the predictions in cyclic order from one of its own, which the samples draw without replacement
    as long as there are any. In one fixed order, equal strides through nearly equal weights, as systematic
    resampling makes them, would meet one and the same prediction again and again.
    """
    rounds = -(-n_proposed // n_predicted)
    first = np.concatenate([rng.permutation(n_predicted) for _ in range(rounds)])[:n_proposed]
    i, k = np.divmod(np.arange(n_proposed * n_predicted), n_predicted)
    return i.repeat(eta), ((first[i] + k) % n_predicted).repeat(eta)
