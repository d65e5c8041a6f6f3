"""Training of the completion network.

>>> run_training(CompletionTraining(n_scenes=900, steps=40_000), "completion-model")

The loss is the evidence lower bound of a conditional variational autoencoder: the log loss of the voxels that are
not observed as free, and the divergence of the posterior of the latent variable from its prior. The log loss of a
sample is divided by the number of voxels on or behind the visible surface, so that small objects count as much as
large ones; the divisor depends on the input only, so the loss stays proper. At the end, scale and
shift of the logits are fitted to the validation samples, over the voxels that are not free.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mstfilter.completion.crops import CHANNELS, LATTICE, channels, extruded
from mstfilter.completion.unet import ARCHITECTURE, CompletionNet, LatentLaw, ShapePosterior
from mstfilter.statistics import interval
from mstfilter.training.completion_data import MASK_KINDS, Samples, read_samples, write_samples
from mstfilter.training.loop import Training, calibration_error, fit_calibration
from mstfilter.training.shapes import HELD_OUT


@dataclass(frozen=True)
class CompletionTraining(Training):
    """Settings of the training of the completion network. A scene gives about 35 samples."""

    latent: int = 16  #: dimension of the latent variable
    #: Weight of the divergence in the loss. It is larger than one over the number of voxels, because the voxels of a
    #: shape are far from independent: at 0.004 the posterior holds 22 nats, details that the prior cannot know.
    divergence: float = 0.04

    recipes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "cpu": {},
        "gpu": {"n_scenes": 9000, "width": 32, "steps": 200_000, "batch": 64},
        "smoke": {
            **{"n_scenes": 6, "n_validation": 2, "n_test": 3},
            **{"width": 8, "latent": 4, "steps": 150, "average": 0.97},
        },
    }
    architecture: ClassVar[str] = ARCHITECTURE
    losses: ClassVar[tuple[str, ...]] = ("loss", "nats")

    def write(self, folder: Path, seed: int, n_scenes: int, workers: int, kinds: tuple[str, ...]) -> list[Path]:
        return write_samples(folder, seed, n_scenes, workers, kinds)

    def read(self, paths: Sequence[Path]) -> Samples:
        return read_samples(paths)

    def networks(self) -> dict[str, nn.Module]:
        net = CompletionNet(len(CHANNELS), self.width, self.latent)
        return {"net": net, "posterior": ShapePosterior(self.width, self.latent)}

    def batches(self, samples: Samples, first: int, last: int) -> Iterator[tuple[Tensor, ...]]:
        """Batches in which each sample is turned and mirrored."""
        for step, chosen in self.order(len(samples), first, last):
            turns = np.random.default_rng([self.seed, 2, step]).integers(8, size=self.batch)
            columns = (
                [_turned(values[i], t) for i, t in zip(chosen, turns, strict=True)]
                for values in (samples.bits, samples.signed, samples.truth)
            )
            yield tuple(torch.from_numpy(np.stack(column)) for column in columns)

    def loss(
        self, networks: Mapping[str, Any], step: int, batch: Sequence[Tensor]
    ) -> tuple[Tensor, tuple[float, ...]]:
        """Log loss a voxel on or behind the surface, with the weighted divergence in nats."""
        bits, signed, truth = batch
        device = bits.device
        x = channels(bits, signed, _heights()).to(device)
        noise = torch.randn((len(x), self.latent), generator=torch.Generator().manual_seed(step)).to(device)
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=self.half_precision):
            features, prior = networks["net"].encode(x)
            law: LatentLaw = networks["posterior"](features, truth.float())
            logits = networks["net"].decode(features, law.draw(noise))
        unknown, own = (bits & 4) == 0, ((bits & 9) > 0).sum(dim=(1, 2, 3))
        loss = functional.binary_cross_entropy_with_logits(logits.float(), truth.float(), reduction="none")
        per_sample = ((loss * unknown).sum(dim=(1, 2, 3)) / (own + 50)).mean()
        nats = law.divergence(prior).mean()
        total = per_sample + self.divergence * min(1.0, step / 2000) * nats
        return total, (float(per_sample.detach()), float(nats.detach()))

    def validate(self, net: CompletionNet, samples: Samples, device: torch.device) -> dict[str, float]:
        return evaluate(net, samples.take(np.arange(min(len(samples), 400))), device)

    def finish(
        self, net: CompletionNet, validation: Samples, test: Samples, device: torch.device
    ) -> tuple[dict[str, Any], dict[str, float], list[dict[str, Any]]]:
        logits, outcomes = [], []
        for part, found in _logits(net, validation, device):
            unknown = torch.from_numpy((validation.bits[part] & 4) == 0)
            logits.append(found[unknown])
            outcomes.append(torch.from_numpy(validation.truth[part])[unknown])
        calibration = fit_calibration(torch.cat(logits), torch.cat(outcomes))
        figures, rows = measure(net, calibration, test, device)
        described = {
            "lattice_m": LATTICE,
            "network": {"channels": list(CHANNELS), "width": self.width, "latent": self.latent},
            "calibration": {"scale": calibration[0], "shift": calibration[1]},
        }
        return described, figures, rows


def _heights() -> Tensor:
    return (torch.arange(32) + 0.5) * LATTICE


def _turned(values: np.ndarray, symmetry: int) -> np.ndarray:
    """One of the eight symmetries about the vertical axis."""
    turned = np.rot90(values, symmetry % 4)
    return turned[::-1] if symmetry >= 4 else turned


def _logits(
    net: CompletionNet, samples: Samples, device: torch.device, noise: np.ndarray | None = None
) -> Iterator[tuple[slice, Tensor]]:
    """Logits of batches of samples, with the mode of the latent variable or with noise (n, latent)."""
    with torch.inference_mode():
        for start in range(0, len(samples), 32):
            part = slice(start, min(start + 32, len(samples)))
            bits, signed = torch.from_numpy(samples.bits[part]), torch.from_numpy(samples.signed[part])
            features, prior = net.encode(channels(bits, signed, _heights()).to(device))
            z = prior.mean if noise is None else prior.draw(torch.from_numpy(noise[part]).float().to(device))
            yield part, net.decode(features, z).cpu()


def evaluate(net: CompletionNet, samples: Samples, device: torch.device) -> dict[str, float]:
    """Mean IoU of the mode, and its log loss over voxels that are not free, before calibration."""
    iou, loss, n = [], 0.0, 0
    for part, logits in _logits(net, samples, device):
        truth, unknown = torch.from_numpy(samples.truth[part]), torch.from_numpy((samples.bits[part] & 4) == 0)
        iou.append(_iou((logits > 0) & unknown, truth))
        every = functional.binary_cross_entropy_with_logits(logits, truth.float(), reduction="none")
        loss, n = loss + float((every * unknown).sum()), n + int(unknown.sum())
    return {"iou": float(np.concatenate(iou).mean()), "log_loss": loss / max(n, 1)}


def _iou(found: Tensor, truth: Tensor) -> np.ndarray:
    dims = (1, 2, 3)
    return np.asarray(((found & truth).sum(dims) / (found | truth).sum(dims).clamp(min=1)).numpy())


def measure(
    net: CompletionNet, calibration: tuple[float, float], samples: Samples, device: torch.device, n_draws: int = 8
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Figures on test samples, and a table by group: mean IoU of the mode and of extrusion, and volume over true
    volume.

    ``log_loss_mode`` and ``log_loss_draws`` are of hard shapes as hypotheses hold them, softened by 1 %: of the mode,
    and of the share of `n_draws` draws that fill a voxel. ``log_loss_noise`` is of the mode and noise at its border,
    at the rate that is best here. ``calibration_error`` is of the mode's probabilities.
    """
    scale, shift = calibration
    n = len(samples)
    unknown = (samples.bits & 4) == 0
    p = np.zeros(samples.truth.shape, np.float32)
    for part, logits in _logits(net, samples, device):
        p[part] = torch.sigmoid(scale * logits + shift).numpy() * unknown[part]
    question = unknown & (((samples.bits & 9) > 0) | (p > 0.02))
    mode, rule, truth = p >= 0.5, extruded(samples.bits), samples.truth
    share = np.zeros_like(p)
    draw_iou = np.zeros((n_draws, n))
    rng = np.random.default_rng(0)
    for k in range(n_draws):
        noise = rng.standard_normal((n, net.prior.out_features // 2))
        for part, logits in _logits(net, samples, device, noise):
            drawn = (torch.sigmoid(scale * logits + shift).numpy() >= 0.5) & unknown[part]
            share[part] += drawn / np.float32(n_draws)
            draw_iou[k, part] = shape_iou(drawn, truth[part])
    iou = {"network": shape_iou(mode, truth), "extrude": shape_iou(rule, truth)}
    volume = {
        name: found.sum(axis=(1, 2, 3)) / np.maximum(truth.sum(axis=(1, 2, 3)), 1)
        for name, found in (("network", mode), ("extrude", rule))
    }
    groups: dict[str, np.ndarray] = {"all": np.ones(n, bool)}
    groups |= {f"mask: {name}": samples.mask == k for k, name in enumerate(MASK_KINDS)}
    bounds = ((0.9, 1.01), (0.5, 0.9), (0.0, 0.5))
    groups |= {
        f"visible {int(100 * a)} - {int(min(100 * b, 100))} %": (samples.visible >= a) & (samples.visible < b)
        for a, b in bounds
    }
    groups |= {f"shape: {name}": samples.kind == name for name in sorted(set(samples.kind.tolist()))}
    groups["shapes not trained on"] = np.isin(samples.kind, HELD_OUT)
    rows = [
        {
            "group": name,
            "n": int(of.sum()),
            "network": float(iou["network"][of].mean()),
            "extrude": float(iou["extrude"][of].mean()),
            "one draw": float(draw_iou[:, of].mean()),
            "volume network": float(np.median(volume["network"][of])),
            "volume extrude": float(np.median(volume["extrude"][of])),
        }
        for name, of in groups.items()
        if of.any()
    ]
    losses = {"mode": _hard_loss(mode, truth, question), "draws": _hard_loss(share, truth, question)}
    border = _border(mode)
    noisy = [_hard_loss(np.where(border, (1 - r) * mode + r / 2, mode), truth, question) for r in _NOISE_RATES]
    losses["noise"] = min(noisy, key=np.mean)
    figures = {
        "iou": float(iou["network"].mean()),
        "iou_extrude": float(iou["extrude"].mean()),
        "log_loss": float(_hard_loss(p, truth, question, 0.0).mean()),
        **{f"log_loss_{name}": float(values.mean()) for name, values in losses.items()},
        "calibration_error": calibration_error(p[question], truth[question]),
    }
    for other in ("mode", "noise"):
        mean, half = _by_scene(losses["draws"] - losses[other], samples.scene)
        figures |= {f"draws_minus_{other}": mean, f"draws_minus_{other}_half_width": half}
    return figures, rows


_NOISE_RATES = (0.1, 0.2, 0.4, 0.6, 0.8)


def _by_scene(values: np.ndarray, scene: np.ndarray) -> tuple[float, float]:
    """Mean over scenes, and half the width of its 95 % interval (Student's t); NaN for one scene."""
    of_scene = np.array([values[scene == k].mean() for k in np.unique(scene)])
    low, high = interval(of_scene)
    return float(of_scene.mean()), (high - low) / 2


def shape_iou(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """IoU (n,) of shapes (n, X, Y, Z) bool."""
    axes = (1, 2, 3)
    return np.asarray((found & truth).sum(axis=axes) / np.maximum((found | truth).sum(axis=axes), 1))


def _hard_loss(p: np.ndarray, truth: np.ndarray, question: np.ndarray, softening: float = 0.02) -> np.ndarray:
    """Mean log loss (n,) in nats of the voxels in question, after p <- (1 - e) p + e / 2."""
    p = np.clip((1 - softening) * p + softening / 2, 1e-6, 1 - 1e-6)
    loss = -np.log(np.where(truth, p, 1 - p))
    return np.asarray((loss * question).sum(axis=(1, 2, 3)) / np.maximum(question.sum(axis=(1, 2, 3)), 1))


def _border(shape: np.ndarray) -> np.ndarray:
    """Voxels of shapes (n, X, Y, Z) with a face neighbour on the other side of the border."""
    border = np.zeros_like(shape)
    for axis in (1, 2, 3):
        here, there = [slice(None)] * 4, [slice(None)] * 4
        here[axis], there[axis] = slice(1, None), slice(None, -1)
        differs = shape[tuple(here)] != shape[tuple(there)]
        border[tuple(here)] |= differs
        border[tuple(there)] |= differs
    return border
