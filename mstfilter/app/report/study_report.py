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

from mstfilter.app.report.figures import differences_figure, figure_groups, reliability_figure, time_figure
from mstfilter.app.report.identities import match_runs
from mstfilter.app.report.page import fill_template, flatten, seconds_text, short_text, write_page
from mstfilter.app.report.pictures import viewpoint
from mstfilter.app.report.run_report import scene_content
from mstfilter.app.report.scenes import scene_of_run
from mstfilter.runs import RunFolder
from mstfilter.runs.study import ENDPOINTS, StudyFolder, Summary, interval_text, number_text, title_of
from mstfilter.scoring.statistics import CLAIM

_MOST_ROWS, _MOST_PICTURES = 3, 4  # pauses with large differences: of each arm and endpoint, with pictures


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
    names = summary.compared_first
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
        own=[(name, title_of(name)) for name in study.own_columns],
        compared=[one for name in names for one in summary.compared(name) if one.difference.n],
        values={(one.family, one.arm, one.name): one.by_scene for one in summary.metrics if one.name in names},
        extremes=(extremes := _extremes(study, records, summary)),
        pictures=_pictures(study, extremes),
        figures=_drawn(records, summary, study.reported_only),
        reliability=_reliability(study, summary),
        stages=[name for name in summary.names if name.startswith("seconds_")],
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
    values = {
        (name, row["arm"], row["scene"], row["pause"], row["seed"]): row[name]
        for row in records
        for name in ENDPOINTS
        if row["pause"] >= 1 and row.get(name) is not None
    }
    pairs: dict[Any, list[tuple[float, ...]]] = defaultdict(list)
    for (name, arm, *place, seed), value in values.items():
        ours = values.get((name, summary.reference, *place, seed))
        if ours is not None and arm not in (summary.reference, *study.reported_only):
            pairs[arm, name, *place].append((value - ours, value, ours, seed))
    found: dict[Any, list[dict[str, Any]]] = defaultdict(list)
    for (arm, name, scene, pause), of in pairs.items():
        means = zip(("difference", "value", "reference"), np.mean(of, axis=0).tolist(), strict=False)
        seed = max(of, key=lambda one: abs(one[0]))[-1]
        found[arm, name].append(
            {"arm": arm, "metric": name, "scene": scene, "pause": pause, "seed": seed, **dict(means)}
        )
    largest = [sorted(rows, key=lambda row: -abs(row["difference"]))[:_MOST_ROWS] for rows in found.values()]
    return [{**row, "rank": rank} for rows in largest for rank, row in enumerate(rows)]


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
        view = viewpoint(volumes, scenes[0].camera, 480, 360)
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
    for name in summary.compared_first:
        values = _over_time(records, name)
        for section, arms in (("time", compared), ("ends", ends)):
            if values and (section == "time" or len(ends) > 1):
                for group in figure_groups(arms, summary.reference):
                    drawn[section].append(Markup(time_figure(values, group, title_of(name), summary.arms)))
        differences = [(one.family, one.arm, one.difference) for one in summary.compared(name) if one.difference.n]
        if differences:
            side = {1: "left", -1: "right"}.get(ENDPOINTS.get(name, 0), "")
            figure = differences_figure(differences, summary.arms, summary.reference, title_of(name), side)
            drawn["differences"].append(Markup(figure))
    return dict(drawn)


def _over_time(records: Sequence[Mapping[str, Any]], endpoint: str) -> dict[str, Any]:
    """Mapping family -> arm -> pause -> values. Values are qualities of all hypotheses, or one value for each run."""
    values: dict[str, Any] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in records:
        of_row = row.get("qualities") if endpoint == "quality" else [row.get(endpoint)]
        if known := [value for value in of_row or () if value is not None]:
            values[row["family"]][row["arm"]][row["pause"]] += known
    return values


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
