"""The folder of a study and its tables.

>>> folder = StudyFolder.open("studies/first")
>>> folder.description["reference"], len(folder.rows())

The page "Studies" of the documentation lists the files.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, model_validator

from mstfilter.base.errors import InputError
from mstfilter.base.files import write_csv, write_text
from mstfilter.base.reading import read_arrays, read_model
from mstfilter.runs import write_json
from mstfilter.runs.study.summary import ArmMetric, Summary, interval_text, number_text, summarise, title_of
from mstfilter.scoring import LOG_LOSS, NO_COUNTS, forecast_table, leave_one_out
from mstfilter.scoring.forecasts import ForecastTable
from mstfilter.scoring.statistics import compare

STUDY_FORMAT = 2
RESULT = "result.json"  # in a run's folder
FORECASTS = "forecasts.npz"  # in a run's folder: counts of its forecasts at each pause
_SUMMARY_COLUMNS = ("family", "arm", "metric", "n", "mean", "low", "high")
_DIFFERENCE_COLUMNS = (
    "family",
    "arm",
    "reference",
    "metric",
    "n",
    "mean",
    "low",
    "high",
    "p",
    "p_holm",
    "conclusion",
)
_FAILURE_COLUMNS = ("run", "error", "hints", "tries", "folder")


#: Plain values, which a worker reads as JSON: what one run needs (see `mstfilter.runs.study.study`).
Job = Mapping[str, Any]


@dataclass(frozen=True)
class JobOutcome:
    """Outcome of a job."""

    status: str  #: {"done", "failed"}
    error: str = ""  #: what went wrong, in one line
    hints: tuple[str, ...] = ()  #: what the user can do about it
    trace: str = ""  #: traceback of the error
    tries: int = 1  #: how many times the job was started


class _Row(BaseModel, extra="allow"):
    pause: int
    qualities: list[float | None] | None = None
    __pydantic_extra__: dict[str, float | None]


class _Cost(BaseModel, extra="allow"):
    seconds: float
    core_seconds: float
    peak_mb: float | None
    __pydantic_extra__: dict[str, float | None]


class _Result(BaseModel):
    """The fields of result.json that readers use. A failed run has a result without rows."""

    status: str
    identity: str
    rows: list[_Row] = []
    costs: list[_Cost] = []
    own_metrics: dict[str, list[dict[str, float | None]]] = {}  # own metrics: key -> values by name at each pause
    error: str = ""
    hints: list[str] = []
    trace: str = ""
    tries: int = 1

    @model_validator(mode="after")
    def _agree(self) -> _Result:
        lengths = {len(self.rows), len(self.costs), *map(len, self.own_metrics.values())}
        if len(lengths) > 1 or (self.status == "done" and not self.rows):
            raise ValueError(
                f"there are {len(self.rows)} rows and {len(self.costs)} costs, or other numbers of metrics"
            )
        return self


class _Arm(BaseModel):
    name: str
    reported_only: bool
    uses_truth: list[str]
    config: dict[str, Any]


class _Scene(BaseModel):
    name: str
    group: str
    source: dict[str, Any]


class _StudyRun(BaseModel):
    name: str
    folder: Annotated[str, Field(pattern=r"^[^/\\\x00-\x1f]+$")]  # a name in the folder of the study
    identity: str
    arm: str
    scene: str
    group: str
    seed: int


class _Study(BaseModel):
    """The fields of study.json that readers use."""

    format: int
    name: str
    description: str
    reference: str
    arms: list[_Arm]
    scenes: list[_Scene]
    seeds: list[int]
    runs: list[_StudyRun]
    metrics: dict[str, dict[str, Any]] = {}


def read_result(folder: Path) -> dict[str, Any]:
    """The content of result.json in a run's folder; empty if the file is missing or damaged."""
    try:
        return read_model(folder / RESULT, _Result, "a result")[1]
    except InputError:
        return {}


def write_result(folder: Path, result: Mapping[str, Any]) -> None:
    """Write result.json into a run's folder."""
    write_json(folder / RESULT, result)


def write_failure(folder: Path, identity: str, outcome: JobOutcome) -> None:
    """Record the reason of a failed run, which may have rows without its own metrics. A full disk is no error."""
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        known = read_result(folder)
        kept = known if known.get("identity") == identity else {"identity": identity}
        write_result(folder, {**kept, **asdict(outcome)})


@dataclass(frozen=True)
class StudyFolder:
    """A study on disk."""

    path: Path

    @classmethod
    def open(cls, path: str | Path) -> StudyFolder:
        """Open an existing study folder."""
        folder = cls(Path(path))
        if folder.description.get("format") != STUDY_FORMAT:
            raise InputError(f"{path}: study has format {folder.description.get('format')}, expected {STUDY_FORMAT}")
        return folder

    @cached_property
    def description(self) -> dict[str, Any]:
        """The content of study.json."""
        return read_model(self.path / "study.json", _Study, "a study folder", "`mstfilter study` makes one")[1]

    @property
    def metrics(self) -> dict[str, dict[str, Any]]:
        """Own metrics of the study: key in result.json -> configuration."""
        return dict(self.description.get("metrics", {}))

    @property
    def own_columns(self) -> list[str]:
        """Names of the columns of own metrics."""
        values = (
            v for _, result in self._results() for k, v in result.get("own_metrics", {}).items() if k in self.metrics
        )
        return list(dict.fromkeys(name for rows in values for row in rows for name in row))

    @property
    def reported_only(self) -> list[str]:
        """Names of the arms that are not part of the comparisons."""
        return [arm["name"] for arm in self.description["arms"] if arm["reported_only"]]

    @property
    def truth_users(self) -> dict[str, list[str]]:
        """Mapping from arms to the classes of their components that use the ground truth."""
        return {arm["name"]: arm["uses_truth"] for arm in self.description["arms"] if arm["uses_truth"]}

    def run(self, folder: str) -> Path:
        """Path of the folder of a run, from the name of the folder."""
        return self.path / "runs" / folder

    def _results(self) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
        """The runs of this study that have ended, and their results."""
        for run in self.description["runs"]:
            result = read_result(self.run(run["folder"]))
            if result.get("identity") == run["identity"]:
                yield run, result

    def failures(self) -> list[dict[str, Any]]:
        """Runs of this study that failed, or whose own metrics failed: name, error, hints, tries, folder, trace."""
        names = ("error", "hints", "tries", "trace")
        found = [one for one in self._results() if one[1]["status"] == "failed"]
        return [{**run, **{k: result.get(k) for k in names}} for run, result in found]

    def records(self) -> list[dict[str, Any]]:
        """The rows of `rows`, with additional lists such as ``qualities``, which has one value per hypothesis."""
        rows = []
        for run, result in self._results():
            named = {"family": run["group"], "scene": run["scene"], "arm": run["arm"], "seed": run["seed"]}
            own = [values for key, values in result.get("own_metrics", {}).items() if key in self.metrics]
            for parts in zip(result.get("rows", ()), *own, result.get("costs", ()), strict=True):
                rows.append({k: v for part in (named, *parts) for k, v in part.items()})
        self._add_log_loss(rows)
        return rows

    def _add_log_loss(self, rows: Sequence[dict[str, Any]]) -> None:
        """Add the recalibrated log loss to rows, in place.

        The forecasts of a scene are recalibrated on the other scenes of its family and arm. Runs of the same scene
        with other seeds are not used.
        """
        groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
        for row in rows:
            groups[row["family"], row["arm"]].append(row)
        for of_arm, own in groups.items():
            counts = self._counts(*of_arm)
            fits = leave_one_out(_sum_by_scene(counts))
            for row in own:
                scene, of_run = row["scene"], counts.get((row["scene"], row["seed"]))
                if scene in fits and of_run is not None:
                    row[LOG_LOSS] = fits[scene].log_loss(of_run[row["pause"]])

    def _counts(self, family: str, arm: str) -> dict[tuple[str, Any], np.ndarray]:
        """Mapping (scene, seed) -> counts (T, r, 1001, 2) by pause, rate of noise, forecast and outcome."""
        found = {}
        for run in self.description["runs"]:
            path = self.run(run["folder"]) / FORECASTS
            if (run["group"], run["arm"]) == (family, arm) and path.is_file():
                counts = read_arrays(path, "forecasts").get("counts", NO_COUNTS[None, None, :0])
                if counts.ndim != 4 or counts.shape[2:] != NO_COUNTS.shape or counts.dtype.kind not in "iu":
                    raise InputError(
                        f"{path}: counts has shape {counts.shape}", "repeat the study: it makes it again"
                    )
                found[run["scene"], run["seed"]] = counts
        return found

    def forecasts(self, family: str, arm: str) -> ForecastTable:
        """Forecasts of an arm for a family at pauses t >= 1, pooled over scenes and seeds, without recalibration."""
        counts = sum(
            (one[1:, 0].sum(axis=0, dtype=np.int64) for one in self._counts(family, arm).values()), NO_COUNTS
        )
        return forecast_table(counts)

    def rows(self) -> list[dict[str, Any]]:
        """One row per pause and finished run, in the order of the study: metrics, time and memory."""
        return _without_lists(self.records())

    def summary(self, records: Sequence[Mapping[str, Any]] | None = None) -> Summary:
        """Means of the arms and differences from the reference. By default, `records` are read from the folder."""
        rows = _without_lists(self.records() if records is None else records)
        return summarise(
            rows, self.description["reference"], cost_columns(rows), self.reported_only, self.own_columns
        )

    def write_tables(self) -> None:
        """Write all tables from the results of the runs."""
        records = self.records()
        rows = _without_lists(records)
        costs = cost_columns(rows)
        columns = [*(c for c in _columns(rows) if c not in costs), *costs]
        found = self.summary(records)
        failed = [{"run": f["name"], **f, "hints": "; ".join(f["hints"] or ())} for f in self.failures()]
        for name, table, names in (
            ("runs", rows, columns),
            ("summary", found.metric_rows(), _SUMMARY_COLUMNS),
            ("differences", found.difference_rows(), _DIFFERENCE_COLUMNS),
            ("failures", failed, _FAILURE_COLUMNS),
        ):
            write_csv(self.path / f"{name}.csv", table, names, float_format=".6g")
        for name, (caption, cells) in self.main_tables(found).items():
            write_text(self.path / f"{name}.tex", latex_table(cells, caption, f"tab:{name}"))
            write_text(self.path / f"{name}.md", f"{caption}\n\n{markdown_table(cells)}")

    def main_tables(self, found: Summary | None = None) -> dict[str, tuple[str, list[list[str]]]]:
        """Caption and cells (first row: head) of the tables "summary" and "differences"."""
        found = found or self.summary()
        titles = [
            f"{title_of(name).partition(' (')[0]}{' (nats)' * (name == LOG_LOSS)}" for name in found.compared_first
        ]
        means = [["family", "method", "n", *titles, "time per step (s)"]]
        differences = [["family", "method", "n", *itertools.chain(*zip(titles, itertools.repeat("p")))]]
        pairs = {(one.family, one.arm, one.metric): one.difference for one in found.differences}
        for family, arm in itertools.product(found.families, found.arms):
            start = [family, f"{arm} *" if arm in self.truth_users else arm]
            names = found.compared_first
            values = [found.metric(family, arm, name) or ArmMetric(family, arm, name, {}) for name in names]
            if n := _numbers(len(one.by_scene) for one in values):
                seconds = found.metric(family, arm, "seconds")
                texts = [_estimate(one.mean, *one.interval) for one in values]
                means.append([*start, n, *texts, "–" if seconds is None else f"{seconds.mean:.2f}"])
            of_arm = [pairs.get((family, arm, name), compare({}, {})) for name in names]
            if n := _numbers(d.n for d in of_arm):
                p = [number_text(d.p_holm).replace("0.000", "<0.001") for d in of_arm]
                texts = [_estimate(d.mean, d.low, d.high, "+") for d in of_arm]
                differences.append([*start, n, *itertools.chain(*zip(texts, p, strict=True))])
        how = "over pauses (without the first), filter seeds and n scenes, with 95 % bootstrap intervals (BCa). "
        how += "Quality is from 0 to 1 (higher is better). Log loss is recalibrated (lower is better)."
        how += " * uses the ground truth." if self.truth_users else ""
        time = "with a warm cache" if found.warm else "and shared work counts for the first method that needs it"
        pair = f"{found.reference} (method minus {found.reference}), paired by scene: means"
        p_text = "p is of sign flips, adjusted by Holm's method for all comparisons of this table."
        return {
            "summary": (f"Means {how} Time is wall time, {time}.", means),
            "differences": (f"Differences from {pair} {how} {p_text}", differences),
        }


def _numbers(of_endpoints: Iterable[int]) -> str:
    """Numbers of scenes as text, one number if they are equal."""
    return " / ".join(dict.fromkeys(str(n) for n in of_endpoints if n))


def _estimate(mean: float, low: float, high: float, sign: str = "") -> str:
    return f"{number_text(mean, sign)} {interval_text(low, high, sign)}".replace(" –", "")


_TEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--"}
_TEX |= {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}


def _tex(text: str) -> str:
    """Text for LaTeX, with signs of numbers in math mode."""
    escaped = "".join(_TEX.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in text)
    return re.sub(r"(?<![\w.])[-+](?=\d+\.\d)", r"$\g<0>$", escaped).replace(r" \%", r"~\%")


def latex_table(cells: Sequence[Sequence[str]], caption: str, label: str) -> str:
    """A table for LaTeX with the package booktabs. The first row of `cells` is the head."""
    head, *rows = [" & ".join(map(_tex, row)) + r" \\" for row in cells]
    lines = [r"% \usepackage{booktabs}", r"\begin{table}", r"\centering\footnotesize\setlength{\tabcolsep}{4pt}"]
    lines += [rf"\caption{{{_tex(caption)}}}", rf"\label{{{label}}}"]
    lines += [rf"\begin{{tabular}}{{ll{'r' * (len(cells[0]) - 2)}}}", r"\toprule", head]
    return "\n".join([*lines, r"\midrule", *rows, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def markdown_table(cells: Sequence[Sequence[str]]) -> str:
    """A table for Markdown. The first row of `cells` is the head."""
    head, *rows = [[re.sub(r"[\\`*_<>|]", r"\\\g<0>", cell) for cell in row] for row in cells]
    rule = ["---"] * 2 + ["---:"] * (len(head) - 2)
    return "".join(f"| {' | '.join(row)} |\n" for row in (head, rule, *rows))


def _sum_by_scene(counts: Mapping[tuple[str, Any], np.ndarray]) -> dict[str, np.ndarray]:
    """Mapping from scenes to counts (r, 1001, 2) of forecasts, summed over seeds and pauses t >= 1."""
    found: dict[str, np.ndarray] = {}
    for (scene, _), one in counts.items():
        found[scene] = found.get(scene, 0) + one[1:].sum(axis=0, dtype=np.int64)
    return found


def _without_lists(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if not isinstance(v, list)} for row in records]


def cost_columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Columns of time and memory. All other columns are identical if the same study is run again."""
    return [c for c in _columns(rows) if c == "core_seconds" or c.startswith(("seconds", "peak_mb"))]


def _columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))
