"""The published measurement update: predicted and proposed hypotheses in, weighted candidates out.

>>> fused = CrossoverUpdate().update(rng, predicted, proposed, clip)

1. The projection onto free space clears voxels of every predicted hypothesis j, which keeps a share Q_j of them.
2. Every sample i and every predicted hypothesis j make `eta` candidates by crossover. With weights w_i and w_j of the
   parents and lambda = `quality_exponent`, the weight of a candidate,

       log w = log w_i + log w_j + lambda log Q_j     (section IV-E),

   depends on its parents only. So candidates are resampled first, and only those that are chosen are built.

Without a proposal, the update is the projection with its weights: if only a thin set of states agrees with an
observation, hardly any prediction lies in it, so every particle is projected into it (the manifold filter of Koval,
Pollard and Srinivasa 2015; for vectors `mstfilter.smc.ProjectOnto`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.crossover.cross import Crossover
from mstfilter.fields import NonNegativeFloat, PositiveInt
from mstfilter.scene import Clip, FreeSpace, Hypothesis, Projection, check_grid, log_quality
from mstfilter.smc import Candidates, Population, Update, child, key_of, union


@dataclass(frozen=True)
class CrossoverUpdate(Update):
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
    """

    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    crossover: Crossover = Crossover()  # noqa: RUF009 (frozen)
    eta: PositiveInt = 5
    quality_exponent: NonNegativeFloat = 3.0

    properly_weighted: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Candidates of all pairs, not built.

        Without a prediction the proposed samples pass unchanged; without a proposal the refined predictions do.
        """
        if predicted is None:
            return union(None, proposed)
        refined, quality = self.free_space.refine(predicted.particles, observation)
        log_weights = predicted.log_weights + self.quality_exponent * log_quality(quality)
        notes = {"quality": quality.tolist()}
        prediction = Population(refined, log_weights, predicted.parents, notes)
        return prediction if proposed is None else self._crossed(rng, prediction, proposed)

    def _crossed(self, rng: np.random.Generator, predicted: Population, proposed: Population) -> Population:
        """Candidates of all pairs of a sample and a refined prediction."""
        for name, population in (("predicted", predicted), ("proposed", proposed)):
            for k, hypothesis in enumerate(population.particles):
                check_grid(f"{name} hypothesis {k}", hypothesis, predicted.particles[0].grid)
        i, j = _pairs(child(rng, "order"), len(proposed), len(predicted), self.eta)
        key = key_of(rng)

        def build(candidate: int) -> Hypothesis:
            stream = key.child("candidate", candidate).generator()
            sample, prediction = proposed.particles[i[candidate]], predicted.particles[j[candidate]]
            return self.crossover.cross(stream, sample, prediction)

        sides = (("previous", predicted, j), ("proposed", proposed, i))
        parents = {name: side.parents.get(name, np.full(len(side), -1))[k] for name, side, k in sides}
        log_weights = proposed.log_weights[i] + predicted.log_weights[j]
        return Population(Candidates(build, len(i)), log_weights, parents, {**predicted.notes, "eta": self.eta})


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
