"""The report of a study: one self-contained HTML file.

>>> write_study_report("studies/first")                     # studies/first/report.html

The report is made from the study folder alone, of a finished or an unfinished study, and runs no code of the user.
Conclusions are sentences that claim no more than the intervals show.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mstfilter.report.figures import differences_figure, figure_groups, time_figure
from mstfilter.report.page import fill_template, flatten, seconds_text, short_text, write_page
from mstfilter.statistics import CLAIM
from mstfilter.study import ENDPOINT, SLOPE, StudyFolder, Summary

# Columns of the table of results: name in the study, heading.
_FIGURES = (
    (ENDPOINT, "quality"),
    (SLOPE, "slope a pause"),
    ("quality_top", "heaviest"),
    ("quality_best", "best of n"),
    ("quality_visible", "visible objects"),
    ("quality_hidden", "hidden, seen before"),
    ("quality_unseen", "never seen"),
    ("occupancy", "occupancy IoU"),
    ("object_f", "object F"),
    ("split", "split"),
    ("merged", "merged"),
    ("missed", "missed"),
    ("invented", "invented"),
    ("diversity", "diversity"),
    ("brier", "Brier"),
    ("quality_authors", "authors' form"),
    ("quality_paper", "paper's form"),
    ("quality_one_blob", "baseline: one blob"),
    ("quality_components", "baseline: components"),
)


def write_study_report(study: StudyFolder | str | Path, out: str | Path | None = None) -> Path:
    """Write the report of a study folder, finished or not, as HTML. Default: ``report.html`` in the study folder.

    Returns the file. Raises InputError if the folder is no study folder, or the file cannot be written.
    """
    study = StudyFolder.open(study.path if isinstance(study, StudyFolder) else study)
    path = study.path / "report.html" if out is None else Path(out)
    return write_page(path, _page(study))


def _page(study: StudyFolder) -> str:
    filters = dict(seconds=seconds_text, number=_number, signed=lambda x: _number(x, "+"), range=_range)
    records, summary, failures = study.records(), study.summary(), study.failures()
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
        compared=[one for one in summary.compared() if one.difference.n],
        columns=[(name, heading) for name, heading in _FIGURES if name in summary.names],
        figures=_drawn(records, summary, study.reported_only),
        costs=_costs(summary),
        arms=_arms(study.description),
        truth_users=study.truth_users,
        failures=failures,
    )


def _number(value: float | None, sign: str = "") -> str:
    """Three digits; a dash for an unknown value."""
    return "–" if value is None or value != value else f"{value:{sign}.3f}"


def _range(ends: tuple[float, float], sign: str = "") -> str:
    """An interval; a dash for an unknown one."""
    return "–" if ends[0] != ends[0] else f"{ends[0]:{sign}.3f} to {ends[1]:{sign}.3f}"


def _drawn(records: Sequence[Mapping[str, Any]], summary: Summary, reported_only: Sequence[str]) -> dict[str, Any]:
    """Inline SVG by name."""
    from markupsafe import Markup

    values: dict[str, dict[str, dict[int, list[float]]]] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in records:
        if row.get("qualities"):
            values[row["family"]][row["arm"]][row["pause"]].extend(row["qualities"])
    found: dict[str, Any] = {}
    arms = [arm for arm in summary.arms if arm not in reported_only]
    if values:
        groups = figure_groups(arms, summary.reference)
        found["time"] = [Markup(time_figure(values, group)) for group in groups]
    ends = [summary.reference, *(arm for arm in summary.arms if arm in reported_only)]
    if values and len(ends) > 1:
        groups = figure_groups(ends, summary.reference)
        found["ends"] = [Markup(time_figure(values, group)) for group in groups]
    compared = [one for one in summary.compared() if one.difference.n]
    if compared:
        found["differences"] = Markup(differences_figure(compared, summary.arms))
    return found


def _costs(summary: Summary) -> dict[str, Any]:
    """Seconds, core seconds and memory by stage, family and arm; means over pauses."""
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
    held = [s for s in stages if f"peak_mb_{s}" in summary.names]
    return {"stages": stages, "rows": rows, "most": most or 1.0, "held": held}


def _arms(description: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Each arm and the fields in which its configuration differs from the reference."""
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
