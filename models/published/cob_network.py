"""The network of COB (Maninis et al. 2016, 2018) in torch, layer by layer as its published deploy.prototxt.

>>> network = CobNetwork()
>>> network.load_caffe(read_caffemodel("COB_PASCALContext_trainval.caffemodel"))
>>> found = network(cob_input(frame.rgb))        # fine, coarse: (H, W); orientations: (8, H, W); all in 0 .. 1

A ResNet-50 without batch normalisation and without bias in its blocks. The first convolution has stride 1 and a bias,
and a 2 x 2 pooling follows it, so the five levels have strides 1, 2, 4, 8 and 16. As in Caffe, pooling rounds sizes
up, and the first 1 x 1 convolutions of a stage have its stride. Each level has a side output of one channel, which a
fixed bilinear deconvolution enlarges. The fine output is a 1 x 1 convolution of sides 1 to 4, the coarse one of sides
2 to 5. Each of eight heads for the orientation has two 3 x 3 convolutions per level, to 32 and to 4 channels, without
an activation between them, the deconvolutions, and a 3 x 3 convolution of all 20 channels.

Modules have the names of the layers in Caffe. There are 148 convolutions; models that were trained with the output
``new-score-weighting`` have one more, which is not used. Deconvolutions are not stored, because they are fixed.

This file imports torch; cob.py loads it when the network is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from mstfilter.base.errors import InputError

N_ORIENTATIONS = 8
#: Mean of each channel, R G B, subtracted from the input (`cob_detect.m`).
MEANS = (122.67891434, 116.66876762, 104.00698793)
#: Name, last layer, channels and stride of each level.
LEVELS = (("conv1", 64, 1), ("res2c", 256, 2), ("res3d", 512, 4), ("res4f", 1024, 8), ("res5c", 2048, 16))
_STAGES = ((2, "abc", 64), (3, "abcd", 128), (4, "abcdef", 256), (5, "abc", 512))  # stage, blocks, channels


class Convolution(NamedTuple):
    """A convolution of the network."""

    name: str
    inputs: int
    outputs: int
    kernel: int
    stride: int = 1
    bias: bool = True


def cob_convolutions() -> Iterator[Convolution]:
    """All convolutions, in the order of the prototxt."""
    yield Convolution("conv1", 3, 64, 7)
    inputs = 64
    for stage, blocks, width in _STAGES:
        for block in blocks:
            stride = 2 if block == "a" and stage > 2 else 1
            name = f"res{stage}{block}_branch"
            if block == "a":
                yield Convolution(f"{name}1", inputs, 4 * width, 1, stride, False)
            yield Convolution(f"{name}2a", inputs, width, 1, stride, False)
            yield Convolution(f"{name}2b", width, width, 3, 1, False)
            yield Convolution(f"{name}2c", width, 4 * width, 1, 1, False)
            inputs = 4 * width
    for k, (_, width, _) in enumerate(LEVELS, start=1):
        yield Convolution(f"score-dsn{k}", width, 1, 1)
    yield Convolution("new-score-weighting1", 4, 1, 1)
    yield Convolution("new-score-weighting3", 4, 1, 1)
    for k in range(1, N_ORIENTATIONS + 1):
        for level, width, _ in LEVELS:
            yield Convolution(f"{level}_or8_{k}", width, 32, 3)
            yield Convolution(f"{level}_4_or8_{k}", 32, 4, 3)
        yield Convolution(f"score-or8_{k}", 4 * len(LEVELS), 1, 3)


class CobOutput(NamedTuple):
    """Outputs of the network."""

    fine: torch.Tensor  #: (H, W) P(contour) at the fine scale
    coarse: torch.Tensor  #: (H, W) P(contour) at the coarse scale
    orientations: torch.Tensor  #: (8, H, W) confidence that the normal of the contour has the angle k pi / 8


class CobNetwork(nn.Module):
    """COB for RGB images."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleDict(
            {
                c.name: nn.Conv2d(c.inputs, c.outputs, c.kernel, c.stride, c.kernel // 2, bias=c.bias)
                for c in cob_convolutions()
            }
        )
        self.requires_grad_(False)

    def load_caffe(self, blobs: Mapping[str, tuple[np.ndarray, ...]]) -> None:
        """Load the blobs of a Caffe model. Raises InputError if a layer is missing or has another shape."""
        names = [c.name for c in cob_convolutions()]
        missing = [name for name in names if name not in blobs]
        if missing:
            raise InputError(
                f"the model lacks {len(missing)} of {len(names)} layers, the first is {missing[0]!r}",
                "expected COB for RGB images",
            )
        for name in names:
            parameters = list(self.layers[name].parameters())
            expected = [tuple(p.shape) for p in parameters]
            found = [blob.shape for blob in blobs[name]]
            if found != expected:
                raise InputError(f"layer {name!r} has blobs of shape {found}, expected {expected}", "expected COB")
            for parameter, blob in zip(parameters, blobs[name], strict=True):
                if not np.isfinite(blob).all():
                    raise InputError(f"layer {name!r} has a weight that is not finite", "download the file again")
                parameter.data = torch.from_numpy(blob.reshape(parameter.shape).astype(np.float32))
        _check_deconvolutions(blobs)

    def forward(self, image: torch.Tensor) -> CobOutput:
        """Outputs for an input (C, H, W) of `cob_input`."""
        size = image.shape[-2:]
        levels = self._levels(image[None])
        sides = [
            enlarge(self.layers[f"score-dsn{k}"](x), stride, size)
            for k, (x, (_, _, stride)) in enumerate(zip(levels, LEVELS, strict=True), start=1)
        ]
        fine = self.layers["new-score-weighting1"](torch.cat(sides[:4], dim=1))
        coarse = self.layers["new-score-weighting3"](torch.cat(sides[1:], dim=1))
        orientations = [self._orientation(levels, k, size) for k in range(1, N_ORIENTATIONS + 1)]
        return CobOutput(fine.sigmoid()[0, 0], coarse.sigmoid()[0, 0], torch.cat(orientations)[:, 0].sigmoid())

    def _levels(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Outputs of the five levels of the ResNet."""
        x = self.layers["conv1"](x).relu()
        levels = [x]
        x = functional.max_pool2d(x, 2, 2, ceil_mode=True)
        for stage, blocks, _ in _STAGES:
            for block in blocks:
                name = f"res{stage}{block}_branch"
                y = self.layers[f"{name}2a"](x).relu()
                y = self.layers[f"{name}2c"](self.layers[f"{name}2b"](y).relu())
                x = ((self.layers[f"{name}1"](x) if block == "a" else x) + y).relu()
            levels.append(x)
        return levels

    def _orientation(self, levels: list[torch.Tensor], k: int, size: torch.Size) -> torch.Tensor:
        """Score (1, 1, H, W) of one bin of orientation."""
        parts = [
            enlarge(self.layers[f"{name}_4_or8_{k}"](self.layers[f"{name}_or8_{k}"](x)), stride, size)
            for x, (name, _, stride) in zip(levels, LEVELS, strict=True)
        ]
        out: torch.Tensor = self.layers[f"score-or8_{k}"](torch.cat(parts, dim=1))
        return out


def bilinear_kernel(stride: int) -> np.ndarray:
    """The kernel (2 s, 2 s) of a bilinear enlargement by s, float32."""
    size = 2 * stride
    one = 1 - np.abs(np.arange(size) - (stride - 0.5)) / stride
    return np.outer(one, one).astype(np.float32)


def enlarge(x: torch.Tensor, stride: int, size: torch.Size) -> torch.Tensor:
    """Bilinear deconvolution of each channel of (1, C, h, w), cropped to `size` (H, W).

    Caffe's layer Crop finds the offset from the strides and paddings of the layers: stride - 1 pixels.
    """
    if stride > 1:
        kernel = torch.from_numpy(bilinear_kernel(stride)).to(x)
        channels = x.shape[1]
        x = functional.conv_transpose2d(x, kernel.expand(channels, 1, *kernel.shape), stride=stride, groups=channels)
    offset = stride - 1
    return x[..., offset : offset + size[0], offset : offset + size[1]]


def _check_deconvolutions(blobs: Mapping[str, tuple[np.ndarray, ...]]) -> None:
    """Raise InputError if a stored deconvolution is not the bilinear one that the network uses."""
    for name, stored in blobs.items():
        if name.startswith("upsample_"):
            stride = int(name.split("_")[1])
            kernel = bilinear_kernel(stride)
            weights = stored[0]
            expected = np.zeros(weights.shape, np.float32)
            if weights.shape[-2:] == kernel.shape and weights.ndim == 4:
                for channel in range(min(weights.shape[:2])):
                    expected[channel, channel] = kernel
            if not np.allclose(weights, expected, atol=1e-4) or any(bias.any() for bias in stored[1:]):
                raise InputError(f"deconvolution {name!r} of the model is not bilinear", "expected COB")


def cob_input(image: np.ndarray) -> torch.Tensor:
    """The input (3, H, W) float32 of an image (H, W, 3) RGB uint8: without the means, the channels are B G R."""
    centred = image.astype(np.float32) - np.array(MEANS, np.float32)
    return torch.from_numpy(np.ascontiguousarray(centred[..., ::-1].transpose(2, 0, 1)))
