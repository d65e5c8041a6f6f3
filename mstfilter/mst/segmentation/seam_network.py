"""The judge of seams: a small network in torch that tells one object from two that touch.

>>> judge = load_seam_network("seams")
>>> scores = judge.scores(x, strips)          # (k,) of the divisions of a region, as `SeamMeasures.describe` has them

A region has divisions 1 .. k with the scores s_k, and it is one object with probability

    ``P(one) = 1 / (1 + sum_k exp(s_k))``,      P(division k) = exp(s_k) P(one)

so the scores are log odds against "one". The network sees each division alone: a convolutional part looks at the
strip along the seam, and a perceptron joins what it finds with the measured features.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mstfilter.base.trained import TrainedModel, calibrated_network, layer_size, load_once, one_thread, open_model
from mstfilter.mst.segmentation.pair_measures import FEATURES
from mstfilter.mst.segmentation.seam_measures import SEAM_FEATURES, STRIP, STRIP_CHANNELS

SEAM_ARCHITECTURE = "seam-judge"
INPUTS = (*FEATURES, *SEAM_FEATURES)  #: Names of the numbers that describe a division
_MOST_DEVIATION = 4.0  # standard deviations


class SeamNet(nn.Module):
    """A judge with `width` (a multiple of 4) features at its highest resolution."""

    def __init__(self, width: int) -> None:
        super().__init__()
        a, b, hidden = width, width + width // 3 // 4 * 4, 2 * width
        self.mean = nn.Parameter(torch.zeros(len(INPUTS)), requires_grad=False)
        self.scale = nn.Parameter(torch.ones(len(INPUTS)), requires_grad=False)

        def layer(n: int, m: int, size: int, stride: int) -> list[nn.Module]:
            return [nn.Conv2d(n, m, size, stride, size // 2), nn.GroupNorm(4, m), nn.SiLU()]

        self.conv = nn.Sequential(
            *layer(len(STRIP_CHANNELS), a, 5, 2),
            *layer(a, b, 3, 1),
            *layer(b, hidden, 3, 2),
            *layer(hidden, hidden, 3, 1),
        )
        self.squeeze = nn.Conv2d(hidden, 8, 1)
        self.flat = nn.Linear(8 * (STRIP[0] // 4) * (STRIP[1] // 4) + 2 * hidden, 64)
        self.head = nn.Sequential(
            *(nn.Linear(len(INPUTS) + 64, 64), nn.SiLU(), nn.Dropout(0.1)),
            *(nn.Linear(64, 64), nn.SiLU(), nn.Linear(64, 1)),
        )

    def forward(self, x: Tensor, strips: Tensor) -> Tensor:
        """Scores (k,) of divisions with inputs (k, f) and strips (k, c, *STRIP) of numbers near -1 .. 1."""
        numbers = ((x - self.mean) / self.scale).clamp(-_MOST_DEVIATION, _MOST_DEVIATION)
        y = self.conv(strips)
        y = torch.cat([self.squeeze(y).flatten(1), y.mean((2, 3)), y.amax((2, 3))], dim=1)
        return self.head(torch.cat([numbers, functional.silu(self.flat(y))], dim=1))[:, 0]


def decoded(strips: np.ndarray) -> Tensor:
    """Strips (k, c, *STRIP) uint8 as numbers."""
    return ((torch.from_numpy(strips).float() - 128) / 64).contiguous(memory_format=torch.channels_last)


class SeamNetwork:
    """A judge with loaded weights."""

    def __init__(self, model: TrainedModel) -> None:
        self.net, self.scale, self.shift = calibrated_network(
            model, [*INPUTS, *STRIP_CHANNELS], lambda values: SeamNet(layer_size(values, "width", 4))
        )
        self.key = model.key

    def scores(self, x: np.ndarray, strips: np.ndarray) -> np.ndarray:
        """Scores (k,) of the divisions of a region."""
        with torch.inference_mode(), one_thread():
            found = self.net(torch.from_numpy(np.nan_to_num(x)), decoded(strips)).numpy().astype(np.float64)
        return np.asarray(self.scale * found + self.shift)


@load_once
def load_seam_network(name: str) -> SeamNetwork:
    """Load the judge of a trained model, given by name or folder. See `mstfilter.base.trained.open_model`."""
    return SeamNetwork(open_model(name, SEAM_ARCHITECTURE))
