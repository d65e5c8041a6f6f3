"""The summary of a study: means by family and arm, and paired differences from the reference.

>>> summary = summarise(folder.rows(), reference="mst")
>>> summary.metric("s1", "mst", "quality").mean, summary.differences[0].words

The two primary endpoints are means over pauses t >= 1. *Quality* is the unweighted mean of the hypotheses' quality
(form ``objects``); higher is better. *Log loss (recalibrated)* is the log loss of the forecasts in nats, after
recalibration on other scenes; lower is better (see `mstfilter.scoring.log_loss`). Other metrics are averaged over the
same pauses. Values are averaged over filter seeds first, then over scenes. A difference is the value of an arm minus
the value of the reference: arms are paired by scene, and in a scene by the filter seeds that both have (`summarise`,
then `mstfilter.scoring.statistics.compare`). The p values of both endpoints, and of the study's own metrics, are
adjusted together.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from mstfilter.scoring import LOG_LOSS
from mstfilter.scoring.statistics import Difference, compare, conclusion, holm, interval, slope

ENDPOINTS = {"quality": 1, LOG_LOSS: -1}  # 1: higher is better
SLOPES = {name: f"{name}_slope" for name in ENDPOINTS}  # change from pause to pause, t = 0 included
NOT_WORSE = 0.005  # largest loss in the other endpoint if a filter is claimed to be better
_NAMES = ("family", "scene", "arm", "seed", "pause", "time_s")


def title_of(metric: str) -> str:
    """The name of a metric in texts and figures."""
    return metric.replace(LOG_LOSS, "log loss (recalibrated)").replace("_", " ")


def number_text(value: float | None, sign: str = "") -> str:
    """A number with three decimals; a dash for an unknown value. `sign` is "+" to write the sign of all numbers."""
    return "–" if value is None or value != value else f"{value:{sign}.3f}"


def interval_text(low: float, high: float, sign: str = "") -> str:
    """An interval as text; a dash for an unknown interval."""
    return "–" if low != low else f"[{low:{sign}.3f}, {high:{sign}.3f}]"


@dataclass(frozen=True)
class ArmMetric:
    """A metric of an arm on the scenes of a family."""

    family: str
    arm: str
    name: str
    by_scene: Mapping[str, float]  #: scene -> mean over filter seeds, without scenes that do not define the metric

    @property
    def mean(self) -> float:
        """Mean over scenes; NaN if there are none."""
        return float(np.mean(list(self.by_scene.values()))) if self.by_scene else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """BCa bootstrap interval of the mean over scenes."""
        return interval(np.array(list(self.by_scene.values())))


@dataclass(frozen=True)
class Compared:
    """Difference (arm minus reference) of a metric on a family."""

    family: str
    arm: str
    reference: str
    metric: str
    difference: Difference  #: `p_holm` is adjusted over all differences that are `adjusted`, and NaN for all others
    reported_only: bool = False  #: the arm is left out of the conclusions and of the adjustment of p values
    is_endpoint: bool = True  #: the metric is a primary endpoint or the study's own

    @property
    def adjusted(self) -> bool:
        """Whether the difference is part of the conclusions, and its p value is adjusted."""
        return self.is_endpoint and not self.reported_only

    @property
    def words(self) -> str:
        """The conclusion in words."""
        better = {1: " (higher is better)", -1: " (lower is better)"}.get(ENDPOINTS.get(self.metric, 0), "")
        return conclusion(
            self.difference, self.arm, self.reference, f"{self.family} in {title_of(self.metric)}{better}"
        )


@dataclass(frozen=True)
class Summary:
    """Means and differences of a study. Families, arms and names of metrics are in the order of the study."""

    families: tuple[str, ...]
    arms: tuple[str, ...]
    names: tuple[str, ...]
    reference: str
    #: All times are of runs that found shared work in the cache (the first seed of an arm and scene is omitted).
    warm: bool
    metrics: tuple[ArmMetric, ...]
    differences: tuple[Compared, ...]  #: `compared_first` first, then the slopes of endpoints, then all other metrics
    compared_first: tuple[str, ...]  #: the primary endpoints and the study's own metrics

    def metric(self, family: str, arm: str, name: str = "quality") -> ArmMetric | None:
        """The value of a metric; None if the arm has no value for this family."""
        for one in self.metrics:
            if (one.family, one.arm, one.name) == (family, arm, name):
                return one
        return None

    def compared(self, name: str = "quality") -> list[Compared]:
        """Differences of all arms from the reference in a metric."""
        return [one for one in self.differences if one.metric == name]

    def is_better(self, family: str, arm: str) -> bool:
        """Whether the study shows that the reference is better than an arm on a family.

        One endpoint must be better, with an adjusted p value below .05 over at least 20 scenes, and the other one not
        worse by more than .005.
        """
        found = [one for one in self.differences if (one.family, one.arm) == (family, arm) and one.adjusted]
        leads = [(-ENDPOINTS[d.metric] * d.difference.mean, d.difference) for d in found if d.metric in ENDPOINTS]
        better = any(lead > 0 and d.is_claim for lead, d in leads)
        return better and len(leads) == len(ENDPOINTS) and all(lead > -NOT_WORSE for lead, _ in leads)

    def metric_rows(self) -> list[dict[str, Any]]:
        """Rows of summary.csv."""
        return [
            {"family": one.family, "arm": one.arm, "metric": one.name, "n": len(one.by_scene), "mean": one.mean}
            | dict(zip(("low", "high"), one.interval, strict=True))
            for one in self.metrics
        ]

    def difference_rows(self) -> list[dict[str, Any]]:
        """Rows of differences.csv."""
        rows = []
        for one in self.differences:
            row = {"family": one.family, "arm": one.arm, "reference": one.reference, "metric": one.metric}
            adjusted = {"conclusion": one.words} if one.adjusted else {"conclusion": "", "p_holm": None}
            numbers = {name: value for name, value in asdict(one.difference).items() if name != "values"}
            rows.append({**row, **numbers, **adjusted})
        return rows


def summarise(
    rows: Sequence[Mapping[str, Any]],
    reference: str,
    cost: Sequence[str] = (),
    reported_only: Collection[str] = (),
    own: Sequence[str] = (),
) -> Summary:
    """Summarise the rows that `StudyFolder.rows` returns.

    Parameters
    ----------
    rows : sequence of mapping
    reference : str
        The arm with which the other arms are compared.
    cost : sequence of str
        Columns of time and memory, which are averaged over all pauses and not compared between arms. A missing stage
        counts as 0 seconds. Of several filter seeds, the first is omitted, because it fills the cache.
    reported_only : collection of str
        Arms that are not part of the comparisons with adjusted p values.
    own : sequence of str
        Columns of own metrics, which are compared like the primary endpoints.
    """
    families, arms = (tuple(dict.fromkeys(str(row[k]) for row in rows)) for k in ("family", "arm"))
    named = list(dict.fromkeys(k for row in rows for k in row if k not in _NAMES))
    measured = [name for name in named if name not in cost]
    values = _by_seed([row for row in rows if row["pause"] >= 1], measured)
    spent = [k for k in named if k in cost]
    zero = {k: 0.0 for k in spent if not k.startswith("peak_mb")}
    seeds: dict[Any, dict[Any, dict[Any, None]]] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        seeds[row["family"], row["arm"]][row["scene"]][row["seed"]] = None
    several = {of_arm for of_arm, scenes in seeds.items() if any(len(found) > 1 for found in scenes.values())}
    filling = {(*of_arm, scene): next(iter(found)) for of_arm in several for scene, found in seeds[of_arm].items()}
    warm = [{**zero, **row} for row in rows if filling.get((row["family"], row["arm"], row["scene"])) != row["seed"]]
    values.update(_by_seed(warm, spent))
    for endpoint, slope_name in SLOPES.items():
        if endpoint in measured:
            slopes = _by_seed(rows, [endpoint], slope)
            values.update({(family, arm, slope_name): found for (family, arm, _), found in slopes.items()})
            measured.insert(1 + measured.index(endpoint), slope_name)
    names = tuple([*measured, *(k for k in named if k in cost)])
    metrics = tuple(
        ArmMetric(family, arm, name, _means(found, found))
        for family in families
        for arm in arms
        for name in names
        if (found := values.get((family, arm, name)))
    )
    # The endpoints and own metrics first, then the slopes; all other comparisons are exploratory.
    compared = (*ENDPOINTS, *own)
    first = [*compared, *SLOPES.values()]
    order = [name for name in first if name in measured] + [name for name in measured if name not in first]
    differences = [
        Compared(family, arm, reference, name, compare(*pair), arm in reported_only, name in compared)
        for name in order
        for family in families
        for of_reference in [values.get((family, reference, name), {})]
        for arm in arms
        if arm != reference and (of_arm := values.get((family, arm, name), {}))
        # A failed run has no values. Its seed is left out of the scene in both arms.
        for pair in [(_means(of_arm, of_reference), _means(of_reference, of_arm))]
    ]
    warm_only = set(seeds) == several
    return Summary(families, arms, names, reference, warm_only, metrics, _adjust(differences), compared)


def _adjust(differences: Sequence[Compared]) -> tuple[Compared, ...]:
    """Adjust the p values of all comparisons together, except those that are not part of the conclusions."""
    p = holm([one.difference.p if one.adjusted else float("nan") for one in differences])
    return tuple(
        replace(one, difference=replace(one.difference, p_holm=float(q)))
        for one, q in zip(differences, p, strict=True)
    )


_Values = dict[tuple[str, str, str], dict[str, dict[Any, float]]]


def _means(scenes: Mapping[str, Mapping[Any, float]], of: Mapping[str, Mapping[Any, float]]) -> dict[str, float]:
    """Mapping scene -> mean over the seeds that the same scene has in `of`."""
    common = {scene: [found[k] for k in found if k in of.get(scene, {})] for scene, found in scenes.items()}
    return {scene: float(np.mean(values)) for scene, values in common.items() if values}


def _by_seed(
    rows: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    of_run: Callable[[np.ndarray, np.ndarray], float] = lambda pauses, values: float(np.mean(values)),
) -> _Values:
    """Mapping (family, arm, metric) -> scene -> seed -> ``of_run(pauses, values)``, without NaN."""
    runs: dict[tuple[str, str, str, str, Any], list[tuple[int, float]]] = defaultdict(list)
    for row in rows:
        for name in names:
            value = row.get(name)
            if value is not None and np.isfinite(value):
                run = row["family"], row["arm"], name, row["scene"], row["seed"]
                runs[run].append((row["pause"], value))
    values: _Values = defaultdict(lambda: defaultdict(dict))
    for (family, arm, name, scene, seed), points in runs.items():
        found = of_run(*np.array(points, dtype=np.float64).T)
        if np.isfinite(found):
            values[family, arm, name][scene][seed] = found
    return dict(values)
