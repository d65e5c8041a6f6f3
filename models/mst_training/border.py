"""Training of the border network.

>>> run_training(BorderTraining.recipe("cpu"), "border-model")

The loss is the log loss of border and foreground, and the Huber loss of the offset to the centre on objects. Pixels
far from everything above the table count a tenth. This weight depends on the input only, and borders count no more
than other pixels, so the loss stays proper. Images are mirrored; their colours are changed at random, or taken away.
At the end, scale and shift of the border's logits are fitted to the validation samples, over pixels near objects.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mst_training.border_data import BorderSamples, targets
from mst_training.loop import Training, fit_calibration
from mst_training.scenes import Samples
from mstfilter.mst.segmentation.border_network import (
    BORDER_ARCHITECTURE,
    CENTRE_UNIT,
    IMAGE_CHANNELS,
    BorderNet,
    encode_image,
    near_objects,
)
from mstfilter.mst.segmentation.boundary import ColourDepthBoundary
from mstfilter.scoring.forecasts import ForecastTable

_FAR = 0.1  # weight of pixels far from everything above the table
_COLOUR = IMAGE_CHANNELS.index("lightness")


@dataclass(frozen=True)
class BorderTraining(Training):
    """Settings of the training of the border network. A scene gives six samples."""

    n_scenes: int = 900
    n_validation: int = 20
    n_test: int = 40
    width: int = 24
    steps: int = 20_000
    batch: int = 4
    colour_dropout: float = 0.3  #: share of the images whose colours are taken away
    centre_weight: float = 0.2  #: of the offset in the loss

    recipes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "cpu": {},
        "gpu": {"n_scenes": 6000, "steps": 150_000, "batch": 16},
        "smoke": {
            **{"n_scenes": 3, "n_validation": 1, "n_test": 2},
            **{"width": 8, "steps": 120, "rate": 4e-3, "average": 0.97},
        },
    }
    architecture: ClassVar[str] = BORDER_ARCHITECTURE
    samples: ClassVar[type[Samples]] = BorderSamples
    losses: ClassVar[tuple[str, ...]] = ("loss_border", "loss_foreground", "loss_centre")

    def networks(self) -> dict[str, nn.Module]:
        return {"net": BorderNet(self.width)}

    def batches(self, samples: BorderSamples, first: int, last: int) -> Iterator[tuple[Tensor, ...]]:
        """Inputs, weights, and the targets: border and foreground, offset."""
        for step, chosen in self.order(len(samples), first, last):
            rng = np.random.default_rng([self.seed, 2, step])
            rows = []
            for k in chosen.tolist():
                row = encoded(samples, k)
                _recolour(rng, row[0][_COLOUR:], self.colour_dropout)
                rows.append(_mirrored(row) if rng.uniform() < 0.5 else row)
            yield tuple(torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True))

    def loss(
        self, networks: Mapping[str, Any], step: int, batch: Sequence[Tensor]
    ) -> tuple[Tensor, tuple[float, ...]]:
        """Log loss a pixel of border and foreground, Huber loss of the offset in `CENTRE_UNIT`."""
        x, near, truth, offset = batch
        with torch.autocast(x.device.type, dtype=torch.bfloat16, enabled=self.half_precision):
            y = networks["net"](x)
        weight = _FAR + (1 - _FAR) * near
        every = functional.binary_cross_entropy_with_logits(y[:, :2], truth, reduction="none")
        border, foreground = (every * weight[:, None]).sum(dim=(0, 2, 3)) / weight.sum()
        apart = functional.huber_loss(y[:, 2:], offset, reduction="none").sum(dim=1)
        centre = (apart * truth[:, 1]).sum() / truth[:, 1].sum().clamp(min=1)
        total = border + foreground + self.centre_weight * centre
        return total, tuple(float(part.detach()) for part in (border, foreground, centre))

    def validate(self, net: BorderNet, samples: BorderSamples, device: torch.device) -> dict[str, float]:
        tally = Tally()
        for k in range(min(len(samples), 60)):
            tally.add(*_judged(net, encoded(samples, k), device))
        return tally.figures((1.0, 0.0))

    def finish(
        self, net: BorderNet, validation: BorderSamples, test: BorderSamples, device: torch.device
    ) -> tuple[dict[str, Any], dict[str, float], list[dict[str, Any]]]:
        calibration, rule_calibration = _calibrated(net, validation, device)
        tallies = {"network": Tally(), "network without colour": Tally(), "colour and depth edges": Tally()}
        for k in range(len(test)):
            row = encoded(test, k)
            tallies["network"].add(*_judged(net, row, device))
            tallies["colour and depth edges"].add(_rule_logits(test, k)[row[1]], row[2][0][row[1]] > 0)
            row[0][_COLOUR:] = 0
            tallies["network without colour"].add(*_judged(net, row, device))
        rows: list[dict[str, Any]] = [
            {"boundary": name, **tally.figures(rule_calibration if "edges" in name else calibration)}
            for name, tally in tallies.items()
        ]
        figures = dict(list(rows[0].items())[1:])
        figures |= {f"{name}_edges": rows[2][name] for name in ("log_loss", "f")}
        described = {
            "network": {"channels": list(IMAGE_CHANNELS), "width": self.width},
            "calibration": {"scale": calibration[0], "shift": calibration[1]},
        }
        return described, figures, rows


def encoded(samples: BorderSamples, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Input (9, H, W), pixels near objects (H, W) bool, border and foreground (2, H, W) float32, offset (2, H, W)."""
    x = encode_image(samples.frame(k))
    border, foreground, offset = targets(samples.instance[k], samples.centre[k])
    return x, near_objects(x), np.stack([border, foreground]).astype(np.float32), offset


def _recolour(rng: np.random.Generator, lab: np.ndarray, dropout: float) -> None:
    """Change a Lab image (3, H, W) in place: contrast and lightness, a turn of the hues, or no colour."""
    if rng.uniform() < dropout:
        lab[:] = 0
        return
    lab[0] = lab[0] * rng.uniform(0.6, 1.3) + rng.normal(0.0, 0.15)
    angle, strength = rng.uniform(0, 2 * np.pi), rng.uniform(0.0, 1.4)
    turn = strength * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]], np.float32)
    lab[1:] = np.tensordot(turn, lab[1:], axes=1)


def _mirrored(row: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """The image with left and right exchanged."""
    x, near, truth, offset = (np.ascontiguousarray(values[..., ::-1]) for values in row)
    x[IMAGE_CHANNELS.index("right")] *= -1
    offset[0] *= -1
    return x, near, truth, offset


def _judged(net: BorderNet, row: tuple[np.ndarray, ...], device: torch.device) -> tuple[np.ndarray, ...]:
    """Border logits and truth (n,) of the pixels near objects, foreground logits and truth, errors of the centre."""
    x, near, truth, offset = row
    with torch.inference_mode():
        y = net(torch.from_numpy(x)[None].to(device))[0].float().cpu().numpy()
    inside = truth[1] > 0
    apart = CENTRE_UNIT * np.linalg.norm((y[2:] - offset)[:, inside], axis=0)
    return y[0][near], truth[0][near] > 0, y[1][near], truth[1][near] > 0, apart


def _rule_logits(samples: BorderSamples, k: int) -> np.ndarray:
    """The boundary (H, W) of colour and depth edges as logits, before calibration."""
    strength = np.clip(ColourDepthBoundary().boundary(samples.frame(k)).astype(np.float64), 1e-3, 1 - 1e-3)
    return np.asarray(np.log(strength / (1 - strength)))


def _calibrated(
    net: BorderNet, samples: BorderSamples, device: torch.device
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Scale and shift of the logits of the network and of `ColourDepthBoundary`."""
    logits, rules, outcomes = [], [], []
    for k in range(min(len(samples), 120)):
        row = encoded(samples, k)
        found = _judged(net, row, device)
        logits.append(torch.from_numpy(found[0]))
        outcomes.append(torch.from_numpy(found[1]))
        rules.append(torch.from_numpy(_rule_logits(samples, k)[row[1]]))
    truth = torch.cat(outcomes)
    return fit_calibration(torch.cat(logits), truth), fit_calibration(torch.cat(rules), truth)


class Tally:
    """Outcomes of many pixels by logit, and errors of the centres."""

    _EDGES: ClassVar[np.ndarray] = np.linspace(-12, 12, 961)

    def __init__(self) -> None:
        self.counts = np.zeros((2, len(self._EDGES) + 1))
        self.overlap = np.zeros(2)
        self.apart: list[np.ndarray] = []

    def add(
        self,
        logits: np.ndarray,
        truth: np.ndarray,
        foreground: np.ndarray | None = None,
        inside: np.ndarray | None = None,
        apart: np.ndarray | None = None,
    ) -> None:
        """Border logits (n,) with their truth, foreground logits (n,) with theirs, errors (m,) of the centre."""
        index = np.digitize(logits, self._EDGES)
        for k in (0, 1):
            self.counts[k] += np.bincount(index[truth == bool(k)], minlength=self.counts.shape[1])
        if foreground is not None and inside is not None and apart is not None:
            found = foreground > 0
            self.overlap += (found & inside).sum(), (found | inside).sum()
            self.apart.append(apart.astype(np.float32))

    def figures(self, calibration: tuple[float, float]) -> dict[str, float]:
        """Log loss, largest F over thresholds and calibration error of the border; foreground and centre if known."""
        step = self._EDGES[1] - self._EDGES[0]
        logit = np.append(self._EDGES - step / 2, self._EDGES[-1] + step / 2)
        no, yes = self.counts
        table = ForecastTable(1 / (1 + np.exp(-calibration[0] * logit - calibration[1])), no, yes)
        above_no, above_yes = (np.cumsum(part[::-1])[::-1] for part in (no, yes))
        f = 2 * above_yes / np.maximum(above_no + above_yes + yes.sum(), 1)
        result = {
            "log_loss": table.log_loss(),
            "f": float(f.max()),
            "calibration_error": table.reliability(20).error,
        }
        if self.apart:
            result["foreground_iou"] = float(self.overlap[0] / max(self.overlap[1], 1))
            result["centre_px"] = float(np.median(np.concatenate(self.apart)))
        return result
