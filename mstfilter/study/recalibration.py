"""The recalibrated log loss of the runs of a study. The forecasts of a scene are recalibrated on other scenes.

>>> add_log_loss(rows, counts)            # adds recalibrated_log_loss, recalibrated_log_loss_same, ..., energy_floor
>>> fitted = fit_recalibration(rows, counts, [("s1", "mst")])  # to score the scenes of another study

Recalibration and the floor of the energy score need other scenes of the same family and arm. The scenes of the fit
are the other scenes of the study, or the scenes to which a given recalibration was fitted. Seeds of one scene are
never on both sides.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.forecasts import Recalibration
from mstfilter.scoring import NOISE_RATES, FittedForecasts, leave_one_out

#: (family, arm) -> (scene, seed) -> counts (T, r, 1001, 7) of its pauses.
Counts = Callable[[str, str], Mapping[tuple[str, Any], np.ndarray]]


@dataclass(frozen=True, eq=False)
class _Fitted:
    """The fit to other scenes: a transformation of forecasts, and the best rate of noise for the energy score."""

    forecasts: FittedForecasts
    energy_rate: float

    def as_json(self) -> dict[str, Any]:
        r = self.forecasts.recalibration
        return {
            "rate": self.forecasts.rate,
            "p": r.p.tolist(),
            "probability": r.probability.tolist(),
            "energy_rate": self.energy_rate,
        }

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> _Fitted:
        recalibration = Recalibration(np.array(found["p"]), np.array(found["probability"]))
        return cls(FittedForecasts(float(found["rate"]), recalibration), float(found["energy_rate"]))


def add_log_loss(
    rows: Sequence[dict[str, Any]], counts: Counts, fitted: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Add ``recalibrated_log_loss``, its splits and ``energy_floor`` to rows, in place.

    Parameters
    ----------
    rows : sequence of dict
        One row per pause with family, scene, arm, seed, pause and ``energy_noise``.
    counts : callable
    fitted : mapping, optional
        A recalibration from `fit_recalibration`. By default, the other scenes of its family are used for each scene,
        so at least two scenes are needed.
    """
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        if row.get("energy_noise"):
            groups[row["family"], row["arm"]].append(row)
    for (family, arm), own in groups.items():
        found = counts(family, arm)
        if fitted is None:
            by_scene = _fit_to_others(own, found)
        else:
            one = fitted.get(family, {}).get(arm)
            by_scene = {row["scene"]: _Fitted.from_json(one) for row in own} if one else {}
        for row in own:
            fit, of_run = by_scene.get(row["scene"]), found.get((row["scene"], row["seed"]))
            if fit is not None and of_run is not None:
                row.update(fit.forecasts.row(of_run[row["pause"]]))
                row["energy_floor"] = row["energy_noise"][NOISE_RATES.index(fit.energy_rate)]


def fit_recalibration(
    rows: Sequence[Mapping[str, Any]], counts: Counts, arms: Sequence[tuple[str, str]]
) -> dict[str, dict[str, Any]]:
    """The fit of each family and arm to all its scenes: family -> arm -> plain values, with scene names."""
    found: dict[str, dict[str, Any]] = defaultdict(dict)
    for family, arm in arms:
        own = [row for row in rows if (row["family"], row["arm"]) == (family, arm)]
        by_scene = _by_scene(counts(family, arm))
        total = sum(by_scene.values(), np.zeros(1, np.int64))
        if total.any():
            fit = _Fitted(FittedForecasts.fit(total), _energy_rate(own)).as_json()
            found[family][arm] = fit | {"scenes": sorted(by_scene)}
    return dict(found)


def _by_scene(counts: Mapping[tuple[str, Any], np.ndarray]) -> dict[str, np.ndarray]:
    """Counts (r, 1001, 7) of each scene, summed over seeds and pauses t >= 1."""
    found: dict[str, np.ndarray] = {}
    for (scene, _), one in counts.items():
        found[scene] = found.get(scene, 0) + one[1:].sum(axis=0, dtype=np.int64)
    return found


def _fit_to_others(
    rows: Sequence[Mapping[str, Any]], counts: Mapping[tuple[str, Any], np.ndarray]
) -> dict[str, _Fitted]:
    return {
        scene: _Fitted(fit, _energy_rate([row for row in rows if row["scene"] != scene]))
        for scene, fit in leave_one_out(_by_scene(counts)).items()
    }


def _energy_rate(rows: Sequence[Mapping[str, Any]]) -> float:
    """The rate of noise with the lowest mean energy score over pauses t >= 1."""
    energies = np.array([row["energy_noise"] for row in rows if row["pause"] >= 1 and row.get("energy_noise")])
    return NOISE_RATES[int(np.argmin(np.nansum(energies, axis=0)))]
