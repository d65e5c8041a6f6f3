"""The training loop of the learned parts: settings, steps, state on disk, calibration.

>>> settings = CompletionTraining.recipe("cpu", ["steps=10000"])
>>> run_training(settings, "completion-model", on_progress=print)     # resumes where it stopped

A part defines its settings as a subclass of `Training`, which names the samples and says what the loss is. The
folder gets the samples (``samples/``), the state (``state.safetensors``), the curves (``curves.csv``), and at the end
the model: ``weights.safetensors``, ``model.toml`` and ``metrics.csv``.

The weights that are kept are an exponential moving average over the steps.
"""

from __future__ import annotations

import copy
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mst_training.scenes import Clutter, Samples
from mst_training.shapes import HELD_OUT, TRAINED
from mstfilter.base.errors import InputError, check_choice
from mstfilter.base.files import atomic_path, read_csv, write_csv, write_text
from mstfilter.base.reading import read_text
from mstfilter.base.trained import DESCRIPTION, open_model, write_model
from mstfilter.lab.simulation.objects import MeshPool

_STATE = "state.safetensors"
_SAVE_EVERY = 120.0  # seconds between saved states

Progress = Callable[[int, int, str], None]  # steps done, steps in all, and a description


@dataclass(frozen=True)
class Training(ABC):
    """Settings of a training run, and what is trained."""

    seed: int = 0
    n_scenes: int = 900  #: scenes for training
    n_validation: int = 30  #: scenes for the calibration, of the same kinds of objects
    n_test: int = 50  #: scenes for the final figures, with two kinds of objects that are not trained on
    width: int = 16  #: features at the highest resolution of the network
    steps: int = 40_000
    batch: int = 16
    rate: float = 2e-3  #: largest learning rate; it falls to 0 along a cosine
    average: float = 0.999  #: decay of the moving average of the weights
    half_precision: bool = True  #: compute in bfloat16; without hardware for it, that is slower by a factor of 2.5
    objects: str = ""  #: folder of meshes, of which the scenes have some; none if empty
    start: str = ""  #: name or folder of a model of the same size whose weights are the start; none if empty

    #: Changes of the settings by name. "cpu" takes about four core hours, "smoke" shows that everything works.
    recipes: ClassVar[Mapping[str, Mapping[str, Any]]]
    architecture: ClassVar[str]
    samples: ClassVar[type[Samples]]  #: what it is trained on
    losses: ClassVar[tuple[str, ...]]  #: names of the figures of `loss`

    @classmethod
    def recipe(cls, name: str, overrides: Sequence[str] = ()) -> Self:
        """The settings of a recipe with changes such as ``"steps=1000"``."""
        check_choice("recipe", name, tuple(cls.recipes))
        settings = cls(**cls.recipes[name])
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

    def clutter(self, part: str) -> Clutter:
        """What the scenes of the training, validation or test (``part``) look like."""
        usual = self.samples.clutter
        if part == "test":
            return replace(usual, kinds=TRAINED + HELD_OUT)
        pool: MeshPool = "training" if part == "train" else "tuning"
        return replace(usual, objects=self.objects, pool=pool) if self.objects else usual

    def make_samples(self, folder: Path, workers: int) -> dict[str, list[Path]]:
        """Files with samples for validation, test and training; those that exist are kept."""
        counts = {"validation": self.n_validation, "test": self.n_test, "train": self.n_scenes}
        seeds = {"validation": self.seed + 1, "test": self.seed + 2, "train": self.seed}
        return {
            part: self.samples.write(folder / part, seeds[part], n, workers, self.clutter(part))
            for part, n in counts.items()
        }

    def read_training(self, files: Mapping[str, Sequence[Path]]) -> Any:
        """The samples for the training, as `batches` expects them."""
        return self.samples.read(files["train"])

    @abstractmethod
    def networks(self) -> dict[str, nn.Module]:
        """New networks by name: ``net``, and those that only the training uses."""

    def first_weights(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The weights of ``net`` at the start, from those of the model `start`."""
        return dict(tensors)

    @abstractmethod
    def batches(self, samples: Any, first: int, last: int) -> Iterator[tuple[Tensor, ...]]:
        """Batches of the steps first .. last - 1."""

    @abstractmethod
    def loss(
        self, networks: Mapping[str, Any], step: int, batch: Sequence[Tensor]
    ) -> tuple[Tensor, tuple[float, ...]]:
        """The loss of a batch, and the figures `losses` for the curves."""

    @abstractmethod
    def validate(self, net: Any, samples: Any, device: torch.device) -> dict[str, float]:
        """Figures on the validation samples for the curves."""

    @abstractmethod
    def finish(
        self, net: Any, validation: Any, test: Any, device: torch.device
    ) -> tuple[dict[str, Any], dict[str, float], list[dict[str, Any]]]:
        """What ``model.toml`` says of the network, figures on the test samples, and a table of them by group."""

    def order(self, n: int, first: int, last: int) -> Iterator[tuple[int, np.ndarray]]:
        """Steps first .. last - 1 with the samples (batch,) of each: every epoch in another order."""
        per_epoch = n // self.batch
        if not per_epoch:
            raise InputError(f"{n} samples are fewer than one batch of {self.batch}", "use more scenes")
        order, of_epoch = np.zeros(0, np.int64), -1
        for step in range(first, last):
            epoch, k = divmod(step, per_epoch)
            if epoch != of_epoch:
                order, of_epoch = np.random.default_rng([self.seed, 1, epoch]).permutation(n), epoch
            yield step, order[k * self.batch : (k + 1) * self.batch]


def run_training(
    settings: Training,
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
        Folder. A folder with the same settings is continued, and a finished model is left as it is; other settings
        raise InputError.
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
    if (folder / DESCRIPTION).is_file():  # it is finished
        return dict(open_model(str(folder), settings.architecture).description["test"])
    report(0, settings.steps, "making samples")
    parts, read = settings.make_samples(folder / "samples", workers), settings.samples.read
    run = _Run(settings, folder, torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu")))
    validation = read(parts["validation"])
    if run.step < settings.steps:
        last = settings.steps if max_steps is None else min(settings.steps, run.step + max_steps)
        run.train(settings.read_training(parts), validation, last, report)
        if run.step < settings.steps:
            return None
    described, figures, rows = settings.finish(run.averaged, validation, read(parts["test"]), run.device)
    write_csv(folder / "metrics.csv", rows, float_format=".4f")
    description = {
        "architecture": settings.architecture,
        **described,
        "training": asdict(settings),
        "test": {name: round(value, 4) for name, value in figures.items()},
    }
    write_model(folder, description, {name: t.cpu().numpy() for name, t in run.averaged.state_dict().items()})
    return figures


def _check_settings(settings: Training, folder: Path) -> None:
    lines = [f"{name} = {value}" for name, value in asdict(settings).items()]
    path = folder / "settings.txt"
    if path.exists() and sorted(read_text(path, "a training").splitlines()) != sorted(lines):
        raise InputError(f"{folder} holds a training with other settings", "name another folder with --out")
    write_text(path, "\n".join(lines) + "\n")


class _Run:
    """The state of a training."""

    def __init__(self, settings: Training, folder: Path, device: torch.device) -> None:
        self.settings, self.folder, self.device = settings, folder, device
        torch.manual_seed(settings.seed)
        self.networks = {name: network.to(device) for name, network in settings.networks().items()}
        if settings.start:
            tensors = open_model(settings.start, settings.architecture).tensors
            self.networks["net"].load_state_dict(
                settings.first_weights({name: torch.from_numpy(value) for name, value in tensors.items()})
            )
        self.averaged = copy.deepcopy(self.networks["net"])
        self.parameters = [p for network in self.networks.values() for p in network.parameters() if p.requires_grad]
        self.optimiser = torch.optim.AdamW(self.parameters, lr=settings.rate, weight_decay=0.01)
        self.step = 0
        self.curves: list[dict[str, float]] = []
        if (folder / _STATE).exists():
            self._restore()

    def _save(self) -> None:
        from safetensors.torch import save_file

        moments = self.optimiser.state_dict()["state"]
        parts = {**self.networks, "averaged": self.averaged}
        tensors = {f"{name}.{k}": v for name, part in parts.items() for k, v in part.state_dict().items()}
        tensors |= {f"adam.{i}.{k}": v for i, of in moments.items() for k, v in of.items()}
        tensors = {k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}
        with atomic_path(self.folder / _STATE) as partial:
            save_file({**tensors, "step": torch.tensor(self.step)}, partial)
        write_csv(self.folder / "curves.csv", self.curves, float_format=".5g")

    def _restore(self) -> None:
        from safetensors.torch import load_file

        tensors = load_file(self.folder / _STATE)
        for name, part in {**self.networks, "averaged": self.averaged}.items():
            part.load_state_dict(
                {k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")}
            )
        state = self.optimiser.state_dict()
        state["state"] = {
            i: {k: tensors[f"adam.{i}.{k}"] for k in ("step", "exp_avg", "exp_avg_sq")}
            for i in range(len(self.parameters))
        }
        self.optimiser.load_state_dict(state)
        self.step = int(tensors["step"])
        path = self.folder / "curves.csv"
        if path.exists():
            self.curves = [{name: float(value) for name, value in row.items()} for row in read_csv(path)]

    def train(self, samples: Any, validation: Any, last: int, report: Progress) -> None:
        """Steps up to `last`."""
        s, saved, sums, n = self.settings, time.monotonic(), np.zeros(len(self.settings.losses)), 0
        for batch in s.batches(samples, self.step, last):
            sums, n = sums + self._update([values.to(self.device) for values in batch]), n + 1
            self.step += 1
            if self.step % 500 == 0 or self.step == last:
                found = s.validate(self.averaged, validation, self.device)
                row = {"step": self.step, **dict(zip(s.losses, (sums / n).tolist(), strict=True)), **found}
                self.curves.append(row)
                report(self.step, s.steps, ", ".join(f"{k} {v:.4g}" for k, v in row.items() if k != "step"))
                sums, n = np.zeros(len(s.losses)), 0
            if time.monotonic() - saved > _SAVE_EVERY or self.step == last:
                self._save()
                saved = time.monotonic()

    def _update(self, batch: Sequence[Tensor]) -> np.ndarray:
        """One step; the figures of the loss."""
        s = self.settings
        start = min(1.0, (self.step + 1) / min(500, 1 + s.steps // 10))
        for group in self.optimiser.param_groups:
            group["lr"] = s.rate * start * 0.5 * (1 + np.cos(np.pi * self.step / s.steps))
        total, figures = s.loss(self.networks, self.step, batch)
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, 1.0)
        self.optimiser.step()
        with torch.no_grad():
            decay = min(s.average, (1 + self.step) / (10 + self.step))
            for mean, now in zip(self.averaged.parameters(), self.networks["net"].parameters(), strict=True):
                mean.lerp_(now, 1 - decay)
        return np.array(figures)


def fit_calibration(logits: Tensor, outcomes: Tensor) -> tuple[float, float]:
    """Scale and shift of logits (n,) with the least log loss of outcomes (n,), 0 or 1.

    J. Platt, "Probabilistic outputs for support vector machines and comparisons to regularized likelihood methods",
    1999.
    """
    x, y = logits.double(), outcomes.double()
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
