"""The folder of a study and its tables.

>>> folder = StudyFolder.open("studies/first")
>>> folder.description["reference"], len(folder.rows())

Layout::

    study.json       what was asked: description, arms with their configuration, scenes, seeds, every run's folder
    runs/NAME/       one `RunFolder` a run; result.json holds its figures, or why it failed
    runs.csv         one row a pause and run: figures first, time and memory last
    summary.csv      one row a family, arm and figure: mean over scenes and its interval
    differences.csv  the reference against every other arm: paired differences, intervals, p values, conclusions
    failures.csv     runs that failed, and why
    logs/            what workers printed
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError
from mstfilter.runs.run_folder import plain, write_json
from mstfilter.study.executors import JobOutcome
from mstfilter.study.summary import Summary, summarise

__all__ = ["RESULT", "StudyFolder", "cost_columns", "read_result", "write_table"]

STUDY_FORMAT = 1
RESULT = "result.json"  # in a run's folder
_FIGURES = ("family", "arm", "figure", "n", "mean", "low", "high")
_DIFFERENCES = (
    *("family", "first", "second", "figure", "n", "mean", "low", "high"),
    *("low_bootstrap", "high_bootstrap", "p", "p_holm", "conclusion"),
)


def read_result(folder: Path) -> dict[str, Any]:
    """What result.json of a run's folder says; empty where there is none that can be read."""
    try:
        return dict(json.loads((folder / RESULT).read_text()))
    except (OSError, ValueError):
        return {}


@dataclass(frozen=True)
class StudyFolder:
    """A study on disk.

    Parameters
    ----------
    path : Path
    """

    path: Path

    @classmethod
    def open(cls, path: str | Path) -> StudyFolder:
        """An existing study folder."""
        folder = cls(Path(path))
        if folder.description.get("format") != STUDY_FORMAT:
            raise InputError(f"{path}: study has format {folder.description.get('format')}, expected {STUDY_FORMAT}")
        return folder

    @cached_property
    def description(self) -> dict[str, Any]:
        """What study.json says."""
        try:
            return dict(json.loads((self.path / "study.json").read_text()))
        except FileNotFoundError:
            raise InputError(
                f"not a study folder: {self.path / 'study.json'} is missing", "`mstfilter study` makes one"
            ) from None
        except (OSError, ValueError) as error:
            raise InputError(f"{self.path / 'study.json'} cannot be read: {error}") from error

    @property
    def beside(self) -> list[str]:
        """Names of the arms that are no part of the comparisons: floors and ceilings."""
        return [arm["name"] for arm in self.description["arms"] if arm.get("beside")]

    def run(self, folder: str) -> Path:
        """A run's folder."""
        return self.path / "runs" / folder

    def fail(self, run: Mapping[str, Any], outcome: JobOutcome) -> None:
        """Write down why a run failed; the folder of an earlier failure is reused.

        Of a run that could only not be measured again, what was known of it before is kept beside.
        """
        folder = self.run(run["folder"])
        folder.mkdir(parents=True, exist_ok=True)
        before = read_result(folder)
        record = {"identity": run["identity"], "status": "failed", "error": outcome.error, "hints": outcome.hints}
        if before.get("identity") == run["identity"]:
            record |= {k: before[k] for k in ("metrics", "rows", "costs") if k in before}
        write_json(folder / RESULT, {**record, "tries": outcome.tries, "trace": outcome.trace})

    def failures(self) -> list[dict[str, Any]]:
        """Runs that failed: name, error, hints, tries, folder; those of this study as it is now."""
        found = []
        for run in self.description["runs"]:
            result = read_result(self.run(run["folder"]))
            if result.get("status") == "failed" and result.get("identity") == run["identity"]:
                found.append({**run, **{k: result.get(k) for k in ("error", "hints", "tries", "trace")}})
        return found

    def records(self) -> list[dict[str, Any]]:
        """As `rows`, with the lists that are no columns: ``qualities``, one a hypothesis."""
        rows = []
        for run in self.description["runs"]:
            result = read_result(self.run(run["folder"]))
            if result.get("status") != "done" or result.get("identity") != run["identity"]:
                continue
            named = {"family": run["group"], "scene": run["scene"], "arm": run["arm"], "seed": run["seed"]}
            for row, cost in zip(result["rows"], result["costs"], strict=True):
                rows.append({**named, **row, **cost})
        return rows

    def rows(self) -> list[dict[str, Any]]:
        """One row a pause and run of all runs that are done, in the order of the study: figures, time and memory."""
        return [{k: v for k, v in row.items() if not isinstance(v, list)} for row in self.records()]

    def summary(self) -> Summary:
        """What the runs that are done say together."""
        rows = self.rows()
        return summarise(rows, self.description["reference"], cost_columns(rows), self.beside)

    def write_tables(self) -> None:
        """Write all tables from the runs."""
        rows = self.rows()
        costs = cost_columns(rows)
        columns = [*(c for c in _columns(rows) if c not in costs), *costs]
        write_table(self.path / "runs.csv", columns, rows)
        found = self.summary()
        write_table(self.path / "summary.csv", _FIGURES, found.figure_rows())
        write_table(self.path / "differences.csv", _DIFFERENCES, found.difference_rows())
        failed = [{"run": f["name"], **f, "hints": "; ".join(f["hints"] or ())} for f in self.failures()]
        write_table(self.path / "failures.csv", ["run", "error", "hints", "tries", "folder"], failed)


def cost_columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Columns of time and memory: the only ones that may differ between two times of running the same study."""
    return [c for c in _columns(rows) if c == "core_seconds" or c.startswith(("seconds", "peak_mb"))]


def _columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV file under a temporary name and rename it; numbers with six digits, nothing for what is missing."""
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in rows:
            writer.writerow([_text(plain(row.get(c))) for c in columns])
    os.replace(partial, path)


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)
