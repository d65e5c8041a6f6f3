"""SiamMask, a tracker of masks for the motion rules.

>>> overrides = "transition.tracker=siammask", "transition.tracker.weights=SiamMask_DAVIS.pth"
>>> filter = mstfilter.preset("paper", *overrides)

SiamMask: Wang, Zhang, Bertinetto, Hu, Torr: Fast Online Object Tracking and Segmentation, CVPR 2019. Its authors
distribute code and checkpoints at https://github.com/foolwood/SiamMask (MIT). The code here was checked with random
weights. It was never run with the published ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import naming
from mstfilter.base.fields import NonNegativeFloat, PositiveInt, Share
from mstfilter.base.trained import weights_file
from mstfilter.base.user_files import load_file
from mstfilter.mst.tracking import MaskTracker
from mstfilter.scene import Clip, Frame, Recording, UsesFiles, component_key, content_key, memo

_TEMPLATE, _SEARCH = 127, 255  # pixels of the crops
_STRIDE, _BASE, _POSITIONS = 8, 8, 25
_CONTEXT = 0.5  # context around a box, in half its circumference
_RATIOS = (0.33, 0.5, 1, 2, 3)
_SMALLEST = 10  # pixels of a side of a box
_MAX_LOG = 10.0  # log of the ratio of a box to its anchor; only untrained networks exceed it


def thinned(clip: Clip, step: int) -> list[Frame]:
    """Every `step`-th frame of a clip, and the last frame."""
    return [*list(clip.frames)[: len(clip.frames) - 1 : step], clip.after]


@dataclass(frozen=True)
class SiamMaskTracker(MaskTracker, UsesFiles):
    """SiamMask with refinement. Each mask starts a tracker of its own; equal masks are tracked once.

    Parameters
    ----------
    weights : str
        Path of a checkpoint, for example SiamMask_DAVIS.pth.
    threshold : float
        Smallest probability of a pixel of the mask.
    penalty, window, rate : float
        Penalty of a change of size, weight of the cosine window, and rate of change of the size. The defaults of
        `threshold` and of these are those of the configuration for DAVIS; for VOT they are 0.3, 0.04, 0.42 and 0.25.
    step : int
        Every `step`-th frame is used, and the last one; 3 in the authors' program of MST.
    """

    weights: str = ""
    threshold: Share = 0.4
    penalty: NonNegativeFloat = 0.04
    window: Share = 0.4
    rate: Share = 1.0
    step: PositiveInt = 1

    def check_files(self, recording: Recording) -> None:
        """Load the weights."""
        self._network()

    def track(self, clip: Clip, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Masks (H, W) bool of the last frame. Raises InputError if the weights are missing or of another network."""
        network, digest = self._network()
        frames = thinned(clip, self.step)
        images = [np.ascontiguousarray(frame.rgb[..., ::-1]) for frame in frames]  # BGR, as it was trained
        clip_key = content_key("frames", *(frame.key for frame in frames))
        return [
            memo(
                "siammask",
                (clip_key, digest, component_key(self), np.packbits(mask).tobytes()),
                partial(follow, self, network, images, mask),
            )
            for mask in masks
        ]

    def _network(self) -> tuple[Any, str]:
        where = "https://github.com/foolwood/SiamMask"
        path, digest = weights_file(self.weights, "SiamMask", where)
        return _load(path, digest), digest


@lru_cache(maxsize=1)
def _load(path: str, digest: str) -> Any:
    """The network with the weights of a file; the last one is kept."""
    source = load_file(Path(__file__).with_name("siammask_network.py"))
    network = source.SiamMaskNetwork()
    with naming(path):
        network.load_state(source.read_checkpoint(Path(path)))
    return network


def follow(rule: SiamMaskTracker, network: Any, images: Sequence[np.ndarray], mask: np.ndarray) -> np.ndarray:
    """The mask (H, W) bool in the last of several BGR images of an object with a mask (H, W) in the first."""
    import torch

    if not mask.any() or len(images) == 1:
        return mask.astype(bool)
    rows, columns = np.nonzero(mask)
    size = np.array([np.ptp(columns) + 1, np.ptp(rows) + 1], dtype=np.float64)
    position = np.array([columns.min(), rows.min()]) + size / 2
    colour = images[0].mean(axis=(0, 1))
    limits = np.array(mask.shape[::-1], dtype=np.float64)
    found = mask.astype(np.float64)

    def tensor(crop: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(crop.transpose(2, 0, 1), dtype=np.float32))[None]

    with torch.inference_mode():
        side = round(float(_context_side(*size)))
        template = network.template(tensor(crop_around(images[0], position, side, _TEMPLATE, colour)))
        for image in images[1:]:
            scale = _TEMPLATE / float(_context_side(*size))
            side = round(_SEARCH / scale)
            score, offsets, features = network.search(
                template, tensor(crop_around(image, position, side, _SEARCH, colour))
            )
            k, boxes, value = _best(rule, score.softmax(dim=0)[1].numpy(), offsets.numpy(), size * scale)
            row, column = divmod(k % _POSITIONS**2, _POSITIONS)
            found = _paste(network.refine(features, row, column).numpy(), position, side, row, column, limits)
            box = boxes[:, k] / scale
            rate = value * rule.rate
            position = np.clip(position + box[:2], 0, limits)
            size = np.clip(size * (1 - rate) + box[2:] * rate, _SMALLEST, limits)
    return found > rule.threshold


def _context_side(width: np.ndarray | float, height: np.ndarray | float) -> np.ndarray:
    """Side of the square around a box and its context."""
    context = _CONTEXT * (width + height)
    return np.sqrt((width + context) * (height + context))


def crop_around(image: np.ndarray, position: np.ndarray, side: int, size: int, colour: np.ndarray) -> np.ndarray:
    """The square of `side` pixels around a position (x, y), resized to `size` pixels; `colour` outside the image."""
    import cv2

    low = np.round(position - (side + 1) / 2).astype(int)
    high = low + side
    inner = np.clip(low, 0, None), np.minimum(high, image.shape[1::-1])
    out = np.empty((side, side, 3), np.uint8)
    out[:] = colour.astype(np.uint8)
    if (inner[1] > inner[0]).all():
        (x0, y0), (x1, y1) = inner[0] - low, inner[1] - low
        out[y0:y1, x0:x1] = image[inner[0][1] : inner[1][1], inner[0][0] : inner[1][0]]
    return cv2.resize(out, (size, size)) if side != size else out


@lru_cache(maxsize=1)
def anchor_boxes() -> np.ndarray:
    """Anchors (4, 5 * 25 * 25): centre x, y relative to the middle of the crop, width, height."""
    area = _STRIDE * _STRIDE
    widths = [int(np.sqrt(area / ratio)) for ratio in _RATIOS]
    sizes = np.array([(w, int(w * ratio)) for w, ratio in zip(widths, _RATIOS, strict=True)]) * 8.0
    at = (np.arange(_POSITIONS) - _POSITIONS // 2) * float(_STRIDE)
    shape = (len(_RATIOS), _POSITIONS, _POSITIONS)
    x, y = np.broadcast_to(at, shape), np.broadcast_to(at[:, None], shape)
    w, h = (np.broadcast_to(sizes[:, k, None, None], shape) for k in (0, 1))
    return np.stack([x, y, w, h]).reshape(4, -1)


def _best(
    rule: SiamMaskTracker, score: np.ndarray, offsets: np.ndarray, size: np.ndarray
) -> tuple[int, np.ndarray, float]:
    """The best anchor, all boxes (4, n) in the crop, and the penalised score of the best one.

    `score` (5, 25, 25) is P(object), `offsets` (4, 5, 25, 25) the boxes relative to the anchors, `size` (2,) the
    size of the object in the crop.
    """
    anchors, offsets = anchor_boxes(), offsets.reshape(4, -1).astype(np.float64)
    sizes = np.exp(np.clip(offsets[2:], -_MAX_LOG, _MAX_LOG)) * anchors[2:]
    boxes = np.concatenate([offsets[:2] * anchors[2:] + anchors[:2], sizes])

    def change(ratio: np.ndarray) -> np.ndarray:
        return np.maximum(ratio, 1 / ratio)

    scale = change(_context_side(boxes[2], boxes[3]) / _context_side(*size))
    shape = change((size[0] / size[1]) / (boxes[2] / boxes[3]))
    penalised = np.exp(-(scale * shape - 1) * rule.penalty) * score.ravel()
    hanning = np.outer(np.hanning(_POSITIONS), np.hanning(_POSITIONS)).ravel()
    k = int(np.argmax(penalised * (1 - rule.window) + np.tile(hanning, len(_RATIOS)) * rule.window))
    return k, boxes, float(penalised[k])


def _paste(
    mask: np.ndarray, position: np.ndarray, side: int, row: int, column: int, limits: np.ndarray
) -> np.ndarray:
    """A mask (127, 127) of a position of the search region, in the image; -1 outside of it."""
    import cv2

    scale = side / _SEARCH
    corner = position - side / 2 + (np.array([column, row]) - _BASE / 2) * _STRIDE * scale
    # The original program maps the image to 127 x 127 pixels of the box, with corners of the image on pixel centres.
    width, height = limits
    box = scale * _TEMPLATE
    a, b = (width - 1) / (width * len(mask) / box), (height - 1) / (height * len(mask) / box)
    mapping = np.array([[a, 0, a * corner[0] * len(mask) / box], [0, b, b * corner[1] * len(mask) / box]])
    return cv2.warpAffine(
        mask.astype(np.float32),
        mapping,
        (int(width), int(height)),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=-1,
    )
