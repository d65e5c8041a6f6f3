"""Write the small tables of a study from the folder that `mstfilter study` wrote.

    python experiments/tables.py studies/NAME experiments/NAME/results [--reference "true masks: mst"] [--pooled]
    python experiments/tables.py studies/NAME-s1 experiments/NAME/rows --rows    # one family, see below
    python experiments/tables.py experiments/NAME/study.toml experiments/NAME/results [--pooled]

A long study can run family by family (`mstfilter study --family`), also on different machines. With --rows, all
scores of each run and pause are written to FAMILY.csv.xz. With the TOML file of a study, the tables are made from
these files of all families, in the folder `rows` beside the TOML file.

The names of the files start with the name of the study. NAME.csv has one row per family and arm, with means over
scenes and pauses t >= 1. NAME_scenes.csv has the primary endpoints of each scene. NAME_differences.csv has the arm
minus the reference in the primary endpoints: bootstrap interval, p value of sign flips, p after Holm over endpoints,
families and arms, and the conclusion (see `mstfilter.scoring.statistics`). The differences are also printed as tables
for the README, with a warning if an arm has fewer scenes than the reference. NAME_cases.csv has the quality
of visible, hidden and never seen objects, averaged over cases (one object at one pause t >= 1). NAME_time.csv has the
core seconds of steps t >= 1. They differ between the first filter seed, in which an arm may be the first to process a
recording, and later seeds, which find shared results in the memory of the worker. With --pooled,
NAME_pooled_differences.csv has the differences over the scenes of all families together, and
NAME_pooled_described.csv has these differences in further metrics. NAME_pooled_pauses.csv has the means by pause, and
the change from pause 1 to the last pause with its 95 % interval over scenes.
"""

from __future__ import annotations

import argparse
import csv
import lzma
import sys
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from mstfilter.base.files import write_csv
from mstfilter.runs.study import ENDPOINTS, StudyFolder, Summary, cost_columns, load_study, make_plan, summarise
from mstfilter.scoring.statistics import interval

Row = Mapping[str, Any]

DESCRIBED = ("quality_estimate", "log_loss", "calibration_error", "volume_missed", "volume_invented")

METRICS = (
    "quality",
    "quality_weighted",
    "quality_top",
    "quality_best",
    "quality_authors",
    "quality_slope",
    "quality_visible",
    "quality_hidden",
    "quality_unseen",
    "quality_one_blob",
    "quality_components",
    "occupancy",
    "object_f",
    "split",
    "merged",
    "missed",
    "invented",
    "diversity",
    "quality_estimate",
    "volume_missed",
    "volume_invented",
    "recalibrated_log_loss",
    "recalibrated_log_loss_slope",
    "brier",
    "log_loss",
    "calibration_error",
    "core_seconds",
    "peak_mb",
)


def by_scene(found: Summary) -> list[dict[str, str]]:
    """The primary endpoints, one row per scene and arm."""
    rows: dict[tuple[str, str, str], dict[str, str]] = {}
    for f in found.metrics:
        if f.name in ENDPOINTS:
            for scene, value in f.by_scene.items():
                row = rows.setdefault((f.family, scene, f.arm), {"family": f.family, "scene": scene, "arm": f.arm})
                row[f.name] = f"{value:.4f}"
    return list(rows.values())


def means(found: Summary) -> list[dict[str, str]]:
    """Means of all metrics, one row per family and arm."""
    lines = []
    for family, arm in product(found.families, found.arms):
        if endpoint := found.metric(family, arm):
            metrics = {name: found.metric(family, arm, name) for name in METRICS}
            row = {"family": family, "arm": arm, "n": str(len(endpoint.by_scene))}
            lines.append(row | {name: f"{f.mean:.4g}" if f else "" for name, f in metrics.items()})
    return lines


def differences(found: Summary, metrics: Iterable[str] = ENDPOINTS) -> list[dict[str, str]]:
    """Differences from the reference, one row per metric, family and compared arm."""
    lines = []
    for c in [c for name in metrics for c in found.compared(name)]:
        d = c.difference
        if not c.reported_only and d.n:
            row = {
                "endpoint": c.metric,
                "family": c.family,
                "arm": c.arm,
                "reference": c.reference,
                "n": str(d.n),
                "mean": f"{d.mean:.4f}",
            }
            row |= {"low": f"{d.low:.4f}", "high": f"{d.high:.4f}", "p": f"{d.p:.4g}", "p_holm": f"{d.p_holm:.4g}"}
            lines.append(row | {"conclusion": c.words if c.adjusted else ""})
    return lines


def by_pause(rows: Sequence[Row]) -> list[dict[str, str]]:
    """One row per metric and arm: means over scenes by pause t >= 1, and the change from the first to the last."""
    lines = []
    for metric, arm in product((*ENDPOINTS, *DESCRIBED), dict.fromkeys(row["arm"] for row in rows)):
        values: dict[tuple[str, str], dict[int, list[float]]] = {}
        for row in rows:
            if row["arm"] == arm and row["pause"] >= 1 and row.get(metric) is not None:
                scene = values.setdefault((row["family"], row["scene"]), {})
                scene.setdefault(row["pause"], []).append(row[metric])  # one for each filter seed
        pauses = sorted({t for scene in values.values() for t in scene})
        means = {t: [np.mean(scene[t]) for scene in values.values() if t in scene] for t in pauses}
        line = {"metric": metric, "arm": arm} | {f"pause_{t}": f"{np.mean(v):.4f}" for t, v in means.items()}
        whole = [scene for scene in values.values() if len(scene) == len(pauses) > 1]
        change = np.array([np.mean(scene[pauses[-1]]) - np.mean(scene[pauses[0]]) for scene in whole])
        if len(change):
            low, high = interval(change)
            line |= {"change": f"{change.mean():.4f}", "low": f"{low:.4f}", "high": f"{high:.4f}"}
        lines.append(line)
    return lines


def cases(rows: Sequence[Row]) -> list[dict[str, str]]:
    """One row per family and arm: number and mean quality of visible, hidden and never seen objects."""
    lines = []
    for (family, arm), mine in grouped(rows).items():
        line = {"family": family, "arm": arm}
        seeds = len({row["seed"] for row in mine})
        for kind in ("visible", "hidden", "unseen"):
            pairs = [(row[f"n_{kind}"], row[f"quality_{kind}"]) for row in mine if row.get(f"n_{kind}")]
            n = sum(count for count, _ in pairs)
            line[kind] = f"{n / seeds:g}"
            line[f"quality_{kind}"] = f"{sum(count * q for count, q in pairs) / n:.4f}" if n else ""
        lines.append(line)
    return lines


def times(rows: Sequence[Row]) -> list[dict[str, str]]:
    """One row per family and arm: mean and largest core seconds of a step, of the first and of later filter seeds."""
    lines = []
    for (family, arm), mine in grouped(rows).items():
        line = {"family": family, "arm": arm}
        first = min(row["seed"] for row in mine)
        for name in ("first", "later"):
            seconds = [row["core_seconds"] for row in mine if (row["seed"] == first) == (name == "first")]
            line[f"{name}_mean"] = f"{sum(seconds) / len(seconds):.2f}" if seconds else ""
            line[f"{name}_most"] = f"{max(seconds):.2f}" if seconds else ""
        lines.append(line)
    return lines


def grouped(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """Rows of pauses t >= 1 by family and arm."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row["pause"] >= 1:
            found.setdefault((row["family"], row["arm"]), []).append(row)
    return found


def markdown(rows: list[dict[str, str]]) -> str:
    """A markdown table of one endpoint: one row per arm, one column per family."""
    families, arms = (list(dict.fromkeys(r[key] for r in rows)) for key in ("family", "arm"))
    cell = {
        (r["family"], r["arm"]): f"{float(r['mean']):+.3f} [{float(r['low']):+.3f}, {float(r['high']):+.3f}]"
        for r in rows
    }
    head = ["| |", *(f" {f} |" for f in families), "\n|---|", *("---|" for _ in families), "\n"]
    body = ["| " + " | ".join([arm, *(cell.get((f, arm), "") for f in families)]) + " |\n" for arm in arms]
    return "".join(head + body)


class Source(NamedTuple):
    """What the tables are made from."""

    name: str
    reference: str
    arms: dict[str, bool]  #: name -> whether the arm is only reported
    rows: list[dict[str, Any]]  #: one for each pause of a run

    @classmethod
    def of(cls, study: Path) -> Self:
        """A study folder, or the TOML file of a study with rows beside it."""
        if study.suffix != ".toml":
            folder = StudyFolder.open(study)
            arms = {arm["name"]: arm["reported_only"] for arm in folder.description["arms"]}
            return cls(folder.description["name"], folder.description["reference"], arms, folder.rows())
        plan = make_plan(load_study(study))
        arms = {arm.name: arm.reported_only for arm in plan.arms}
        families = dict.fromkeys(scene.group for scene in plan.scenes)
        files = [study.parent / "rows" / f"{family}.csv.xz" for family in families]
        rows = [row for file in files for row in read_rows(file)]
        planned = {(run.scene.group, run.scene.name, run.arm.name, run.seed) for run in plan.runs}
        found = {(row["family"], row["scene"], row["arm"], row["seed"]) for row in rows}
        if found - planned:
            sys.exit(f"error: {study} has no run {min(found - planned)}\nhint: write the rows of its families again")
        if planned - found:
            print(f"warning: rows of {len(planned - found)} of {len(planned)} runs are missing", file=sys.stderr)
        return cls(plan.config.name, plan.reference, arms, rows)


def read_rows(file: Path) -> list[dict[str, Any]]:
    """The rows that `write_rows` wrote. Empty cells are None."""
    with lzma.open(file, "rt", encoding="utf-8", newline="") as table:
        return [{key: _value(key, text) for key, text in row.items()} for row in csv.DictReader(table)]


def _value(key: str, text: str) -> Any:
    if key in ("family", "scene", "arm"):
        return text
    return None if text == "" else int(text) if key in ("seed", "pause") else float(text)


def write_rows(rows: Sequence[Row], file: Path) -> None:
    """Write all scores of each run and pause."""
    file.parent.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with lzma.open(file, "wt", encoding="utf-8", newline="") as table:
        writer = csv.DictWriter(table, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main(study: Path, out: Path, reference: str, pooled: bool) -> None:
    """Read the study, write the tables, print the differences."""
    source = Source.of(study)
    name, rows, tables = source.name, source.rows, {}
    arms_reported_only = [arm for arm, reported_only in source.arms.items() if reported_only]
    if reference:
        of_truth = reference.startswith("true masks")
        others = [arm for arm in source.arms if arm.startswith("true masks") != of_truth]
        found = summarise(rows, reference, reported_only=others)
        name += f"_{reference.split(':')[0].replace(' ', '_')}"
    elif pooled:
        of_all = [{**row, "family": "all", "scene": f"{row['family']}/{row['scene']}"} for row in rows]
        found = summarise(of_all, source.reference, reported_only=arms_reported_only)
        name += "_pooled"
        tables = {f"{name}_described": differences(found, DESCRIBED), f"{name}_pauses": by_pause(rows)}
    else:
        found = summarise(rows, source.reference, cost_columns(rows), arms_reported_only)
        tables |= {name: means(found), f"{name}_scenes": by_scene(found)}
        tables |= {f"{name}_cases": cases(rows), f"{name}_time": times(rows)}
    tables[f"{name}_differences"] = differences(found)
    for c in found.compared("quality"):
        n, of_reference = c.difference.n, found.metric(c.family, c.reference)
        if of_reference and n < len(of_reference.by_scene):
            print(f"warning: {c.arm} on {c.family} has {n} of {len(of_reference.by_scene)} scenes", file=sys.stderr)
    for table, lines in tables.items():
        write_csv(out / f"{table}.csv", lines)
    for endpoint in ENDPOINTS:
        print(f"{endpoint}\n\n{markdown([r for r in tables[f'{name}_differences'] if r['endpoint'] == endpoint])}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, help="study folder, or TOML file")
    parser.add_argument("out", type=Path)
    parser.add_argument("--rows", action="store_true", help="write only all scores, one file for each family")
    parser.add_argument("--reference", default="", help="another arm than the study's own reference")
    parser.add_argument("--pooled", action="store_true", help="differences over the scenes of all families together")
    given = parser.parse_args()
    if given.pooled and given.reference:
        parser.error("--pooled and --reference do not go together")
    if given.rows:
        rows = Source.of(given.study).rows
        for family in dict.fromkeys(row["family"] for row in rows):
            write_rows([row for row in rows if row["family"] == family], given.out / f"{family}.csv.xz")
        parser.exit()
    main(given.study, given.out, given.reference, given.pooled)
