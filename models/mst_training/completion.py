"""Training of the completion network.

>>> run_training(CompletionTraining.recipe("cpu"), "completion-model")

The loss is the log loss of the voxels that are not observed as free. The log loss of a sample is divided by the
number of voxels on or behind the visible surface, so that small objects count as much as large ones. The divisor
depends on the input only, so the loss stays proper. At the end, scale and shift of the logits are fitted to the
validation samples, over the voxels that are not free.

Some batches have crops of 48 or 64 voxels, so that the network knows them too. With ``objects=FOLDER``, half of the
objects are meshes of the folder's training pool (`mstfilter.lab.simulation.objects`). Those of the validation are of
the tuning pool; the test has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mst_training.completion_data import MASK_KINDS, CompletionSamples, LargeSamples
from mst_training.loop import Training, fit_calibration
from mst_training.scenes import Samples
from mst_training.shapes import HELD_OUT
from mstfilter.mst.completion.crops import CHANNELS, EDGE, LARGER, LATTICE, PRIOR, channels, extruded
from mstfilter.mst.completion.unet import ARCHITECTURE, CompletionNet
from mstfilter.scene import Seen
from mstfilter.scoring.forecasts import ForecastTable

_OWN = Seen.SURFACE | Seen.BEHIND  # on or behind the visible surface of the object


@dataclass(frozen=True)
class CompletionTraining(Training):
    """Settings of the training of the completion network. A scene gives about 35 samples."""

    n_globals: int = 16  #: number of global features
    prior: bool = False  #: the mean of `Posterior` is a channel
    n_large: int = 200  #: further scenes for training, with larger objects
    stretch: float = 0.3  #: crops are stretched by up to exp(stretch), in height by up to another exp(stretch / 2)
    large: float = 0.2  #: share of the batches with crops of larger objects; they have as many voxels as others

    recipes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "cpu": {},
        "gpu": {"n_scenes": 9000, "width": 32, "steps": 200_000, "batch": 64},
        "smoke": {
            **{"n_scenes": 6, "n_validation": 2, "n_test": 3, "n_large": 2},
            **{"width": 8, "n_globals": 4, "steps": 150, "average": 0.97},
        },
    }
    architecture: ClassVar[str] = ARCHITECTURE
    samples: ClassVar[type[Samples]] = CompletionSamples
    losses: ClassVar[tuple[str, ...]] = ("loss",)

    def networks(self) -> dict[str, nn.Module]:
        return {"net": CompletionNet(len(self.channels), self.width, self.n_globals)}

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels of the input."""
        return (*CHANNELS, PRIOR) if self.prior else CHANNELS

    def first_weights(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The weights of the network `start`; a channel that it lacks starts with weights 0."""
        stem, n = tensors["stem.weight"], 8 * len(self.channels)
        more = stem.new_zeros(len(stem), max(n - stem.shape[1], 0), *stem.shape[2:])
        return {**tensors, "stem.weight": torch.cat([stem, more], dim=1)}

    def make_samples(self, folder: Path, workers: int) -> dict[str, list[Path]]:
        files = super().make_samples(folder, workers)
        clutter = replace(self.clutter("train"), sizes=LargeSamples.clutter.sizes)
        files["large"] = LargeSamples.write(folder / "large", self.seed, self.n_large, workers, clutter)
        return files

    def read_training(self, files: Mapping[str, Sequence[Path]]) -> tuple[CompletionSamples, LargeSamples | None]:
        return CompletionSamples.read(files["train"]), LargeSamples.read(files["large"]) if files["large"] else None

    def batches(
        self, samples: tuple[CompletionSamples, LargeSamples | None], first: int, last: int
    ) -> Iterator[tuple[Tensor, ...]]:
        """Batches in which each sample is turned and mirrored. All samples of a batch have crops of one size."""
        usual, larger = samples
        sizes = _extents(larger.bits) if larger is not None else np.zeros(0, np.int64)
        for step, chosen in self.order(len(usual), first, last):
            rng = np.random.default_rng([self.seed, 2, step])
            of, edge = usual, EDGE
            if larger is not None and rng.uniform() < self.large:
                size = int(rng.choice(LARGER))
                if (fits := np.flatnonzero(sizes <= size)).size:
                    n = max(self.batch * EDGE**3 // size**3, 1)
                    of, edge, chosen = larger, size, rng.choice(fits, n)
            cut = (slice(edge),) * 3
            rows = []
            for i in chosen:
                symmetry = int(rng.integers(8))
                crops = [values[i][cut] for values in (of.bits, of.signed, of.prior, of.truth)]
                rows.append([_turned(one, symmetry) for one in _stretched(rng, crops, self.stretch)])
            yield tuple(torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True))

    def loss(
        self, networks: Mapping[str, Any], step: int, batch: Sequence[Tensor]
    ) -> tuple[Tensor, tuple[float, ...]]:
        """Log loss a voxel on or behind the surface."""
        bits, signed, prior, truth = batch
        x = _input(bits, signed, prior if self.prior else None).to(bits.device)
        with torch.autocast(x.device.type, dtype=torch.bfloat16, enabled=self.half_precision):
            logits = networks["net"](x)
        unknown, own = ~Seen.FREE.among(bits), _OWN.among(bits).sum(dim=(1, 2, 3))
        loss = functional.binary_cross_entropy_with_logits(logits.float(), truth.float(), reduction="none")
        total = ((loss * unknown).sum(dim=(1, 2, 3)) / (own + 50)).mean()
        return total, (float(total.detach()),)

    def validate(self, net: CompletionNet, samples: CompletionSamples, device: torch.device) -> dict[str, float]:
        return evaluate(net, samples.take(np.arange(min(len(samples), 400))), device)

    def finish(
        self, net: CompletionNet, validation: CompletionSamples, test: CompletionSamples, device: torch.device
    ) -> tuple[dict[str, Any], dict[str, float], list[dict[str, Any]]]:
        logits, outcomes = [], []
        for part, found in _logits(net, validation, device):
            unknown = torch.from_numpy(~Seen.FREE.among(validation.bits[part]))
            logits.append(found[unknown])
            outcomes.append(torch.from_numpy(validation.truth[part])[unknown])
        calibration = fit_calibration(torch.cat(logits), torch.cat(outcomes))
        figures, rows = measure(net, calibration, test, device)
        described = {
            "lattice_m": LATTICE,
            "network": {"channels": list(self.channels), "width": self.width, "n_globals": self.n_globals},
            "calibration": {"scale": calibration[0], "shift": calibration[1]},
        }
        return described, figures, rows


def _input(bits: Tensor, signed: Tensor, prior: Tensor | None) -> Tensor:
    heights = (torch.arange(bits.shape[-1]) + 0.5) * LATTICE
    x: Tensor = channels(bits, signed, heights, None if prior is None else prior.float() / 255)
    return x


def _extents(bits: np.ndarray) -> np.ndarray:
    """The largest extent (n,) of the used part of crops (n, e, e, e) that are padded with zeros."""
    used = [np.any(bits, axis=tuple(a for a in (1, 2, 3) if a != axis)) for axis in (1, 2, 3)]
    last = [np.argmax(np.flip(one, axis=1), axis=1) for one in used]
    return np.asarray(bits.shape[-1] - np.min(last, axis=0))


def _stretched(rng: np.random.Generator, crops: Sequence[np.ndarray], stretch: float) -> list[np.ndarray]:
    """Flags, distances, prior and truth (e, e, e) of another shape: stretched about the middle, and upwards.

    A linear map keeps rays straight, so the stretched view is what another camera sees of the stretched scene.
    """
    across = np.exp(rng.uniform(-stretch, stretch))
    up = across * np.exp(rng.uniform(-stretch, stretch) / 2)
    edge = len(crops[0])
    place = np.arange(edge) + 0.5
    level = np.clip((place - edge / 2) / across + edge / 2, 0, edge - 1).astype(int)
    index = np.ix_(level, level, np.clip(place / up, 0, edge - 1).astype(int))
    bits, signed, *others = (values[index] for values in crops)
    return [bits, np.clip(np.rint(signed * across), -127, 127).astype(np.int8), *others]


def _turned(values: np.ndarray, symmetry: int) -> np.ndarray:
    """One of the eight symmetries about the vertical axis."""
    turned = np.rot90(values, symmetry % 4)
    return turned[::-1] if symmetry >= 4 else turned


def _logits(net: CompletionNet, samples: CompletionSamples, device: torch.device) -> Iterator[tuple[slice, Tensor]]:
    """Logits of batches of samples."""
    with torch.inference_mode():
        for start in range(0, len(samples), 32):
            part = slice(start, min(start + 32, len(samples)))
            columns = (torch.from_numpy(v[part]) for v in (samples.bits, samples.signed, samples.prior))
            bits, signed, prior = columns
            yield part, net(_input(bits, signed, prior if net.has_prior else None).to(device)).cpu()


def evaluate(net: CompletionNet, samples: CompletionSamples, device: torch.device) -> dict[str, float]:
    """Mean IoU of the mode, and its log loss over voxels that are not free, before calibration."""
    iou, loss, n = [], 0.0, 0
    for part, logits in _logits(net, samples, device):
        truth, unknown = (torch.from_numpy(v) for v in (samples.truth[part], ~Seen.FREE.among(samples.bits[part])))
        iou.append(shape_iou(((logits > 0) & unknown).numpy(), truth.numpy()))
        every = functional.binary_cross_entropy_with_logits(logits, truth.float(), reduction="none")
        loss, n = loss + float((every * unknown).sum()), n + int(unknown.sum())
    return {"iou": float(np.concatenate(iou).mean()), "log_loss": loss / max(n, 1)}


def measure(
    net: CompletionNet, calibration: tuple[float, float], samples: CompletionSamples, device: torch.device
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Figures of the mode on test samples; a table of IoU and of volume over true volume by group, beside extrusion.

    The calibration error and the log loss, in nats a voxel, are of the probabilities.
    """
    scale, shift = calibration
    unknown, truth = ~Seen.FREE.among(samples.bits), samples.truth
    p = np.zeros(truth.shape, np.float32)
    for part, logits in _logits(net, samples, device):
        p[part] = torch.sigmoid(scale * logits + shift).numpy() * unknown[part]
    found = {"network": p >= 0.5, "extrude": extruded(samples.bits)}
    iou = {name: shape_iou(shape, truth) for name, shape in found.items()}
    true_volume = np.maximum(truth.sum(axis=(1, 2, 3)), 1)
    volume = {name: shape.sum(axis=(1, 2, 3)) / true_volume for name, shape in found.items()}
    rows = [
        {
            "group": name,
            "n": int(of.sum()),
            **{of_what: float(values[of].mean()) for of_what, values in iou.items()},
            **{f"volume {of_what}": float(np.median(values[of])) for of_what, values in volume.items()},
        }
        for name, of in _groups(samples).items()
        if of.any()
    ]
    question = unknown & (_OWN.among(samples.bits) | (p > 0.02))
    figures = {
        "iou": float(iou["network"].mean()),
        "iou_extrude": float(iou["extrude"].mean()),
        "log_loss": float(shape_log_loss(p, truth, question).mean()),
        "calibration_error": ForecastTable.of(np.round(p[question], 3), truth[question]).reliability(20).error,
    }
    return figures, rows


def _groups(samples: CompletionSamples) -> dict[str, np.ndarray]:
    """Samples (n,) bool by kind of mask, visible share of the object's silhouette, and kind of shape."""
    groups = {"all": np.ones(len(samples), bool)}
    groups |= {f"mask: {name}": samples.mask == k for k, name in enumerate(MASK_KINDS)}
    for low, high in ((0.9, 1.01), (0.5, 0.9), (0.0, 0.5)):
        name = f"visible {int(100 * low)} - {int(min(100 * high, 100))} %"
        groups[name] = (samples.visible >= low) & (samples.visible < high)
    groups |= {f"shape: {name}": samples.kind == name for name in sorted(set(samples.kind.tolist()))}
    groups["shapes not trained on"] = np.isin(samples.kind, HELD_OUT)
    return groups


def shape_iou(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """IoU (n,) of shapes (n, X, Y, Z) bool."""
    axes = (1, 2, 3)
    return np.asarray((found & truth).sum(axis=axes) / np.maximum((found | truth).sum(axis=axes), 1))


def shape_log_loss(p: np.ndarray, truth: np.ndarray, question: np.ndarray) -> np.ndarray:
    """Mean log loss (n,) in nats of the voxels in question."""
    p = np.clip(p, 1e-6, 1 - 1e-6)
    loss = -np.log(np.where(truth, p, 1 - p))
    return np.asarray((loss * question).sum(axis=(1, 2, 3)) / np.maximum(question.sum(axis=(1, 2, 3)), 1))
