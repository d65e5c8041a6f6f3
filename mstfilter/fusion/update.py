"""The measurement update of MST: predicted and proposed hypotheses in, weighted candidates out (paper, section IV-D).

>>> fused = FusionUpdate().update(rng, predicted, proposed, clip)

1. The projection onto free space clears voxels of every predicted hypothesis j, which keeps a share Q_j of them.
2. Objects whose parts moved apart in the clip are split (`division`).
3. Every sample i and every predicted hypothesis j make `eta` candidates by crossover. With weights w_i and w_j of the
   parents and lambda = `quality_exponent`, the weight of a candidate,

       log w = log w_i + log w_j + lambda log Q_j     (section IV-E),

   depends on its parents only. So candidates are resampled first, and only those that are chosen are built. `claims`
   says which voxels a prediction may add to a sample when they are built.
4. With `evidence`, some candidates are drawn by this weight, built and scored. The weight of the first draw is
   divided out, so the weight of a drawn candidate is its score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from mstfilter.errors import check_choice, check_integer, check_number
from mstfilter.fusion.conflicts import check_grid
from mstfilter.fusion.crossover import Crossover
from mstfilter.fusion.division import NoDivision, PartRule, divided
from mstfilter.fusion.free_space import FreeSpace, log_quality
from mstfilter.fusion.interfaces import Division, Evidence, Projection
from mstfilter.scene import Clip, Hypothesis, frame_geometry
from mstfilter.smc import Candidates, Population, Systematic, Update, child, key_of, union

_SURFACE_VOXELS = 1.5  # a voxel up to this far behind the reading counts as surface, as in completion


@dataclass(frozen=True)
class Claims:
    """Voxels that the predicted parent of a candidate may add to the sample."""

    #: {"both", "sample"}: parents whose objects may fill voxels at the surface that the last frame measures.
    #: Voxels that only the prediction has there are mostly errors of position.
    surface: Literal["both", "sample"] = "both"
    #: A predicted object of which free space clears more than this share adds no voxels: its motion was wrong, and
    #: so are its hidden voxels. 1 sets no limit.
    max_cleared: float = 1.0

    def __post_init__(self) -> None:
        check_choice("surface", self.surface, ("both", "sample"))
        check_number("max_cleared", self.max_cleared, at_least=0, at_most=1)

    def exposed(self, clip: Clip) -> np.ndarray | None:
        """Voxels (X, Y, Z) bool at or in front of the measured surface; None if `surface` is "both"."""
        if self.surface == "both":
            return None
        with np.errstate(invalid="ignore"):
            signed = frame_geometry(clip.after, clip.grid).signed
            return np.asarray(signed < _SURFACE_VOXELS * clip.grid.voxel_size)

    def doubtful(self, predicted: Hypothesis, refined: Hypothesis) -> np.ndarray | None:
        """Voxels (X, Y, Z) bool of objects of which free space cleared too much; None if there are none."""
        if self.max_cleared >= 1:
            return None
        kept = refined.volumes()
        wrong = [k for k, n in predicted.volumes().items() if kept.get(k, 0) < (1 - self.max_cleared) * n]
        return np.isin(refined.labels, wrong) if any(k in kept for k in wrong) else None

    def limited(
        self, sample: Hypothesis, prediction: Hypothesis, exposed: np.ndarray | None, doubtful: np.ndarray | None
    ) -> Hypothesis:
        """The prediction without the voxels that it must not add to a sample. An empty sample limits nothing."""
        if not sample.n_objects:
            return prediction
        excluded = np.zeros(prediction.labels.shape, bool)
        for voxels in (exposed, doubtful):
            if voxels is not None:
                excluded |= voxels
        excluded &= (sample.labels == 0) & (prediction.labels != 0)
        if not excluded.any():
            return prediction
        return prediction.with_labels(np.where(excluded, 0, prediction.labels).astype(np.uint16))


@dataclass(frozen=True)
class FusionUpdate(Update):
    """Free-space projection and conflict-graph crossover.

    Parameters
    ----------
    free_space : Projection
        Projects the predicted hypotheses onto those that agree with the latest frame.
    crossover : Crossover
        Makes one hypothesis of two.
    eta : int
        Candidates of each pair.
    quality_exponent : float
        lambda: power of Q in the weight.
    division : Division
        Objects of both sides whose parts move apart in the clip are split first.
    parts : PartRule
        When a part of an object becomes a separate object.
    claims : Claims
        Voxels that a prediction may add to a sample.
    evidence : tuple of Evidence
        Terms that score built candidates; if empty, the weight of a candidate is that of its pair.
    n_scored : int
        Candidates that are built and scored; 0 means four for each predicted hypothesis.
    """

    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    crossover: Crossover = Crossover()  # noqa: RUF009 (frozen)
    eta: int = 5
    quality_exponent: float = 3.0
    division: Division = NoDivision()  # noqa: RUF009 (frozen)
    parts: PartRule = PartRule()  # noqa: RUF009 (frozen)
    claims: Claims = Claims()
    evidence: tuple[Evidence, ...] = ()
    n_scored: int = 0

    properly_weighted: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_integer("eta", self.eta)
        check_integer("n_scored", self.n_scored, at_least=0)
        check_number("quality_exponent", self.quality_exponent, at_least=0)

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Candidates of all pairs, not built.

        Without a prediction the proposed samples pass unchanged; without a proposal the refined predictions do.
        """
        if predicted is None:
            return union(None, proposed)
        refined, quality = self.free_space.refine(predicted.particles, observation)
        doubtful = [self.claims.doubtful(h, r) for h, r in zip(predicted.particles, refined, strict=True)]
        refined = divided(self.division, self.parts, refined, observation, proposed=False)
        log_q = self.quality_exponent * log_quality(quality)
        notes = {"quality": quality.tolist(), "eta": self.eta}
        if proposed is None:
            return Population(refined, predicted.log_weights + log_q, predicted.parents, notes)

        i, j = _pairs(child(rng, "order"), len(proposed), len(predicted), self.eta)
        key, crossover = key_of(rng), self.crossover
        samples = divided(self.division, self.parts, tuple(proposed.particles), observation, proposed=True)
        claims, exposed = self.claims, self.claims.exposed(observation)
        grid = refined[0].grid if exposed is None else observation.grid
        for name, hypotheses in (("predicted", refined), ("proposed", samples)):
            for k, hypothesis in enumerate(hypotheses):
                check_grid(f"{name} hypothesis {k}", hypothesis, grid)

        def build(candidate: int) -> Hypothesis:
            stream = key.child("candidate", candidate).generator()
            sample, prediction = samples[i[candidate]], refined[j[candidate]]
            prediction = claims.limited(sample, prediction, exposed, doubtful[j[candidate]])
            return crossover.cross(stream, sample, prediction)

        log_weights = proposed.log_weights[i] + (predicted.log_weights + log_q)[j]
        sides = (("previous", predicted, j), ("proposed", proposed, i))
        parents = {name: side.parents.get(name, np.full(len(side), -1))[k] for name, side, k in sides}
        fused = Population(Candidates(build, len(i)), log_weights, parents, notes)
        if not self.evidence:
            return fused
        return self._resampled(rng, fused, observation, self.n_scored or 4 * len(predicted))

    def _resampled(self, rng: np.random.Generator, fused: Population, clip: Clip, n: int) -> Population:
        """Second stage: `n` candidates drawn by pair weight, weighted by their score."""
        drawn = Systematic().resample(rng, fused, n).realised()
        total, scores = scored(self.evidence, tuple(drawn.particles), clip)
        log_weights = drawn.log_weights + total
        parents = {name: index for name, index in drawn.parents.items() if name != "ancestor"}
        return Population(drawn.particles, log_weights, parents, {**fused.notes, "scores": scores})


def scored(
    evidence: Sequence[Evidence], hypotheses: tuple[Hypothesis, ...], clip: Clip
) -> tuple[np.ndarray, dict[str, list[float]]]:
    """The sum (n,) of all terms of evidence in nats, and the score of each term by name."""
    total, scores = np.zeros(len(hypotheses)), {}
    for k, term in enumerate(evidence):
        name, score = type(term).__name__, term.log_score(hypotheses, clip)
        scores[f"{name} {k}" if name in scores else name] = score.round(3).tolist()
        total += score
    return total, scores


def _pairs(rng: np.random.Generator, n_proposed: int, n_predicted: int, eta: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample i and prediction j of each candidate, every pair `eta` times in a row.

    Each sample is paired with the predictions in cyclic order. The first prediction of each sample is drawn without
    replacement. With the same first prediction for all samples, systematic resampling, which takes equal strides
    through nearly equal weights, would choose the same prediction again and again.
    """
    rounds = -(-n_proposed // n_predicted)
    first = np.concatenate([rng.permutation(n_predicted) for _ in range(rounds)])[:n_proposed]
    i, k = np.divmod(np.arange(n_proposed * n_predicted), n_predicted)
    return i.repeat(eta), ((first[i] + k) % n_predicted).repeat(eta)
