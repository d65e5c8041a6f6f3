"""The input of the completion network: a crop of the voxel grid around the visible part of an object.

>>> low, high = crop_box(voxels, grid)                     # the limits of the crop
>>> x = channels(bits, signed, height)                     # the input of the network
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mstfilter.mst.completion.extrude import extruded_down
from mstfilter.scene import Seen, VoxelGrid

if TYPE_CHECKING:
    from torch import nn

LATTICE = 0.01  # metres, edge of a voxel of the network's lattice
EDGE = 32  # voxels, edge of a crop
LARGER = (48, 64)  # crops for larger objects: the network is convolutional
#: Boxes of a batch. Results do not depend on the other boxes of a batch only if all batches have one size.
BATCH = 4

#: Channels of the input. The first five and the last are 0 or 1; "distance" is the signed distance behind the
#: measured surface, in units of 4 voxels, 0 where it is unknown; "height" is above the table, in units of 0.25 m;
#: "extruded" is what `Extrude` gives, from which the network starts.
CHANNELS = (
    "own surface",
    "other surface",
    "free",
    "hidden by itself",
    "hidden by another",
    "distance",
    "height",
    "extruded",
)
#: A further channel that a network of the package may have: the mean of `Posterior`.
PRIOR = "posterior"


@dataclass(frozen=True)
class Architecture(ABC):
    """Builds a completion network for weights of your own.

    The weights are in the folder of a model (`mstfilter.base.trained`), whose ``model.toml`` names the class in the
    entry `architecture`.
    """

    @abstractmethod
    def build(self) -> nn.Module:
        """Build the network with arbitrary weights.

        The input of the network is (b, 8, X, Y, Z) float32, with the channels of `CHANNELS`. The output is an array
        of logits, (b, X, Y, Z) or (b, 1, X, Y, Z).
        """


def crop_box(voxels: np.ndarray, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """First voxel (3,) of the crop of an object with readings in `voxels` (k, 3), and the voxel after the crop.

    The crop is centred on the range of the readings (percentiles 2 to 98), stands on the table, and ends at the
    border of the grid. If the object is larger than all crops of the network, the crop contains all of it.
    """
    low, high = np.percentile(voxels, (2, 98), axis=0)
    table = max(0, int(np.floor(-grid.origin[2] / grid.voxel_size + 1e-6)))
    extent = max(*(high - low + 1)[:2] + 4, float(high[2]) - table + 3) * grid.voxel_size / LATTICE
    edge = next((n for n in (EDGE, *LARGER) if extent <= n), extent)
    edge = int(np.ceil(edge * LATTICE / grid.voxel_size - 1e-6))
    start = np.floor((low + high + 1) / 2).astype(np.int64) - edge // 2
    start[2] = table
    return np.maximum(start, 0), np.minimum(start + edge, grid.shape)


def channels(bits: Any, signed: Any, height: Any, prior: Any = None) -> Any:
    """Input (b, 8, X, Y, Z) float32 of the network, as a torch tensor; with a prior, there are nine channels.

    Parameters
    ----------
    bits, signed : (b, X, Y, Z) tensors of uint8 and int8
        Flags and distances of `encode_box`, padded with zeros.
    height : (Z,) float tensor
        Heights of the layers above the table in metres.
    prior : (b, X, Y, Z) float tensor, optional
        Probabilities for the channel `PRIOR`.
    """
    import torch

    n = len(CHANNELS) + (prior is not None)
    x = torch.empty((len(bits), n, *bits.shape[1:]), dtype=torch.float32)
    for k, flag in enumerate(Seen):
        x[:, k] = flag.among(bits)
    x[:, 5] = signed.float() / 127
    x[:, 6] = height / 0.25
    x[:, 7] = extruded(bits)
    if prior is not None:
        x[:, 8] = prior
    return x


def extruded(bits: Any) -> Any:
    """The result of `Extrude` for packed crops (b, X, Y, Z), a torch tensor or an array; bool, without free space."""
    filled = extruded_down(Seen.SURFACE.among(bits), Seen.OTHER_SURFACE.among(bits))
    return filled & ~Seen.FREE.among(bits)
