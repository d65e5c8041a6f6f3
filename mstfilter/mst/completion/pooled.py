"""Several completers that answer as one: the weighted mean of their probabilities.

>>> Pooled()                                                               # the network and the posterior over shapes
>>> Pooled(completers=(NetworkCompleter(), Posterior(kinds=(BoxKind(),))), weights=(0.7, 0.3))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.mst.completion.completer import ClipCompleter, Completer
from mstfilter.mst.completion.lattice import OnLattice
from mstfilter.mst.completion.network import NetworkCompleter
from mstfilter.mst.completion.observed import ObservedBox
from mstfilter.mst.completion.posterior import Posterior
from mstfilter.scene import Recording, UsesFiles


@dataclass(frozen=True)
class Pooled(OnLattice, UsesFiles):
    """The weighted mean of the probabilities of several completers (a linear opinion pool).

    A mean is right if one of the completers knows better and we cannot tell which: a voxel gets a probability near 0
    or 1 only if all of them agree. On meshes of the tuning pool it has a lower log loss than the mean of log odds,
    and weights of .3 to .5 for the network differ little.

    Parameters
    ----------
    completers : tuple of Completer
        Completers whose result is the same whenever it is asked for. Their own `log_odds` are not used.
    weights : tuple of float
        A weight at least 0 for each completer. Only their ratios count. For each object, they are multiplied by the
        factors of `Completer.opinions`: a `Posterior` does not count for an object that fits none of its kinds.
    """

    completers: tuple[Completer, ...] = (NetworkCompleter(), Posterior())
    weights: tuple[float, ...] = (0.4, 0.6)

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.weights) != len(self.completers) or not self.completers:
            raise InputError(
                f"{len(self.completers)} completers have {len(self.weights)} weights", "give one for each"
            )
        if not np.isfinite(self.weights).all() or min(self.weights) < 0 or not sum(self.weights):
            raise InputError(
                f"the weights {self.weights} cannot be normalised", "give numbers at least 0, one above 0"
            )
        for one in self.completers:
            if one.stochastic or isinstance(one, ClipCompleter):
                raise InputError(
                    f"{type(one).__name__} cannot be pooled: its results differ between draws or between clips"
                )

    def check_files(self, recording: Recording) -> None:
        for one in self.completers:
            if isinstance(one, UsesFiles):
                one.check_files(recording)

    @property
    def weights_key(self) -> str:
        return "".join(one.weights_key for one in self.completers)

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        return self.fill_many([rng], [seen])[0]

    def fill_many(self, rngs: Sequence[np.random.Generator], seen: Sequence[ObservedBox]) -> list[np.ndarray]:
        answers = [one.opinions(rngs, seen) for one in self.completers]
        return [self.mean(of_box) for of_box in zip(*answers, strict=True)]

    def mean(self, opinions: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
        """The mean (a, b, c) of the completers' probabilities of one object, each with its factor."""
        share = np.array(self.weights) * [factor for _, factor in opinions]
        share = share if share.sum() > 0 else np.array(self.weights)
        mean = sum(s * p for s, (p, _) in zip(share / share.sum(), opinions, strict=True))
        return np.asarray(mean, np.float32)
