"""The exact filter: the forward algorithm over all configurations.

>>> exact = exact_filter(world, glances)
>>> exact.posterior[-1] @ world.states.same_object      # (P,) probability that two cells are one object
>>> exact.log_evidence[-1]                              # log p(y_0 .. y_T)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.oracles.miniature.world import Glance, Miniature

__all__ = ["Exact", "exact_filter"]


@dataclass(frozen=True, eq=False)
class Exact:
    """What can be known.

    Parameters
    ----------
    posterior : (T, S)
        p(x_t | y_0 .. y_t).
    log_evidence : (T,)
        log p(y_0 .. y_t).
    """

    posterior: np.ndarray
    log_evidence: np.ndarray


def exact_filter(world: Miniature, glances: Sequence[Glance | None]) -> Exact:
    """Filter a sequence of observations exactly; None is a missing one (its push is unknown too)."""
    p, total = world.prior, 0.0
    posterior, evidence = [], []
    for t, glance in enumerate(glances):
        if t:
            p = world.predict(p, None if glance is None else glance.action)
        log_g = world.log_likelihood(glance)
        joint = p * np.exp(log_g - log_g.max())
        total += np.log(joint.sum()) + log_g.max()
        p = joint / joint.sum()
        posterior.append(p)
        evidence.append(total)
    return Exact(np.array(posterior), np.array(evidence))
