"""The report of a study: one self-contained HTML file.

>>> write_study_report("studies/first")                     # studies/first/report.html

The report is made from the folder of a finished or an unfinished study, and loads no user code. Conclusions are
sentences that state no more than the intervals show.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.report.figures import differences_figure, figure_groups, reliability_figure, time_figure
from mstfilter.report.identities import match_runs
from mstfilter.report.page import fill_template, flatten, seconds_text, short_text, write_page
from mstfilter.report.pictures import viewpoint
from mstfilter.report.run_report import scene_content
from mstfilter.report.scenes import scene_of_run
from mstfilter.runs import RunFolder
from mstfilter.scoring import LOG_LOSS
from mstfilter.statistics import CLAIM
from mstfilter.study import ENDPOINTS, SLOPES, StudyFolder, Summary, interval_text, number_text, title_of

_MOST_ROWS, _MOST_PICTURES = 3, 4  # pauses with large differences: of each arm and endpoint, with pictures

# Columns of the tables of results: name in the study, heading.
_TABLES = {
    "Quality": (
        ("quality", "quality"),
        (SLOPES["quality"], "slope"),
        ("quality_top", "most probable"),
        ("quality_best", "best of n"),
        ("quality_estimate", "estimate"),
        ("quality_visible", "visible objects"),
        ("quality_hidden", "hidden, seen before"),
        ("quality_unseen", "never seen"),
        ("quality_one_blob", "baseline: one blob"),
        ("quality_components", "baseline: components"),
    ),
    "Log loss": (
        (LOG_LOSS, "recalibrated"),
        (SLOPES[LOG_LOSS], "slope"),
        ("log_loss", "as it comes"),
        ("calibration_error", "calibration error"),
        ("brier", "Brier"),
        ("diversity", "diversity"),
    ),
    "Objects and volume": (
        ("object_f", "object F"),
        ("split", "split"),
        ("merged", "merged"),
        ("missed", "missed"),
        ("invented", "invented"),
        ("occupancy", "occupancy IoU"),
        ("volume_missed", "missed volume"),
        ("volume_invented", "invented volume"),
        ("quality_authors", "quality, authors' form"),
        ("quality_paper", "quality, paper's form"),
    ),
}


def write_study_report(study: StudyFolder | str | Path, out: str | Path | None = None) -> Path:
    """Write the report of a study folder, finished or not, as HTML.

    The default path is ``report.html`` in the study folder.

    Returns the file path. Raises InputError if the folder is not a study folder, or the file cannot be written.
    """
    study = StudyFolder.open(study.path if isinstance(study, StudyFolder) else study)
    path = study.path / "report.html" if out is None else Path(out)
    return write_page(path, _page(study))


def _page(study: StudyFolder) -> str:
    filters: dict[str, Callable[..., str]] = {
        "metric_title": title_of,
        "seconds": seconds_text,
        "number": number_text,
        "interval": interval_text,
    }
    records, failures = study.records(), study.failures()
    summary = study.summary(records)
    scenes: dict[str, list[str]] = defaultdict(list)
    for scene in study.description["scenes"]:
        scenes[scene["group"]].append(scene["name"])
    return fill_template(
        "study.html",
        filters,
        study=study.description,
        n_done=len({(r["scene"], r["arm"], r["seed"]) for r in records}),
        summary=summary,
        simulated=any("family" in scene["source"] for scene in study.description["scenes"]),
        scenes=scenes,
        claim=CLAIM,
        endpoints=ENDPOINTS,
        compared=[one for name in ENDPOINTS for one in summary.compared(name) if one.difference.n],
        better=[
            f"{summary.reference} is better than {arm} on {family}."
            for family in summary.families
            for arm in summary.arms
            if summary.is_better(family, arm)
        ],
        values={(one.family, one.arm, one.name): one.by_scene for one in summary.metrics if one.name in ENDPOINTS},
        extremes=(extremes := _extremes(study, records, summary)),
        pictures=_pictures(study, extremes),
        tables={
            title: chosen
            for title, columns in _TABLES.items()
            if (chosen := [(name, heading) for name, heading in columns if name in summary.names])
        },
        figures=_drawn(records, summary, study.reported_only),
        reliability=_reliability(study, summary),
        costs=_costs(summary),
        arms=_arms(study.description),
        truth_users=study.truth_users,
        failures=failures,
    )


def _reliability(study: StudyFolder, summary: Summary) -> list[Any]:
    """Reliability diagrams of each family, for all arms that are part of the comparisons."""
    from markupsafe import Markup

    figures = []
    arms = [arm for arm in summary.arms if arm not in study.reported_only]
    for family in summary.families:
        tables = {arm: table for arm in arms if (table := study.forecasts(family, arm)).n}
        figures += [
            (family, Markup(reliability_figure({arm: tables[arm] for arm in group}, summary.arms)))
            for group in figure_groups(list(tables), summary.reference)
            if group
        ]
    return figures


def _extremes(study: StudyFolder, records: Sequence[Mapping[str, Any]], summary: Summary) -> list[dict[str, Any]]:
    """The pauses at which the mean over seeds of an endpoint differs most between an arm and the reference."""
    values: dict[Any, dict[Any, float]] = defaultdict(dict)
    for row in records:
        for name in ENDPOINTS:
            if row["pause"] >= 1 and row.get(name) is not None:
                values[row["arm"], name][row["scene"], row["pause"], row["seed"]] = row[name]
    found: list[dict[str, Any]] = []
    for arm in summary.arms:
        for name in ENDPOINTS if arm != summary.reference and arm not in study.reported_only else ():
            theirs, ours = values[arm, name], values[summary.reference, name]
            pairs: dict[Any, list[tuple[float, float, int]]] = defaultdict(list)
            for scene, pause, seed in [place for place in theirs if place in ours]:
                pairs[scene, pause].append((theirs[scene, pause, seed], ours[scene, pause, seed], seed))
            rows = []
            for (scene, pause), of in pairs.items():
                value, reference, _ = np.mean(of, axis=0).tolist()
                _, seed = max((abs(a - b), -seed) for a, b, seed in of)
                place = {"metric": name, "arm": arm, "scene": scene, "pause": pause, "seed": -seed}
                rows.append({**place, "value": value, "reference": reference, "difference": value - reference})
            rows.sort(key=lambda row: -abs(row["difference"]))
            found += [{**row, "rank": rank} for rank, row in enumerate(rows[:_MOST_ROWS])]
    return found


def _pictures(study: StudyFolder, extremes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Hypotheses of both arms at a few of the `extremes` whose runs have been kept, the largest of each arm first."""
    folders = {(r["arm"], r["scene"], r["seed"]): study.run(r["folder"]) for r in study.description["runs"]}
    found: dict[Any, dict[str, Any]] = {}
    for row in sorted(extremes, key=lambda row: row["rank"]):
        t, arms = row["pause"], (study.description["reference"], row["arm"])
        key = row["arm"], row["scene"], t
        runs = [RunFolder(folders[arm, row["scene"], row["seed"]]) for arm in arms]
        if len(found) == _MOST_PICTURES or key in found or not all(run.pause(t).is_dir() for run in runs):
            continue
        scenes = [scene_of_run(*one, 3) for one in zip(runs, (t, t), match_runs(runs, t), strict=True)]
        volumes = [one.hypothesis for scene in scenes for one in scene.views]
        view = viewpoint(volumes, scenes[0].camera)
        both = [scene_content(scene, volumes, view) for scene in scenes]
        found[key] = {**row, **both[0], "t": len(found), "arms": list(zip(arms, both, strict=True))}
    return list(found.values())


def _drawn(
    records: Sequence[Mapping[str, Any]], summary: Summary, reported_only: Sequence[str]
) -> dict[str, list[Any]]:
    """Inline SVG figures by section of the page."""
    from markupsafe import Markup

    drawn: dict[str, list[Any]] = defaultdict(list)
    compared = [arm for arm in summary.arms if arm not in reported_only]
    ends = [summary.reference, *(arm for arm in summary.arms if arm in reported_only)]
    for name, sign in ENDPOINTS.items():
        values = _over_time(records, name)
        for section, arms in (("time", compared), ("ends", ends)):
            if values and (section == "time" or len(ends) > 1):
                for group in figure_groups(arms, summary.reference):
                    drawn[section].append(Markup(time_figure(values, group, title_of(name), summary.arms)))
        differences = [(one.family, one.arm, one.difference) for one in summary.compared(name) if one.difference.n]
        if differences:
            side = "left" if sign > 0 else "right"
            figure = differences_figure(differences, summary.arms, summary.reference, title_of(name), side)
            drawn["differences"].append(Markup(figure))
    return dict(drawn)


def _over_time(records: Sequence[Mapping[str, Any]], endpoint: str) -> dict[str, Any]:
    """Mapping family -> arm -> pause -> values. Values are qualities of all hypotheses, or one value for each run."""
    values: dict[str, Any] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in records:
        of_row = row.get("qualities") if endpoint == "quality" else [row.get(endpoint)]
        if of_row and of_row[0] is not None:
            values[row["family"]][row["arm"]][row["pause"]] += of_row
    return values


def _costs(summary: Summary) -> dict[str, Any]:
    """Seconds of each stage, core seconds and memory, by family and arm, as means over pauses."""
    stages = [n.removeprefix("seconds_") for n in summary.names if n.startswith("seconds_")]
    rows: list[dict[str, Any]] = []
    per = ("seconds_", "peak_mb")
    for family in summary.families:
        for arm in summary.arms:
            cells = {
                name: metric.mean
                for name in ("seconds", "core_seconds", *(n for n in summary.names if n.startswith(per)))
                if (metric := summary.metric(family, arm, name)) is not None
            }
            if cells:
                rows.append({"family": family, "arm": arm, **cells})
    most = max((sum(float(r.get(f"seconds_{s}", 0.0)) for s in stages) for r in rows), default=1.0)
    return {"stages": stages, "rows": rows, "most": most or 1.0}


def _arms(description: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Each arm, with the fields in which its configuration differs from that of the reference."""
    flat = {arm["name"]: flatten(arm["config"]) for arm in description["arms"]}
    base = flat[description["reference"]]
    found = []
    for name, config in flat.items():
        keys = [k for k in {**base, **config} if config.get(k) != base.get(k)]
        # For another component only its name is listed, not its fields.
        slots = [k.removesuffix("component") for k in keys if k.endswith("component")]
        listed = [k for k in keys if k.endswith("component") or not k.startswith(tuple(slots))]
        found.append((name, [(k.removesuffix(".component"), short_text(config.get(k))) for k in listed]))
    return found
