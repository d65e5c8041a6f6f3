"""Candidates of the update, described and weighed before any object is completed.

>>> choices = Choices.of(cells, log_weights, log_odds, 100)   # for n predictions: log_weights (n,), log_odds (n, e)
>>> choices.prediction[0], choices.partitions[0]             # prediction j, and the segment (K,) of each cell
>>> choices = choices.with_occluded(probabilities_to_stay, 100)
>>> choices.log_weights, choices.staying[0]                  # log probability, occluded objects of j that stay

A candidate is a series of choices: a prediction j, an alternative a_c for each component c of the cells, and for each
occluded object k whether it stays (e_k = 1), which it does with probability r_k. Its probability is the product

    ``w_j Q_j^lambda  prod_c P(a_c | image, j)  prod_k r_k^{e_k} (1 - r_k)^{1 - e_k},         e_k in {0, 1}``

because the components are independent given the prediction. So the factors can be multiplied one after the other, and
after each of them all but the n largest products are dropped (`largest_products`). Over all candidates the
probabilities sum to 1, so what the kept ones lack is the *discarded mass*, which is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import entr

from mstfilter.mst.partition.cells import Cells
from mstfilter.smc import Population

_CERTAIN = 1e-3  # an occluded object stays if its probability is above 1 minus this, and leaves if it is below this


@dataclass(frozen=True, eq=False)
class Choices:
    """The choices that define m candidates."""

    prediction: np.ndarray  #: (m,) index of the prediction
    partitions: np.ndarray  #: (m, K) segment of each cell, 1, 2, ...
    log_weights: np.ndarray  #: (m,) log probability
    staying: tuple[tuple[int, ...], ...] = ()  #: labels of the occluded objects that stay, for each candidate

    def __len__(self) -> int:
        return len(self.prediction)

    @classmethod
    def of(
        cls, cells: Cells, log_weights: np.ndarray, log_odds: Sequence[np.ndarray], n: int, temperature: float = 1.0
    ) -> Choices:
        """The n most probable pairs of a prediction and a partition.

        Parameters
        ----------
        cells : Cells
        log_weights : (predictions,) float
            log (w_j Q_j^lambda), where the weights w_j Q_j^lambda sum to 1.
        log_odds : (predictions, e) float
            Log odds of "one object" of each pair of cells, given each prediction.
        n : int
            Largest number of candidates.
        temperature : float
            T. The probability of an alternative is proportional to P(a_c | image, j)^(1/T).
        """
        components = cells.alternatives()
        found, entropies = [], np.zeros(len(components))
        for j, (log_weight, odds) in enumerate(zip(log_weights, log_odds, strict=True)):
            p = [tempered(cells.probabilities(odds, component), temperature) for component in components]
            entropies += np.exp(log_weight) * np.array([entr(one).sum() for one in p])
            with np.errstate(divide="ignore"):
                chosen, log_p = largest_products([np.log(one) for one in p], n)
            found.append((np.full(len(chosen), j), chosen, log_weight + log_p))
        prediction, chosen, log_p = (np.concatenate(column) for column in zip(*found, strict=True))
        # Schemes such as systematic resampling take equal steps through the candidates. Therefore neighbours are
        # similar: the most uncertain component is the first key of the order, the prediction is the last key.
        order = np.lexsort((prediction, *chosen.T[np.argsort(entropies)]))
        partitions = np.stack([cells.joined(components, row) for row in chosen[order]])
        return cls(prediction[order], partitions, log_p[order]).most_probable(n)

    def with_occluded(self, probabilities: Sequence[dict[int, float]], n: int) -> Choices:
        """The n most probable combinations of a candidate and a set of occluded objects that stay.

        For each candidate, `probabilities` maps labels of occluded objects to the probability that the object stays.
        """
        sets = [stays(one, n) for one in probabilities]
        of = np.repeat(np.arange(len(self)), [len(one) for one in sets])
        log_p = np.array([p for one in sets for _, p in one])
        labels = tuple(kept for one in sets for kept, _ in one)
        return Choices(self.prediction[of], self.partitions[of], self.log_weights[of] + log_p, labels).most_probable(
            n
        )

    def most_probable(self, n: int) -> Choices:
        """The n candidates of largest positive weight, in unchanged order."""
        best = largest(self.log_weights, n)
        best = best[self.log_weights[best] > -np.inf]
        staying = tuple(self.staying[k] for k in best.tolist()) if self.staying else ()
        return Choices(self.prediction[best], self.partitions[best], self.log_weights[best], staying)

    def described(self, projected: Population) -> Population:
        """The candidates as a population. The particles are indices of candidates.

        `projected` are the projected predictions. The population also stores the discarded mass.
        """
        previous = projected.parents.get("previous", np.full(len(projected), -1))
        discarded = max(0.0, 1 - float(np.exp(self.log_weights).sum()))
        notes = {**projected.notes, "discarded_mass": round(discarded, 4)}
        parents = {"previous": previous[self.prediction]}
        return Population(np.arange(len(self)), self.log_weights, parents, notes)


def largest(log_weights: np.ndarray, n: int) -> np.ndarray:
    """Indices of the n largest log weights, ascending. If weights are equal, the first indices are used."""
    return np.sort(np.argsort(-log_weights, kind="stable")[:n])


def largest_products(log_factors: Sequence[np.ndarray], n: int) -> tuple[np.ndarray, np.ndarray]:
    """The n largest products of one entry from each factor.

    Parameters
    ----------
    log_factors : sequence of (k_c,) arrays
        Logarithms of the entries of each of C factors.

    Returns
    -------
    chosen : (m, C) int
        Index of the chosen entry of each factor; m is at most n.
    log_products : (m,) float
        Descending.
    """
    chosen, total = np.zeros((1, 0), np.int64), np.zeros(1)
    for factor in log_factors:
        sums = np.add.outer(total, factor).ravel()
        best = np.argsort(-sums, kind="stable")[:n]
        row, entry = np.divmod(best, len(factor))
        chosen, total = np.column_stack([chosen[row], entry]), sums[best]
    return chosen, total


def tempered(p: np.ndarray, temperature: float) -> np.ndarray:
    """Probabilities (k,) in proportion to p^(1/T)."""
    powers = p ** (1 / temperature)
    if not powers.any():  # all underflow
        powers = (p / p.max()) ** (1 / temperature)
    return powers / powers.sum()


def stays(probabilities: dict[int, float], n: int) -> list[tuple[tuple[int, ...], float]]:
    """The n most probable sets of occluded objects that stay, and their log probabilities.

    `probabilities` maps labels to the probability that the object stays. Objects stay independently.
    """
    p = np.array([*probabilities.values()])
    p = np.where(p < _CERTAIN, 0, np.where(p > 1 - _CERTAIN, 1, p))
    with np.errstate(divide="ignore"):
        chosen, total = largest_products([*np.log(np.column_stack([p, 1 - p]))], n)
    labels = np.array([*probabilities])  # entry 0 of each factor: the object stays
    return [
        (tuple(labels[row == 0].tolist()), log_p)
        for row, log_p in zip(chosen, total.tolist(), strict=True)
        if log_p > -np.inf
    ]
