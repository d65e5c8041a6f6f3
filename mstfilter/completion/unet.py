"""The completion network: a small 3-D U-Net with a latent variable for the hidden extent. Imports torch.

>>> network = load_network("completion")
>>> p = network.probabilities([seen], [None], edge=32)      # (1, 32, 32, 32), the mode of the hidden extent

The input is a crop of the workspace's voxel lattice (`mstfilter.completion.crops`); the output is a logit for each
voxel. Blocks work at a half, a quarter and an eighth of the resolution; 2 x 2 x 2 voxels enter and leave as channels.
A latent vector z scales and shifts the features at the two coarse levels (FiLM; E. Perez, F. Strub, H. de Vries,
V. Dumoulin, A. Courville, "FiLM: visual reasoning with a general conditioning layer", AAAI 2018). It is drawn from a
prior that depends on the input; in training from a posterior that also sees the true shape (conditional variational
autoencoder; K. Sohn, H. Lee, X. Yan, "Learning structured output representation using deep conditional generative
models", NeurIPS 2015).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mstfilter.completion.completer import ObservedBox
from mstfilter.completion.crops import BATCH, CHANNELS, channels, encode_box
from mstfilter.trained import TrainedModel, calibrated_network, open_model

ARCHITECTURE = "completion-unet"


class LatentLaw(NamedTuple):
    """A diagonal normal law."""

    mean: Tensor  #: (b, d)
    log_std: Tensor  #: (b, d)

    def draw(self, noise: Tensor) -> Tensor:
        """A draw (b, d) from standard normal noise (b, d)."""
        return self.mean + noise * self.log_std.exp()

    def divergence(self, other: LatentLaw) -> Tensor:
        """Kullback-Leibler divergence (b,) from `other`, in nats."""
        ratio = 2 * (self.log_std - other.log_std)
        distance = ((self.mean - other.mean) * (-other.log_std).exp()) ** 2
        return 0.5 * (ratio.exp() + distance - 1 - ratio).sum(dim=1)


def _to_channels(x: Tensor) -> Tensor:
    """(b, c, 2x, 2y, 2z) -> (b, 8 c, x, y, z)."""
    b, c, nx, ny, nz = x.shape
    x = x.reshape(b, c, nx // 2, 2, ny // 2, 2, nz // 2, 2)
    return x.permute(0, 1, 3, 5, 7, 2, 4, 6).reshape(b, 8 * c, nx // 2, ny // 2, nz // 2)


def _to_voxels(x: Tensor) -> Tensor:
    """(b, 8, x, y, z) -> (b, 2x, 2y, 2z)."""
    b, _, nx, ny, nz = x.shape
    return x.reshape(b, 2, 2, 2, nx, ny, nz).permute(0, 4, 1, 5, 2, 6, 3).reshape(b, 2 * nx, 2 * ny, 2 * nz)


class _Block(nn.Module):
    """Residual block with two convolutions; z scales and shifts what lies between them."""

    def __init__(self, width: int, latent: int = 0) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, width), nn.GroupNorm(8, width)
        self.conv1, self.conv2 = nn.Conv3d(width, width, 3, padding=1), nn.Conv3d(width, width, 3, padding=1)
        self.film = nn.Linear(latent, 2 * width) if latent else None

    def forward(self, x: Tensor, z: Tensor | None = None) -> Tensor:
        y = self.norm2(self.conv1(functional.silu(self.norm1(x))))
        if self.film is not None and z is not None:
            scale, shift = self.film(z)[:, :, None, None, None].chunk(2, dim=1)
            y = y * (1 + scale) + shift
        return x + self.conv2(functional.silu(y))


class CompletionNet(nn.Module):
    """See the module.

    Parameters
    ----------
    channels : int
        Of the input.
    width : int
        Features at half the resolution, a multiple of 8; twice and four times as many below.
    latent : int
        Dimension of z.
    """

    def __init__(self, channels: int, width: int, latent: int) -> None:
        super().__init__()
        self.stem = nn.Conv3d(8 * channels, width, 3, padding=1)
        self.fine = _Block(width)
        self.down1 = nn.Conv3d(width, 2 * width, 2, stride=2)
        self.middle = _Block(2 * width)
        self.down2 = nn.Conv3d(2 * width, 4 * width, 2, stride=2)
        self.coarse = nn.ModuleList([_Block(4 * width), _Block(4 * width)])
        self.prior = nn.Linear(4 * width, 2 * latent)
        self.mixed = nn.ModuleList([_Block(4 * width, latent), _Block(4 * width, latent)])
        self.up1 = nn.Conv3d(4 * width, 2 * width, 1)
        self.join1 = nn.Conv3d(4 * width, 2 * width, 1)
        self.rise = _Block(2 * width, latent)
        self.up2 = nn.Conv3d(2 * width, width, 1)
        self.join2 = nn.Conv3d(2 * width, width, 1)
        self.end = _Block(width)
        self.head = nn.Conv3d(width, 8, 1)
        nn.init.zeros_(self.head.weight)
        #: Logit of a voxel that is not extruded, and what extrusion adds: the network starts from this rule.
        self.rule = nn.Parameter(torch.tensor([-3.0, 4.4]))

    def encode(self, x: Tensor) -> tuple[list[Tensor], LatentLaw]:
        """Features of an input (b, channels, X, Y, Z), and the prior of z. Edges are multiples of 8 voxels."""
        fine = self.fine(self.stem(_to_channels(x)))
        middle = self.middle(self.down1(fine))
        coarse = self.down2(middle)
        for block in self.coarse:
            coarse = block(coarse)
        mean, log_std = self.prior(coarse.mean(dim=(2, 3, 4)).float()).chunk(2, dim=1)
        return [fine, middle, coarse, x[:, -1]], LatentLaw(mean, log_std.clamp(-4, 2))

    def decode(self, features: list[Tensor], z: Tensor) -> Tensor:
        """Logits (b, X, Y, Z) of a latent vector (b, latent)."""
        fine, middle, x, extruded = features
        for block in self.mixed:
            x = block(x, z)
        x = functional.interpolate(self.up1(x), scale_factor=2)
        x = self.rise(self.join1(torch.cat([x, middle], dim=1)), z)
        x = functional.interpolate(self.up2(x), scale_factor=2)
        x = self.end(self.join2(torch.cat([x, fine], dim=1)))
        logits = _to_voxels(self.head(functional.silu(x)).float())
        return logits + self.rule[0] + self.rule[1] * extruded.float()


class ShapePosterior(nn.Module):
    """The law of z given the input and the true shape; used in training only."""

    def __init__(self, width: int, latent: int) -> None:
        super().__init__()
        self.stem = nn.Conv3d(8, width, 3, padding=1)
        self.down1 = nn.Conv3d(2 * width, 2 * width, 3, stride=2, padding=1)
        self.down2 = nn.Conv3d(2 * width, 4 * width, 3, stride=2, padding=1)
        self.law = nn.Linear(8 * width, 2 * latent)

    def forward(self, features: list[Tensor], truth: Tensor) -> LatentLaw:
        """From the features of the input, and the true shape (b, X, Y, Z) as 0 and 1."""
        x = functional.silu(self.stem(_to_channels(truth[:, None])))
        x = functional.silu(self.down1(torch.cat([x, features[0].detach()], dim=1)))
        x = functional.silu(self.down2(x))
        pooled = torch.cat([x.mean(dim=(2, 3, 4)), features[2].detach().mean(dim=(2, 3, 4))], dim=1)
        mean, log_std = self.law(pooled.float()).chunk(2, dim=1)
        return LatentLaw(mean, log_std.clamp(-4, 2))


class TrainedNetwork:
    """A completion network that is ready for use."""

    def __init__(self, model: TrainedModel) -> None:
        self.net, self.scale, self.shift = calibrated_network(
            model, CHANNELS, lambda values: CompletionNet(len(CHANNELS), int(values["width"]), int(values["latent"]))
        )
        self.latent, self.key = self.net.prior.out_features // 2, model.key

    def probabilities(self, seen: Sequence[ObservedBox], noise: Sequence[np.ndarray | None], edge: int) -> np.ndarray:
        """Calibrated probabilities (n, edge, edge, edge) float32 of at most `BATCH` boxes.

        `noise` is standard normal (latent,) for a draw of the hidden extent, None for the mode.
        """
        bits = np.zeros((BATCH, edge, edge, edge), np.uint8)
        signed = np.zeros(bits.shape, np.int8)
        height = np.zeros(edge)
        for k, one in enumerate(seen):
            a, b, c = one.surface.shape
            bits[k, :a, :b, :c], signed[k, :a, :b, :c] = encode_box(one)
            step = one.height[1] - one.height[0] if c > 1 else 0.01
            height = one.height[0] + step * np.arange(edge)
        drawn = np.zeros((BATCH, self.latent), np.float32)
        for k, values in enumerate(noise):
            if values is not None:
                drawn[k] = values
        with torch.inference_mode():
            x = channels(torch.from_numpy(bits), torch.from_numpy(signed), torch.from_numpy(height).float())
            features, prior = self.net.encode(x)
            logits = self.net.decode(features, prior.draw(torch.from_numpy(drawn)))
            p = torch.sigmoid(self.scale * logits + self.shift)
        return np.asarray(p.numpy()[: len(seen)])


@functools.lru_cache(maxsize=4)
def load_network(name: str) -> TrainedNetwork:
    """The network of a model's name or folder; see `mstfilter.trained.open_model`."""
    return TrainedNetwork(open_model(name, ARCHITECTURE))
