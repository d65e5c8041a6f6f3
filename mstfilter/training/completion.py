"""Training of the completion network.

>>> settings = CompletionTraining(n_scenes=900, steps=40_000)
>>> train_completion(settings, "completion-model", on_progress=print)     # resumes where it stopped

The folder gets the samples (``samples/``), the state of the training (``state.safetensors``), the curves
(``curves.csv``), and at the end the model: ``weights.safetensors``, ``model.toml`` and ``metrics.csv``.

The loss is the evidence lower bound of a conditional variational autoencoder: the log loss of the voxels that are
not observed as free, and the divergence of the posterior of the latent variable from its prior. The log loss of a
sample is divided by the number of voxels on or behind the visible surface, so that small objects count as much as
large ones; the divisor depends on the input only, so the loss stays proper. The weights that are kept are an
exponential moving average over the steps. At the end, scale and shift of the logits are fitted to the validation
samples.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats
from torch import Tensor
from torch.nn import functional

from mstfilter.completion.crops import CHANNELS, LATTICE, channels, extruded
from mstfilter.completion.unet import ARCHITECTURE, CompletionNet, LatentLaw, ShapePosterior
from mstfilter.errors import InputError, check_choice
from mstfilter.files import atomic_path, write_csv, write_text
from mstfilter.trained import write_model
from mstfilter.training.completion_data import MASK_KINDS, Samples, read_samples, write_samples
from mstfilter.training.shapes import HELD_OUT, TRAINED

_STATE = "state.safetensors"
_SAVE_EVERY = 120.0  # seconds between saved states


@dataclass(frozen=True)
class CompletionTraining:
    """Settings of a training run."""

    seed: int = 0
    n_scenes: int = 900  #: scenes for training, about 35 samples each
    n_validation: int = 30  #: scenes for the calibration, of the same kinds of objects
    n_test: int = 50  #: scenes for the final figures, with two kinds of objects that are not trained on
    width: int = 16  #: features at half the resolution
    latent: int = 16  #: dimension of the latent variable
    steps: int = 40_000
    batch: int = 16
    rate: float = 2e-3  #: largest learning rate; it falls to 0 along a cosine
    divergence: float = 0.004  #: weight of the divergence in the loss
    average: float = 0.999  #: decay of the moving average of the weights
    half_precision: bool = True  #: compute in bfloat16


#: Settings by name. "cpu" takes about four core hours; "smoke" a minute, to see that everything works.
RECIPES = {
    "cpu": CompletionTraining(),
    "gpu": CompletionTraining(n_scenes=9000, width=32, steps=200_000, batch=64),
    "smoke": CompletionTraining(n_scenes=6, n_validation=2, n_test=3, width=8, latent=4, steps=150, average=0.97),
}


def completion_settings(recipe: str, overrides: Sequence[str] = ()) -> CompletionTraining:
    """The settings of a recipe with changes such as ``"steps=1000"``."""
    check_choice("recipe", recipe, tuple(RECIPES))
    settings = RECIPES[recipe]
    known = {field.name: getattr(settings, field.name) for field in fields(settings)}
    changes: dict[str, Any] = {}
    for text in overrides:
        name, _, value = text.partition("=")
        if name not in known:
            raise InputError(f"training has no setting {name!r}", f"settings: {', '.join(known)}")
        try:
            kind = type(known[name])
            changes[name] = {"true": True, "false": False}[value.lower()] if kind is bool else kind(value)
        except (ValueError, KeyError):
            raise InputError(f"setting {name} is {value!r}, expected {kind.__name__}") from None
    return replace(settings, **changes)


Progress = Callable[[int, int, str], None]  # steps done, steps in all, and a description


def train_completion(
    settings: CompletionTraining,
    out: str | Path,
    workers: int = 1,
    on_progress: Progress | None = None,
    device: str | None = None,
    max_steps: int | None = None,
) -> dict[str, float] | None:
    """Make the samples, train, and write the model.

    Parameters
    ----------
    out : path
        Folder. A folder with the same settings is continued; other settings raise InputError.
    workers : int
        Processes that make samples.
    device : str, optional
        Of torch. Default: a GPU if there is one.
    max_steps : int, optional
        Stop after so many steps in this call; the next call continues.

    Returns
    -------
    dict or None
        Figures on the test samples; None if the training is not finished.
    """
    folder, report = Path(out), on_progress or (lambda done, total, text: None)
    _check_settings(settings, folder)
    report(0, settings.steps, "making samples")
    parts = {
        "validation": write_samples(folder / "samples/validation", settings.seed + 1, settings.n_validation, workers),
        "test": write_samples(
            folder / "samples/test", settings.seed + 2, settings.n_test, workers, TRAINED + HELD_OUT
        ),
        "train": write_samples(folder / "samples/train", settings.seed, settings.n_scenes, workers),
    }
    where = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    run = _Run(settings, folder, where)
    if run.step < settings.steps:
        samples = read_samples(parts["train"])
        last = settings.steps if max_steps is None else min(settings.steps, run.step + max_steps)
        run.train(samples, read_samples(parts["validation"]), last, report)
        if run.step < settings.steps:
            return None
    net, calibration = run.averaged, fit_calibration(run.averaged, read_samples(parts["validation"]), where)
    figures, rows = measure(net, calibration, read_samples(parts["test"]), where)
    write_csv(folder / "metrics.csv", rows, float_format=".4f")
    description = {
        "architecture": ARCHITECTURE,
        "lattice_m": LATTICE,
        "network": {"channels": list(CHANNELS), "width": settings.width, "latent": settings.latent},
        "calibration": {"scale": calibration[0], "shift": calibration[1]},
        "training": asdict(settings),
        "test": {name: round(value, 4) for name, value in figures.items()},
    }
    write_model(folder, description, {name: t.cpu().numpy() for name, t in net.state_dict().items()})
    return figures


def _check_settings(settings: CompletionTraining, folder: Path) -> None:
    text = "".join(f"{name} = {value}\n" for name, value in asdict(settings).items())
    path = folder / "settings.txt"
    if path.exists() and path.read_text() != text:
        raise InputError(f"{folder} holds a training with other settings", "name another folder with --out")
    write_text(path, text)


class _Run:
    """The state of a training."""

    def __init__(self, settings: CompletionTraining, folder: Path, device: torch.device) -> None:
        self.settings, self.folder, self.device = settings, folder, device
        torch.manual_seed(settings.seed)
        shape = len(CHANNELS), settings.width, settings.latent
        self.net = CompletionNet(*shape).to(device)
        self.posterior = ShapePosterior(settings.width, settings.latent).to(device)
        self.averaged = CompletionNet(*shape).to(device)
        self.averaged.load_state_dict(self.net.state_dict())
        self.parameters = [*self.net.parameters(), *self.posterior.parameters()]
        self.optimiser = torch.optim.AdamW(self.parameters, lr=settings.rate, weight_decay=0.01)
        self.step = 0
        self.curves: list[dict[str, float]] = []
        if (folder / _STATE).exists():
            self._restore()

    def _save(self) -> None:
        from safetensors.torch import save_file

        moments = self.optimiser.state_dict()["state"]
        tensors = {f"net.{k}": v for k, v in self.net.state_dict().items()}
        tensors |= {f"averaged.{k}": v for k, v in self.averaged.state_dict().items()}
        tensors |= {f"posterior.{k}": v for k, v in self.posterior.state_dict().items()}
        tensors |= {f"adam.{i}.{k}": v for i, of in moments.items() for k, v in of.items()}
        tensors = {k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}
        with atomic_path(self.folder / _STATE) as partial:
            save_file({**tensors, "step": torch.tensor(self.step)}, partial)
        write_csv(self.folder / "curves.csv", self.curves, float_format=".5g")

    def _restore(self) -> None:
        from safetensors.torch import load_file

        tensors = load_file(self.folder / _STATE)
        for name in ("net", "averaged", "posterior"):
            own = {k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")}
            getattr(self, name).load_state_dict(own)
        state = self.optimiser.state_dict()
        state["state"] = {
            i: {k: tensors[f"adam.{i}.{k}"] for k in ("step", "exp_avg", "exp_avg_sq")}
            for i in range(len(self.parameters))
        }
        self.optimiser.load_state_dict(state)
        self.step = int(tensors["step"])
        path = self.folder / "curves.csv"
        if path.exists():
            names, *lines = (line.split(",") for line in path.read_text().split())
            self.curves = [dict(zip(names, map(float, line), strict=True)) for line in lines]

    def train(self, samples: Samples, validation: Samples, last: int, report: Progress) -> None:
        """Steps up to `last`."""
        s, saved, sums = self.settings, time.monotonic(), np.zeros(3)
        for bits, signed, truth in _batches(samples, s, self.step, last):
            rate = (
                s.rate
                * min(1.0, (self.step + 1) / min(500, 1 + s.steps // 10))
                * 0.5
                * (1 + np.cos(np.pi * self.step / s.steps))
            )
            for group in self.optimiser.param_groups:
                group["lr"] = rate
            sums += [1, *self._update(bits.to(self.device), signed.to(self.device), truth.to(self.device))]
            self.step += 1
            if self.step % 500 == 0 or self.step == last:
                found = evaluate(self.averaged, validation.take(np.arange(min(len(validation), 400))), self.device)
                row = {"step": self.step, "loss": sums[1] / sums[0], "nats": sums[2] / sums[0], **found}
                self.curves.append(row)
                report(self.step, s.steps, ", ".join(f"{k} {v:.4g}" for k, v in row.items() if k != "step"))
                sums[:] = 0
            if time.monotonic() - saved > _SAVE_EVERY or self.step == last:
                self._save()
                saved = time.monotonic()

    def _update(self, bits: Tensor, signed: Tensor, truth: Tensor) -> tuple[float, float]:
        """One step; the loss and the divergence in nats."""
        s = self.settings
        x = channels(bits, signed, _heights()).to(self.device)
        noise = torch.randn((len(x), s.latent), generator=torch.Generator().manual_seed(self.step)).to(self.device)
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=s.half_precision):
            features, prior = self.net.encode(x)
            law: LatentLaw = self.posterior(features, truth.float())
            logits = self.net.decode(features, law.draw(noise))
        unknown, own = (bits & 4) == 0, ((bits & 9) > 0).sum(dim=(1, 2, 3))
        loss = functional.binary_cross_entropy_with_logits(logits.float(), truth.float(), reduction="none")
        per_sample = (loss * unknown).sum(dim=(1, 2, 3)) / (own + 50)
        nats = law.divergence(prior).mean()
        total = per_sample.mean() + s.divergence * min(1.0, self.step / 2000) * nats
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, 1.0)
        self.optimiser.step()
        with torch.no_grad():
            decay = min(s.average, (1 + self.step) / (10 + self.step))
            for mean, now in zip(self.averaged.parameters(), self.net.parameters(), strict=True):
                mean.lerp_(now, 1 - decay)
        return float(per_sample.mean().detach()), float(nats.detach())


def _heights() -> Tensor:
    return (torch.arange(32) + 0.5) * LATTICE


def _batches(samples: Samples, s: CompletionTraining, first: int, last: int) -> Iterator[tuple[Tensor, ...]]:
    """Batches of the steps first .. last - 1: every epoch in another order, each sample turned and mirrored."""
    per_epoch = len(samples) // s.batch
    if not per_epoch:
        raise InputError(f"{len(samples)} samples are fewer than one batch of {s.batch}", "use more scenes")
    order, of_epoch = np.zeros(0, np.int64), -1
    for step in range(first, last):
        epoch, k = divmod(step, per_epoch)
        if epoch != of_epoch:
            order, of_epoch = np.random.default_rng([s.seed, 1, epoch]).permutation(len(samples)), epoch
        chosen = order[k * s.batch : (k + 1) * s.batch]
        turns = np.random.default_rng([s.seed, 2, step]).integers(8, size=s.batch)
        columns = (
            [_turned(values[i], t) for i, t in zip(chosen, turns, strict=True)]
            for values in (samples.bits, samples.signed, samples.truth)
        )
        yield tuple(torch.from_numpy(np.stack(column)) for column in columns)


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


def fit_calibration(net: CompletionNet, samples: Samples, device: torch.device) -> tuple[float, float]:
    """Scale and shift of the logits with the least log loss (J. Platt, "Probabilistic outputs for support vector
    machines and comparisons to regularized likelihood methods", 1999), over voxels that are not free."""
    logits, outcomes = [], []
    for part, found in _logits(net, samples, device):
        unknown = torch.from_numpy((samples.bits[part] & 4) == 0)
        logits.append(found[unknown])
        outcomes.append(torch.from_numpy(samples.truth[part])[unknown].float())
    x, y = torch.cat(logits).double(), torch.cat(outcomes).double()
    values = torch.tensor([1.0, 0.0], dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([values], max_iter=50, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = functional.binary_cross_entropy_with_logits(values[0] * x + values[1], y)
        loss.backward()
        return loss

    optimiser.step(closure)
    scale, shift = values.detach().tolist()
    return float(scale), float(shift)


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
    if len(of_scene) < 2:
        return float(of_scene.mean()), float("nan")
    half = stats.t.ppf(0.975, len(of_scene) - 1) * of_scene.std(ddof=1) / np.sqrt(len(of_scene))
    return float(of_scene.mean()), float(half)


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


def calibration_error(p: np.ndarray, outcome: np.ndarray, n_bins: int = 20) -> float:
    """Mean difference of probability and frequency over bins of equal width, weighted by their number of voxels."""
    index = np.minimum((p * n_bins).astype(np.int64), n_bins - 1)
    count = np.bincount(index, minlength=n_bins)
    gap = np.bincount(index, weights=p, minlength=n_bins) - np.bincount(index, weights=outcome, minlength=n_bins)
    return float(np.abs(gap).sum() / max(count.sum(), 1))
