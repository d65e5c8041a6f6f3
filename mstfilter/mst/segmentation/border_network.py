"""The border network, a small 2-D U-Net in torch that estimates the borders and the centres of objects.

>>> network = load_border_network("border")
>>> seen = network.look(frame)                     # maps of the frame's size
>>> seen.border[row, column], seen.foreground[row, column], seen.centre[row, column]

For each pixel, the network gives the log odds that it is at an object's border, the log odds that it belongs to an
object, and the offset to the centre of this object (Neven et al., "Instance segmentation by jointly optimizing
spatial embeddings and clustering bandwidth", CVPR 2019). A frame is reduced to 320 pixels per row for this
(`encode_image`), and the maps are interpolated to the size of the frame. The three levels of the U-Net work at a
half, a quarter and an eighth of the reduced resolution; at its input and output, blocks of 2 x 2 pixels are packed
into channels.

A model may also have a `PairNetwork`, which corrects the linear log odds of the tree `border`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mstfilter.base.trained import TrainedModel, calibrated_network, layer_size, load_once, one_thread, open_model
from mstfilter.mst.segmentation.boundary import SENSOR_FOCAL, filled_disparity
from mstfilter.mst.segmentation.regions import SeenBorders
from mstfilter.scene import BASELINE, TABLE_TOLERANCE, Camera, Frame, posed_camera

BORDER_ARCHITECTURE = "border-unet"
PAIR_TENSORS = "pairs."  #: prefix of the names of the tensors of a pair network in a border model
_MOST_DEVIATION = 4.0  # standard deviations
RASTER = 320  # pixels per row of the network's images
CENTRE_UNIT = 32.0  #: pixels of the network's raster, unit of the offsets to the centres
#: Channels of the input: disparity above the table, compressed; disparity against the mean of the surroundings; the
#: normal (right in the image, up from the table, and at a right angle to both); whether there is a reading; colour.
IMAGE_CHANNELS = ("above", "relief", "right", "up", "front", "reading", "lightness", "a", "b")
_HEIGHT_UNIT = 4.0  # sensor disparity units (1/8 px) at which `above` turns from linear to logarithmic
_SURROUNDINGS = 6.0  # pixels, standard deviation of the mean for `relief`
_MULTIPLE = 8  # image sizes that the network works on


def encode_image(frame: Frame) -> np.ndarray:
    """The input (9, H, W) float32 of the network for a frame with a camera pose."""
    h, w = frame.depth.shape
    disparity = filled_disparity(frame) if frame.valid.any() else np.zeros((h, w), np.float32)
    camera = frame.camera
    matrix = camera.pose.as_matrix()
    up = matrix[2, :3]  # of the table, in the camera's axes
    # A point z K^-1 (u, v, 1) of the table is at -h along `up`, h the height of the camera: 1 / z is affine in u, v.
    table = -8 * SENSOR_FOCAL * BASELINE / max(float(matrix[2, 3]), 1e-3) * (camera.rays() @ up)
    x = np.zeros((len(IMAGE_CHANNELS), h, w), np.float32)
    x[0] = np.arcsinh((disparity - table) / _HEIGHT_UNIT) / 3
    x[1] = np.clip(disparity - cv2.GaussianBlur(disparity, (0, 0), _SURROUNDINGS), -16, 16) / 4
    x[2:5] = _normals(disparity, camera, up)
    x[5] = frame.valid
    lab = cv2.cvtColor(frame.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2Lab).transpose(2, 0, 1)
    x[6:] = (lab - np.array([50, 0, 0], np.float32)[:, None, None]) / 50
    return x


def _normals(disparity: np.ndarray, camera: Camera, up: np.ndarray) -> np.ndarray:
    """Normals (3, H, W) of a smoothed disparity image, along the image rows, `up` and a third axis."""
    smooth = cv2.GaussianBlur(disparity, (0, 0), 1.5)
    a = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) / 8
    b = cv2.Sobel(smooth, cv2.CV_32F, 0, 1) / 8
    rows, columns = np.indices(disparity.shape, dtype=np.float32)
    # The plane with disparity a u + b v + c has the normal K^T (a, b, c) in the camera's axes, away from the camera.
    plane = np.stack([a, b, smooth - a * columns - b * rows])
    normal = -np.tensordot(camera.K.T.astype(np.float32), plane, axes=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1e-9)
    right = np.array([1.0, 0.0, 0.0]) - up[0] * up
    right /= max(float(np.linalg.norm(right)), 1e-9)
    axes = np.stack([right, up, np.cross(right, up)]).astype(np.float32)
    return np.asarray(np.tensordot(axes, normal, axes=1))


def near_objects(x: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool of a network input that are within eight pixels of a reading above the table."""
    raised = (x[0] > np.arcsinh(TABLE_TOLERANCE / _HEIGHT_UNIT) / 3) & (x[5] > 0)
    raised = cv2.morphologyEx(raised.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    return np.asarray(cv2.dilate(raised, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (17, 17))) > 0)


class _Block(nn.Module):
    """Residual block with two convolutions."""

    def __init__(self, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, width), nn.GroupNorm(8, width)
        self.conv1 = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        y = self.conv1(functional.silu(self.norm1(x)))
        return x + self.conv2(functional.silu(self.norm2(y)))


class BorderNet(nn.Module):
    """U-Net of three levels with `width` (a multiple of 8), 2 `width` and 4 `width` features."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.stem = nn.Conv2d(4 * len(IMAGE_CHANNELS), width, 3, padding=1)
        self.fine = _Block(width)
        self.down1 = nn.Conv2d(width, 2 * width, 2, stride=2)
        self.middle = _Block(2 * width)
        self.down2 = nn.Conv2d(2 * width, 4 * width, 2, stride=2)
        self.coarse = nn.Sequential(_Block(4 * width), _Block(4 * width, 2))
        self.up1 = nn.Conv2d(4 * width, 2 * width, 1)
        self.join1 = nn.Conv2d(4 * width, 2 * width, 1)
        self.rise = _Block(2 * width)
        self.up2 = nn.Conv2d(2 * width, width, 1)
        self.join2 = nn.Conv2d(2 * width, width, 1)
        self.end = _Block(width)
        self.head = nn.Conv2d(width, 16, 1)
        nn.init.zeros_(self.head.weight)
        # Start at the usual share of border and foreground pixels near objects.
        self.head.bias = nn.Parameter(torch.tensor([-2.0, -1.0, 0.0, 0.0]).repeat_interleave(4))

    def forward(self, x: Tensor) -> Tensor:
        """(b, 9, H, W) -> (b, 4, H, W): logits of border and foreground, and offset in `CENTRE_UNIT` (right, down).

        H and W are multiples of 8.
        """
        fine = self.fine(self.stem(functional.pixel_unshuffle(x, 2)))
        middle = self.middle(self.down1(fine))
        y = self.coarse(self.down2(middle))
        y = functional.interpolate(self.up1(y), scale_factor=2)
        y = self.rise(self.join1(torch.cat([y, middle], dim=1)))
        y = functional.interpolate(self.up2(y), scale_factor=2)
        y = self.end(self.join2(torch.cat([y, fine], dim=1)))
        return functional.pixel_shuffle(self.head(functional.silu(y)).float(), 2)


@dataclass(frozen=True, eq=False)
class PairNetwork:
    """A small network whose output is added to the linear log odds that two regions are different objects.

    The network is a multilayer perceptron with rectified linear units. The features are standardised and limited to 4
    standard deviations, so the correction stays bounded for features that the fit has not seen.
    """

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
        return np.clip((features - self.mean) / self.scale, -_MOST_DEVIATION, _MOST_DEVIATION)

    @classmethod
    def of(cls, model: TrainedModel, n_features: int) -> Self | None:
        """The network in a model for `n_features` features, or None. Raises InputError for unfit tensors."""
        own = model.split(PAIR_TENSORS)[1]
        if not own.tensors:
            return None
        n = sum(name.startswith(f"{PAIR_TENSORS}weight") for name in own.tensors)
        sizes = [n_features, *(np.size(own.tensors.get(f"{PAIR_TENSORS}bias{k}", ())) for k in range(n - 1)), 1]
        empty = [np.empty(shape) for shape in pairwise(sizes)]
        row = np.empty(n_features)
        expected = cls(row, row, tuple(empty), tuple(np.empty(s) for s in sizes[1:]))
        own.check_tensors({name: t.shape for name, t in expected.tensors().items()})
        found = {name.removeprefix(PAIR_TENSORS): t.astype(np.float64) for name, t in own.tensors.items()}
        weights, biases = (tuple(found[f"{part}{k}"] for k in range(n)) for part in ("weight", "bias"))
        return cls(found["mean"], found["scale"], weights, biases)

    def tensors(self) -> dict[str, np.ndarray]:
        """The arrays of the network by name, as `of` expects them."""
        layers = {f"weight{k}": w for k, w in enumerate(self.weights)} | {
            f"bias{k}": b for k, b in enumerate(self.biases)
        }
        return {PAIR_TENSORS + name: t for name, t in {"mean": self.mean, "scale": self.scale, **layers}.items()}


class BorderNetwork:
    """A border network with loaded weights."""

    def __init__(self, model: TrainedModel) -> None:
        self.net, self.scale, self.shift = calibrated_network(
            model.split(PAIR_TENSORS)[0], IMAGE_CHANNELS, lambda values: BorderNet(layer_size(values, "width"))
        )
        evidence = model.description.get("evidence", {})
        #: Weights of the features of the tree `border`; empty if they were not fitted.
        self.evidence = dict(zip(evidence.get("features", ()), evidence.get("weights", ()), strict=True))
        self.correction = PairNetwork.of(model, len(self.evidence))  #: of the log odds of the tree `border`, or None
        self.key = model.key

    def look(self, frame: Frame) -> SeenBorders:
        """The output maps for a frame of any size. A missing pose is computed from the support plane."""
        h, w = frame.depth.shape
        small = reduced(frame)
        x = encode_image(small)
        missing = [-n % _MULTIPLE for n in x.shape[1:]]
        with torch.inference_mode(), one_thread():
            padded = functional.pad(torch.from_numpy(x)[None], (0, missing[1], 0, missing[0]))
            y = self.net(padded)[0, :, : x.shape[1], : x.shape[2]].permute(1, 2, 0).contiguous().numpy()
        y = cv2.resize(y, (w, h), interpolation=cv2.INTER_LINEAR)
        rows, columns = np.indices((h, w), dtype=np.float32)
        at = np.stack([columns, rows], axis=-1)
        unit = CENTRE_UNIT * w / small.depth.shape[1]
        return SeenBorders(self.scale * y[..., 0] + self.shift, y[..., 1], at + unit * y[..., 2:])


def reduced(frame: Frame) -> Frame:
    """The frame with `RASTER` pixels per row and a camera pose, reduced as in the training of the network."""
    camera = posed_camera(frame)
    return frame.resized(camera if camera.width == RASTER else camera.scaled(RASTER / camera.width), centred=False)


@load_once
def load_border_network(name: str) -> BorderNetwork:
    """Load the network of a trained model, given by name or folder. See `mstfilter.base.trained.open_model`."""
    return BorderNetwork(open_model(name, BORDER_ARCHITECTURE))
