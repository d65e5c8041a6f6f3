"""The schemes that are compared: every registered resampler, and `KDpp`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from kdpp import KDpp

from mstfilter.smc import (
    Chopthin,
    ClusterStratified,
    Coalesced,
    Equivalence,
    FearnheadClifford,
    Gaussian,
    KeepWeights,
    Killing,
    LargestWeights,
    Multinomial,
    Resampler,
    Residual,
    Shuffled,
    Similarity,
    Sorted,
    Ssp,
    Stratified,
    Systematic,
    Tempered,
)

BASE = "systematic"  # what all others are compared with


def schemes(similarity: Similarity, equivalence: Equivalence) -> dict[str, Resampler]:
    """Schemes by registered name; wrappers wrap their default scheme. `sorted` is only for numbers (`Gaussian`)."""
    for_all = {
        BASE: Systematic(),
        "ssp": Ssp(),
        "shuffled": Shuffled(),
        "residual": Residual(),
        "stratified": Stratified(),
        "killing": Killing(),
        "multinomial": Multinomial(),
        "chopthin": Chopthin(),
        "tempered": Tempered(),
        "fearnhead_clifford": FearnheadClifford(),
        "coalesced": Coalesced(equivalence=equivalence),
        "clusters": ClusterStratified(similarity),
        "kdpp": KDpp(similarity),
        "largest_weights": LargestWeights(),
        "keep_weights": KeepWeights(),
    }
    for_numbers = {"sorted": Sorted()}
    return for_all | (for_numbers if isinstance(similarity, Gaussian) else {})


@dataclass(frozen=True, eq=False)
class Table(Similarity):
    """Similarity of particles that are row numbers of a known matrix."""

    known: np.ndarray

    def matrix(self, particles: Any) -> np.ndarray:
        """Similarities (n, n) of the rows."""
        return self.known[np.ix_(particles, particles)]


@dataclass(frozen=True, eq=False)
class Names(Equivalence):
    """Classes of particles that are row numbers of a known list of classes."""

    known: np.ndarray

    def classes(self, particles: Any) -> np.ndarray:
        """Classes (n,) of the rows."""
        return self.known[particles]
