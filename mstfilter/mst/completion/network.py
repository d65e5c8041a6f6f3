"""Completion by a trained network: that of the package (`mstfilter.mst.completion.unet`), or one of your own.

>>> NetworkCompleter().complete(rng, frame, masks, grid)                     # the weights of the package
>>> NetworkCompleter(weights="trained/mine", architecture=MyArchitecture())  # an `Architecture` of the user
>>> NetworkCompleter(weights="mine.onnx")                                    # needs the extra `onnx`

Objects larger than 64 cm are completed by `Extrude`, because the network was trained on smaller ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_dilation

from mstfilter.base.errors import missing_library
from mstfilter.base.fields import Share
from mstfilter.mst.completion.crops import BATCH, EDGE, LARGER, Architecture
from mstfilter.mst.completion.extrude import Extrude
from mstfilter.mst.completion.lattice import OnLattice
from mstfilter.mst.completion.observed import ObservedBox
from mstfilter.mst.completion.posterior import Posterior
from mstfilter.scene import Recording, UsesFiles

if TYPE_CHECKING:
    from mstfilter.mst.completion.unet import TrainedNetwork


_LAYER = 0.8  # voxels behind the measured surface: the end of the layer that is kept
_LARGE_SURFACE = 100  # voxels of this layer


@dataclass(frozen=True)
class NetworkCompleter(OnLattice, UsesFiles):
    """Completion by a trained network.

    Parameters
    ----------
    weights : str
        Name of a trained model of the package, the folder of a model (`mstfilter.base.trained`), or an ONNX file.
    least_surface : float
        Walls and plates that are thinner than a voxel contain the centres of few voxels, so the network removes much
        of their surface. If less than the share `least_surface` of a large visible surface survives, all of it is
        restored (p >= .5). With 0, none is.
    prior : Posterior
        The prior over whole shapes, whose mean is a channel of the weights `completion_prior`. A network without this
        channel does not use it.
    architecture : Architecture, optional
        That of the model in the folder. The default is that of the package's network.
    """

    weights: str = "completion"
    least_surface: Share = 2 / 3
    prior: Posterior = Posterior()  # noqa: RUF009 (frozen)
    architecture: Architecture | None = None

    @property
    def network(self) -> TrainedNetwork:
        """The network with its weights. Raises InputError if weights are missing or invalid."""
        try:
            from mstfilter.mst.completion.unet import load_network
        except ImportError as error:
            hint = "or complete by a rule: the preset mst_rules"
            raise missing_library(error, "the completion network", hint, library="torch") from error
        return load_network(self.weights, self.architecture)

    def check_files(self, recording: Recording) -> None:
        """Load the network, so that errors are raised before a run."""
        _ = self.network

    @property
    def weights_key(self) -> str:
        return self.network.key

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        return self.fill_many([rng], [seen])[0]

    def fill_many(self, rngs: Sequence[np.random.Generator], seen: Sequence[ObservedBox]) -> list[np.ndarray]:
        results: list[np.ndarray] = [np.zeros(one.surface.shape, np.float32) for one in seen]
        by_edge: dict[int, list[int]] = {}
        for k, one in enumerate(seen):
            if max(one.surface.shape) > LARGER[-1]:
                results[k] = Extrude().fill(rngs[k], one)
            elif one.surface.size:
                edge = next(n for n in (EDGE, *LARGER) if max(one.surface.shape) <= n)
                by_edge.setdefault(edge, []).append(k)
        for edge, members in by_edge.items():
            for start in range(0, len(members), BATCH):
                chosen = members[start : start + BATCH]
                boxes = [seen[k] for k in chosen]
                priors = [self.prior.fill(rngs[k], seen[k]) for k in chosen] if self.network.has_prior else None
                p = self.network.probabilities(boxes, edge, priors)
                for k, one in zip(chosen, p, strict=True):
                    a, b, c = seen[k].surface.shape
                    results[k] = self._with_surface(one[:a, :b, :c], seen[k])
        return results

    def _with_surface(self, p: np.ndarray, seen: ObservedBox) -> np.ndarray:
        """Probabilities (a, b, c), at least .5 on the visible surface if the network removes much of this surface."""
        with np.errstate(invalid="ignore"):
            layer = seen.surface & (seen.signed < _LAYER) & binary_dilation(seen.points > 0, np.ones((3, 3, 3)))
        n = np.count_nonzero(layer)
        if n < _LARGE_SURFACE or np.count_nonzero(p[layer] >= 0.5) >= self.least_surface * n:
            return p
        return np.where(layer, np.maximum(p, np.float32(0.5)), p)
