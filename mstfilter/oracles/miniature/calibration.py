"""Simulation-based calibration: is the truth just another draw of the posterior?

>>> ranks = [rank(rng, statistic, class_weights(world, population), truth) for ...]    # one a simulated world
>>> uniformity(np.array(ranks))                                                        # p value

A world is drawn from the prior and simulated, the filter runs on what the sensors say, and a scalar of the true
state is ranked among those of `DRAWS` draws from the filter's answer, ties broken at random. If the answers are exact
posteriors the ranks are uniform (Cook, Gelman, Rubin 2006; Talts et al. 2018). Too narrow answers make the ranks
pile up at both ends, biased ones at one end.
"""

from __future__ import annotations

import numpy as np

from mstfilter.oracles.miniature.world import Miniature, draw

__all__ = ["DRAWS", "rank", "statistics", "uniformity"]

DRAWS = 9  # ranks 0 .. 9: ten bins


def statistics(world: Miniature) -> dict[str, np.ndarray]:
    """Scalars (S,) of the states: objects, occupied cells, size of the object in the middle cell, pairs joined."""
    s = world.states
    cell = s.labels.shape[1] // 2
    middle = s.labels[:, cell]
    return {
        "n_objects": s.n_objects.astype(np.float64),
        "occupied": s.occupied.sum(axis=1).astype(np.float64),
        "size_in_the_middle": np.where(middle > 0, (s.labels == middle[:, None]).sum(axis=1), 0).astype(np.float64),
        "joined_pairs": s.same_object.sum(axis=1).astype(np.float64),
    }


def rank(rng: np.random.Generator, statistic: np.ndarray, p: np.ndarray, truth: int) -> int:
    """Rank 0 .. DRAWS of the truth's statistic (S,) among those of draws from p (S,), ties broken at random."""
    drawn = statistic[draw(rng, p, DRAWS)]
    below, ties = int((drawn < statistic[truth]).sum()), int((drawn == statistic[truth]).sum())
    return below + int(rng.integers(ties + 1))


def uniformity(ranks: np.ndarray) -> float:
    """p value of the chi-square test that ranks 0 .. DRAWS are uniform."""
    from scipy.stats import chisquare

    return float(chisquare(np.bincount(ranks, minlength=DRAWS + 1)).pvalue)
