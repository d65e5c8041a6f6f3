"""Completion by a Bayesian Hilbert map, as a baseline.

mstfilter run RECORDING update.completer=./experiments/completion/hilbert_map.py:HilbertMap
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import expit

from mstfilter.mst.completion import Completer, ObservedBox


@dataclass(frozen=True)
class HilbertMap(Completer):
    """Occupancy as Bayesian logistic regression on radial features, after V-PRISM.

    The training data are occupied voxels (the visible surface) and empty voxels (observed as free, on other surfaces,
    or below the table). The posterior of the weights is normal about its mode (Laplace), and the probability of a
    voxel averages over it. (H. Wright, W. Zhi, M. Johnson-Roberson, T. Hermans, "V-PRISM: probabilistic mapping of
    unknown tabletop scenes", 2024. V-PRISM has one softmax for all objects of a scene. This class has one map for
    each mask, because completions of a frame do not depend on one another.)

    Parameters
    ----------
    spacing : int
        Voxels between the centres of features.
    radius : float
        Standard deviation of a feature, in voxels.
    prior : float
        Standard deviation of the weights.
    """

    spacing: int = 3
    radius: float = 3.0
    prior: float = 2.0

    padding: ClassVar[int] = 8
    _limit: ClassVar[int] = 800  # examples of each kind

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        p = np.zeros(seen.surface.shape, np.float32)
        own = np.argwhere(seen.surface)
        if not len(own):
            return p
        low, high = np.maximum(own.min(axis=0) - 6, 0), np.minimum(own.max(axis=0) + 7, p.shape)
        low[2] = 0
        near = np.zeros(p.shape, bool)
        near[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
        ground = np.argwhere(near[:, :, :1]) - (0, 0, 1)
        empty = np.concatenate([self._some(np.argwhere(near & seen.free)), self._some(ground)])
        no = np.concatenate([empty, self._some(np.argwhere(near & seen.other_surface))])
        points = np.concatenate([self._some(own), no])
        outcome = (np.arange(len(points)) < len(points) - len(no)).astype(float)
        axes = [np.arange(a, b, self.spacing) for a, b in zip(low, high, strict=True)]
        centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        features = self._features(points, centres)
        weights, covariance = _laplace(features, outcome, self.prior)
        asked = np.argwhere(near & ~seen.free)
        for start in range(0, len(asked), 4096):
            part = asked[start : start + 4096]
            x = self._features(part, centres)
            variance = ((x @ covariance) * x).sum(axis=1)
            # The average of the logistic function over a normal law (MacKay 1992).
            p[tuple(part.T)] = expit(x @ weights / np.sqrt(1 + np.pi * variance / 8))
        return p

    def _some(self, voxels: np.ndarray) -> np.ndarray:
        return voxels[:: max(1, -(-len(voxels) // self._limit))]

    def _features(self, points: np.ndarray, centres: np.ndarray) -> np.ndarray:
        near = np.exp(-cdist(points, centres, "sqeuclidean") / (2 * self.radius**2))
        return np.column_stack([near, np.ones(len(points))])


def _laplace(features: np.ndarray, outcome: np.ndarray, prior: float) -> tuple[np.ndarray, np.ndarray]:
    """Mode (d,) of the weights of a logistic regression with a normal prior, and the covariance (d, d) at it."""
    d = features.shape[1]
    weights, precision = np.zeros(d), np.eye(d) / prior**2
    for _ in range(8):
        p = expit(features @ weights)
        hessian = (features * (p * (1 - p))[:, None]).T @ features + precision
        step = np.linalg.solve(hessian, features.T @ (outcome - p) - precision @ weights)
        weights = weights + step
        if np.abs(step).max() < 1e-3:
            break
    return weights, np.linalg.inv(hessian)
