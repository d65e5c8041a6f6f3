"""A small network that corrects the linear log odds of pairs of regions.

>>> network = PairNetwork.of(model.tensors)        # of a border model; None if the model has no such network
>>> odds = features @ weights + network(features)  # log odds (k,) that two regions are different objects

The network is a multilayer perceptron with rectified linear units. The features (k, f) are standardised, and limited
to `MOST_DEVIATION` standard deviations. So the correction stays bounded for features that the fit has not seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

PREFIX = "pairs."  #: of the names of the network's tensors in a model
MOST_DEVIATION = 4.0  #: standard deviations


@dataclass(frozen=True, eq=False)
class PairNetwork:
    """A multilayer perceptron with one output for each row of features."""

    mean: np.ndarray  #: (f,) of the features in the fit
    scale: np.ndarray  #: (f,) standard deviations
    weights: tuple[np.ndarray, ...]  #: (inputs, outputs) of each layer
    biases: tuple[np.ndarray, ...]  #: (outputs,) of each layer

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Corrections (k,) of the log odds for features (k, f)."""
        x = self.standardised(features)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.maximum(x @ weight + bias, 0)
        return np.asarray((x @ self.weights[-1] + self.biases[-1])[:, 0])

    def standardised(self, features: np.ndarray) -> np.ndarray:
        """The input (k, f) of the first layer."""
        return np.clip((features - self.mean) / self.scale, -MOST_DEVIATION, MOST_DEVIATION)

    @classmethod
    def of(cls, tensors: Mapping[str, np.ndarray]) -> Self | None:
        """The network in the tensors of a model; None if there is none."""
        own = {
            name.removeprefix(PREFIX): t.astype(np.float64) for name, t in tensors.items() if name.startswith(PREFIX)
        }
        if not own:
            return None
        n = sum(name.startswith("weight") for name in own)
        layers = range(n)
        return cls(
            own["mean"], own["scale"], *(tuple(own[f"{part}{k}"] for k in layers) for part in ("weight", "bias"))
        )

    def tensors(self) -> dict[str, np.ndarray]:
        """The arrays of the network by name, as `of` expects them."""
        layers = {f"weight{k}": w for k, w in enumerate(self.weights)} | {
            f"bias{k}": b for k, b in enumerate(self.biases)
        }
        return {PREFIX + name: t for name, t in {"mean": self.mean, "scale": self.scale, **layers}.items()}
