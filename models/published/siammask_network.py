"""The network of SiamMask with refinement (Wang et al., CVPR 2019) in torch.

>>> network = SiamMaskNetwork()
>>> network.load_state(read_checkpoint("SiamMask_DAVIS.pth"))
>>> template = network.template(crop_127)                     # (1, 3, 127, 127) BGR, 0 .. 255
>>> score, box, features = network.search(template, crop_255)
>>> network.refine(features, row, column)                     # (127, 127) mask for one of 25 x 25 positions

A ResNet-50 without its last stage: the first convolution has no padding, stage 2 has 3 x 3 convolutions of stride 2
without padding, and stage 3 is dilated instead of strided. Template (7 x 7 after a crop) and search features (31 x
31) are correlated channel by channel. The branches give two scores and four box offsets for five anchors, and
features of the mask, at 25 x 25 positions. A mask is grown from one position to 127 x 127 with the features of the
earlier stages.

Names of modules and shapes are those of the published checkpoints (https://github.com/foolwood/SiamMask, MIT), so
that they load name by name. This file imports torch; siammask.py loads it when it is used.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from mstfilter.base.errors import InputError

ANCHORS = 5  #: Anchors of each position
POSITIONS = 25  #: Positions along each side of the search region

#: Outputs of the stem and of the three stages.
Features = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def _normalised(inputs: int, outputs: int, kernel: int, **options: Any) -> list[nn.Module]:
    """A convolution without bias, and batch normalisation."""
    return [nn.Conv2d(inputs, outputs, kernel, bias=False, **options), nn.BatchNorm2d(outputs)]


class _Bottleneck(nn.Module):
    def __init__(self, inputs: int, width: int, stride: int, dilation: int, shortcut: nn.Module | None) -> None:
        super().__init__()
        padding = dilation if dilation > 1 else 2 - stride
        self.conv1, self.bn1 = _normalised(inputs, width, 1)
        self.conv2, self.bn2 = _normalised(width, width, 3, stride=stride, padding=padding, dilation=dilation)
        self.conv3, self.bn3 = _normalised(width, 4 * width, 1)
        self.downsample = shortcut

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.bn1(self.conv1(x)).relu()
        y = self.bn2(self.conv2(y)).relu()
        y = self.bn3(self.conv3(y))
        out: torch.Tensor = (y + (x if self.downsample is None else self.downsample(x))).relu()
        return out


def _stage(inputs: int, width: int, blocks: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """A stage of the ResNet; only its first block has a stride, and that block is not dilated."""
    kernel = 1 if stride == dilation == 1 else 3
    shortcut = nn.Sequential(*_normalised(inputs, 4 * width, kernel, stride=stride, padding=1 if dilation > 1 else 0))
    first = _Bottleneck(inputs, width, stride, 1, shortcut)
    return nn.Sequential(first, *(_Bottleneck(4 * width, width, 1, dilation, None) for _ in range(blocks - 1)))


class _ResNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = _normalised(3, 64, 7, stride=2)
        self.layer1 = _stage(64, 64, 3)
        self.layer2 = _stage(256, 128, 4, stride=2)
        self.layer3 = _stage(512, 256, 6, dilation=2)

    def forward(self, x: torch.Tensor) -> Features:
        stem = self.bn1(self.conv1(x)).relu()
        first = self.layer1(functional.max_pool2d(stem, 3, 2, padding=1))
        second = self.layer2(first)
        return stem, first, second, self.layer3(second)


class _Reduction(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.downsample = nn.Sequential(*_normalised(1024, 256, 1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = self.downsample(x)
        return out


class _Backbone(nn.Module):
    """Features of the stages, and the last one reduced to 256 channels."""

    def __init__(self) -> None:
        super().__init__()
        self.features = _ResNet()
        self.downsample = _Reduction()

    def forward(self, x: torch.Tensor) -> tuple[Features, torch.Tensor]:
        stages = self.features(x)
        reduced = self.downsample(stages[3])
        # The rim of a template's features depends on the border of the crop.
        return stages, reduced[..., 4:-4, 4:-4] if reduced.shape[-1] < 20 else reduced


class _Correlation(nn.Module):
    """Correlation of template and search features, channel by channel, and a head."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.conv_kernel = nn.Sequential(*_normalised(256, 256, 3), nn.ReLU())
        self.conv_search = nn.Sequential(*_normalised(256, 256, 3), nn.ReLU())
        self.head = nn.Sequential(*_normalised(256, 256, 1), nn.ReLU(), nn.Conv2d(256, outputs, 1))

    def correlate(self, template: torch.Tensor, search: torch.Tensor) -> torch.Tensor:
        return depthwise_correlation(self.conv_search(search), self.conv_kernel(template))


class _Boxes(nn.Module):
    """Scores and box offsets."""

    def __init__(self) -> None:
        super().__init__()
        self.cls, self.loc = _Correlation(2 * ANCHORS), _Correlation(4 * ANCHORS)


class _Mask(nn.Module):
    """The coarse mask, whose features `_Refine` uses and whose head it replaces."""

    def __init__(self) -> None:
        super().__init__()
        self.mask = _Correlation(63 * 63)


def depthwise_correlation(x: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
    """Correlation of each channel of (1, C, H, W) with the same channel of a kernel (1, C, h, w)."""
    return functional.conv2d(x, kernel.transpose(0, 1), groups=x.shape[1])


def _two(inputs: int, middle: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, middle, 3, padding=1), nn.ReLU(), nn.Conv2d(middle, outputs, 3, padding=1), nn.ReLU()
    )


class _Refine(nn.Module):
    """Grows the mask of one position."""

    def __init__(self) -> None:
        super().__init__()
        self.v0, self.v1, self.v2 = _two(64, 16, 4), _two(256, 64, 16), _two(512, 128, 32)
        self.h2, self.h1, self.h0 = _two(32, 32, 32), _two(16, 16, 16), _two(4, 4, 4)
        self.deconv = nn.ConvTranspose2d(256, 32, 15, 15)
        self.post0 = nn.Conv2d(32, 16, 3, padding=1)
        self.post1 = nn.Conv2d(16, 4, 3, padding=1)
        self.post2 = nn.Conv2d(4, 1, 3, padding=1)

    def forward(self, stages: Features, correlation: torch.Tensor, row: int, column: int) -> torch.Tensor:
        def window(x: torch.Tensor, margin: int, step: int, size: int) -> torch.Tensor:
            padded = functional.pad(x, [margin] * 4)
            return padded[:, :, step * row : step * row + size, step * column : step * column + size]

        x = self.deconv(correlation[:, :, row, column, None, None])
        x = functional.interpolate(self.h2(x) + self.v2(window(stages[2], 4, 1, 15)), size=(31, 31))
        x = functional.interpolate(self.h1(self.post0(x)) + self.v1(window(stages[1], 8, 2, 31)), size=(61, 61))
        x = functional.interpolate(self.h0(self.post1(x)) + self.v0(window(stages[0], 16, 4, 61)), size=(127, 127))
        out: torch.Tensor = self.post2(x)[0, 0]
        return out


class SiamMaskNetwork(nn.Module):
    """SiamMask with refinement ("sharp")."""

    def __init__(self) -> None:
        super().__init__()
        self.features = _Backbone()
        self.rpn_model = _Boxes()
        self.mask_model = _Mask()
        self.refine_model = _Refine()
        self.requires_grad_(False)
        self.eval()

    def load_state(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Load the tensors of a checkpoint. Raises InputError if one is missing or has another shape."""
        own = {name: t for name, t in self.state_dict().items() if not name.endswith("num_batches_tracked")}
        missing = [name for name in own if name not in tensors]
        if missing:
            raise InputError(
                f"the checkpoint lacks {len(missing)} of {len(own)} tensors, the first is {missing[0]!r}",
                "expected SiamMask with refinement, for example SiamMask_DAVIS.pth",
            )
        for name, tensor in own.items():
            if tensors[name].shape != tensor.shape:
                shapes = f"{tuple(tensors[name].shape)}, expected {tuple(tensor.shape)}"
                raise InputError(f"tensor {name!r} of the checkpoint has shape {shapes}")
            if not torch.isfinite(tensors[name]).all():
                raise InputError(f"tensor {name!r} of the checkpoint has a value that is not finite")
        self.load_state_dict({name: tensors[name] for name in own}, strict=False)

    def template(self, crop: torch.Tensor) -> torch.Tensor:
        """Features (1, 256, 7, 7) of a template (1, 3, 127, 127)."""
        found: torch.Tensor = self.features(crop)[1]
        return found

    def search(
        self, template: torch.Tensor, crop: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, tuple[Features, torch.Tensor]]:
        """Scores (2, 5, 25, 25), box offsets (4, 5, 25, 25), features for `refine`, of a crop (1, 3, 255, 255)."""
        stages, search = self.features(crop)
        outputs = []
        for branch in (self.rpn_model.cls, self.rpn_model.loc):
            outputs.append(branch.head(branch.correlate(template, search))[0])
        shape = (ANCHORS, POSITIONS, POSITIONS)
        correlation = self.mask_model.mask.correlate(template, search)
        return outputs[0].reshape(2, *shape), outputs[1].reshape(4, *shape), (stages, correlation)

    def refine(self, features: tuple[Features, torch.Tensor], row: int, column: int) -> torch.Tensor:
        """Probability (127, 127) of the mask of a position."""
        found: torch.Tensor = self.refine_model(*features, row, column).sigmoid()
        return found


def read_checkpoint(path: Path) -> dict[str, torch.Tensor]:
    """Tensors of a checkpoint by name, without the prefix ``module.``; nothing in the file is executed.

    Raises InputError if the file is damaged, or holds more than tensors and plain values.
    """
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError, AssertionError) as error:
        raise InputError(
            f"checkpoint cannot be read: {path} ({str(error).strip().splitlines()[0] if str(error) else 'empty'})",
            "expected tensors saved by torch.save; other objects are not read",
        ) from error
    if isinstance(found, dict) and isinstance(found.get("state_dict"), dict):
        found = found["state_dict"]
    if not isinstance(found, dict) or not all(isinstance(t, torch.Tensor) for t in found.values()):
        raise InputError(f"checkpoint {path} is no dictionary of tensors", "expected SiamMask_DAVIS.pth or the like")
    return {str(name).removeprefix("module."): tensor for name, tensor in found.items()}
