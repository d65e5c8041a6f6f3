"""Training of the judge of seams.

>>> run_training(SeamsTraining.recipe("cpu"), "seam-model")

A batch is a set of regions. If a region is one object, its loss is -log P(one); else it is -log of the probability of
all divisions that separate its objects cleanly, or -log(1 - P(one)) if there is none. So the judge need not choose
among divisions that are equally good. How often a region is one object differs between scenes with groups, other
simulated scenes and real images. This share is no property of what is seen, so the loss takes it as known, and the
scores are those for even odds: the prior is the field `one_share` of `SeamTree`.

Strips are mirrored, and their colours are weakened or taken away. With `extra`, regions of labelled images join each
batch. At the end, scale and shift of the scores are fitted to the validation samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor, nn

from mst_training.loop import Training
from mst_training.scenes import Samples
from mst_training.seam_data import SeamSamples
from mstfilter.base.errors import InputError
from mstfilter.mst.segmentation.seam_measures import STRIP_CHANNELS
from mstfilter.mst.segmentation.seam_network import INPUTS, SEAM_ARCHITECTURE, SeamNet, decoded
from mstfilter.scoring.forecasts import ForecastTable

_CLEAN, _SLACK = 0.95, 0.02  # least purity of a clean division, and the most that it is less pure than the best
_COLOURS = slice(STRIP_CHANNELS.index("lightness"), STRIP_CHANNELS.index("b") + 1)
_TURNED = [STRIP_CHANNELS.index(name) for name in ("slope across", "distance")]  # change their sign in a mirror


@dataclass(frozen=True)
class SeamsTraining(Training):
    """Settings of the training of the judge. A scene gives about 20 regions with a dozen divisions each."""

    n_scenes: int = 600
    n_validation: int = 40
    n_test: int = 60
    width: int = 24
    steps: int = 6000
    batch: int = 24  #: regions of simulated scenes
    average: float = 0.995
    half_precision: bool = False
    colour_dropout: float = 0.15  #: share of the batches without colours
    extra: str = ""  #: folder with files of further samples (`SeamSamples.of_frame`); none if empty
    extra_without: str = ""  #: names of the files that are left out, without ending, separated by commas
    extra_batch: int = 8  #: regions of a batch from the further samples

    recipes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "cpu": {},
        "gpu": {"n_scenes": 6000, "steps": 60_000, "batch": 64},
        "smoke": {"n_scenes": 2, "n_validation": 1, "n_test": 1, "width": 8, "steps": 40, "average": 0.9},
    }
    architecture: ClassVar[str] = SEAM_ARCHITECTURE
    samples: ClassVar[type[Samples]] = SeamSamples
    losses: ClassVar[tuple[str, ...]] = ("loss",)

    def networks(self) -> dict[str, nn.Module]:
        return {"net": SeamNet(self.width)}

    def batches(self, samples: SeamSamples, first: int, last: int) -> Iterator[tuple[Tensor, ...]]:
        """Inputs, strips, purities, number of the region of each division; objects and prior of each region."""
        source, further = _Source.of(samples), self._extra()
        for step, chosen in self.order(len(source.rows), first, last):
            rng = np.random.default_rng([self.seed, 2, step])
            batch = source.batch(chosen)
            if further is not None:
                batch = _joined(batch, further.batch(rng.integers(len(further.rows), size=self.extra_batch)))
            x, strips, *others = batch
            if rng.uniform() < 0.5:
                strips = strips.flip(3)[:, [1, 0, *range(2, len(STRIP_CHANNELS))]]
                strips[:, _TURNED] *= -1
            strips[:, _COLOURS] *= 0.0 if rng.uniform() < self.colour_dropout else float(rng.uniform(0.5, 1.2))
            yield x, strips, *others

    def _extra(self) -> _Source | None:
        if not self.extra:
            return None
        without = {name.strip() for name in self.extra_without.split(",")}
        files = sorted(path for path in Path(self.extra).glob("*.npz") if path.stem not in without)
        if not files:
            raise InputError(f"{self.extra} has no files of samples", "an npz file of SeamSamples for each sequence")
        return _Source.of(SeamSamples.read(files))

    def loss(
        self, networks: Mapping[str, Any], step: int, batch: Sequence[Tensor]
    ) -> tuple[Tensor, tuple[float, ...]]:
        """The mean loss of the regions."""
        x, strips, *truth = batch
        net = networks["net"]
        if step == 0 and not self.start:  # the inputs are standardised by the first batch
            net.mean.copy_(x.mean(0))
            net.scale.copy_(x.std(0) + 0.05)
        total = region_losses(net(x, strips), *truth)[0].mean()
        return total, (float(total.detach()),)

    def validate(self, net: SeamNet, samples: SeamSamples, device: torch.device) -> dict[str, float]:
        return _figures(_judged(net, _Source.of(samples), device))

    def finish(
        self, net: SeamNet, validation: SeamSamples, test: SeamSamples, device: torch.device
    ) -> tuple[dict[str, Any], dict[str, float], list[dict[str, Any]]]:
        scale, shift = _calibrated(_judged(net, _Source.of(validation), device))
        source = _Source.of(test)
        scores, *truth = _judged(net, source, device)
        calibrated = (scale * scores + shift, *truth)
        table: list[dict[str, Any]] = []
        grouped = np.array([test.grouped[rows[0]] for rows in source.rows])
        for name, chosen in (("all", grouped >= 0), ("groups", grouped), ("other scenes", ~grouped)):
            table.append({"scenes": name, **_figures(calibrated, torch.from_numpy(chosen))})
        described = {
            "network": {"channels": [*INPUTS, *STRIP_CHANNELS], "width": self.width},
            "calibration": {"scale": scale, "shift": shift},
        }
        return described, dict(list(table[0].items())[1:]), table


def region_losses(
    scores: Tensor, purity: Tensor, region: Tensor, objects: Tensor, prior: Tensor
) -> tuple[Tensor, Tensor]:
    """The losses (r,) of regions and their log P(one), from the scores (k,) of all divisions.

    `purity` (k,), number of the `region` (k,) of each division, number of `objects` (r,) of each region, and `prior`
    (r,) log odds of "one".
    """
    n = len(objects)
    scores = scores - prior[region].to(scores.dtype)
    zero = torch.zeros(n, dtype=scores.dtype, device=scores.device)
    top = zero.scatter_reduce(0, region, scores.detach(), "amax")  # at least the 0 of "one"
    odds = torch.exp(scores - top[region])
    several = zero.index_add(0, region, odds)
    best = zero.scatter_reduce(0, region, purity.to(scores.dtype), "amax")
    clean = (purity >= _CLEAN) & (purity >= best[region] - _SLACK)
    right = zero.index_add(0, region, odds * clean)
    right = torch.where(right > 0, right, several)
    log_total = torch.log(several + torch.exp(-top)) + top
    log_one = -log_total
    log_right = torch.log(right + 1e-30) + top - log_total
    return -torch.where(objects < 2, log_one, log_right), log_one


@dataclass(frozen=True, eq=False)
class _Source:
    """Samples by region, with the share of "one" among scenes of a kind."""

    samples: SeamSamples
    rows: list[np.ndarray]  # of each region
    prior: np.ndarray  # (r,) log odds of "one" among the regions of such scenes that are no side of a division

    @classmethod
    def of(cls, samples: SeamSamples) -> _Source:
        rows = _by_region(samples)
        first = np.array([own[0] for own in rows])
        grouped, top, one = samples.grouped[first], samples.depth[first] == 0, samples.objects[first] < 2
        prior = np.zeros(len(rows))
        for kind in (False, True):
            known = one[(grouped == kind) & top]
            prior[grouped == kind] = np.log((known.sum() + 1) / ((~known).sum() + 1))
        return cls(samples, rows, prior)

    def batch(self, chosen: np.ndarray) -> tuple[Tensor, ...]:
        """The regions with these numbers (b,), as `SeamsTraining.batches` has them."""
        regions = [self.rows[k] for k in chosen]
        rows = np.concatenate(regions)
        of = np.repeat(np.arange(len(regions)), [len(one) for one in regions])
        objects = self.samples.objects[[one[0] for one in regions]].astype(np.int64)
        return (
            *(torch.from_numpy(np.nan_to_num(self.samples.x[rows])), decoded(self.samples.strip[rows])),
            *(torch.from_numpy(self.samples.purity[rows]), torch.from_numpy(of)),
            *(torch.from_numpy(objects), torch.from_numpy(self.prior[chosen])),
        )


def _by_region(samples: SeamSamples) -> list[np.ndarray]:
    """The rows of each region.

    The side of a division may hold a piece of the other object that no further division separates. Such a region is
    neither one object nor two, and is left out.
    """
    order = np.argsort(samples.region, kind="stable")
    starts = np.unique(samples.region[order], return_index=True)[1]
    rows = np.split(order, starts[1:])
    return [
        one
        for one in rows
        if samples.depth[one[0]] == 0 or samples.objects[one[0]] < 2 or samples.purity[one].max() >= _CLEAN
    ]


def _joined(one: tuple[Tensor, ...], other: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Two batches as one."""
    n = len(one[4])  # regions of the first one
    other = (*other[:3], other[3] + n, *other[4:])
    return tuple(torch.cat(pair) for pair in zip(one, other, strict=True))


_Judged = tuple[Tensor, ...]  # scores, purity, region, objects, prior: see `region_losses`


def _judged(net: SeamNet, source: _Source, device: torch.device) -> _Judged:
    """The scores of all divisions, region by region."""
    net.eval()
    found: list[tuple[Tensor, ...]] = []
    with torch.inference_mode():
        for k in range(0, len(source.rows), 64):
            x, strips, purity, of, *regions = source.batch(np.arange(k, min(k + 64, len(source.rows))))
            found.append((net(x.to(device), strips.to(device)).cpu(), purity, of + k, *regions))
    net.train()
    return tuple(torch.cat(column) for column in zip(*found, strict=True))


def _figures(judged: _Judged, chosen: Tensor | None = None) -> dict[str, float]:
    """Loss, and forecasts of "one object" of the chosen (r,) regions."""
    losses, log_one = region_losses(*judged)
    keep = torch.ones(len(losses), dtype=torch.bool) if chosen is None else chosen
    p, one = log_one[keep].exp().double().numpy(), (judged[3][keep] < 2).double().numpy()
    table = ForecastTable.of(p, one, np.ones(len(p)))
    return {
        "regions": float(keep.sum()),
        "region_loss": float(losses[keep].mean()),
        "one_log_loss": table.log_loss(0.001),
        "one_calibration_error": table.reliability().error,
        "one_share": float(one.mean()),
    }


def _calibrated(judged: _Judged) -> tuple[float, float]:
    """Scale and shift of the scores with the least mean loss."""
    scores, *truth = (part.double() if part.is_floating_point() else part for part in judged)

    def loss(values: np.ndarray) -> float:
        return float(region_losses(values[0] * scores + values[1], *truth)[0].mean())

    scale, shift = minimize(loss, (1.0, 0.0), method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-6}).x
    return float(scale), float(shift)
