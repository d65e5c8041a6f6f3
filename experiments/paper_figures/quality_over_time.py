"""Figure `quality_over_time`: both endpoints over pauses, by family and method, from a study folder.

`quality_over_time` is the figure of the study report with the quality of all hypotheses, in light colours.
`recalibrated_log_loss_over_time` is the same figure of the log loss.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import mstfilter.app.report
from mstfilter.app.report import SERIES, colour, figure_groups, hexadecimal, time_figure
from mstfilter.base.errors import InputError
from mstfilter.runs.study import StudyFolder, title_of
from mstfilter.scoring import LOG_LOSS

PAGE = 'xmlns="http://www.w3.org/2000/svg" style="background:var(--paper);font-family:sans-serif"'


def make(out: Path, study: Path, chosen: Sequence[str] = ()) -> list[Path]:
    """Write the figures of the finished runs of the chosen arms; by default, of all that are not `reported_only`.

    More than twelve arms give several figures.
    """
    folder = StudyFolder.open(study)
    known = [arm["name"] for arm in folder.description["arms"]]
    if unknown := [name for name in chosen if name not in known]:
        raise InputError(f"the study has no arm {unknown[0]!r}", f"it has {', '.join(known)}")
    arms = list(chosen) or [name for name in known if name not in folder.reported_only]
    rows = [row for row in folder.records() if row["arm"] in arms]
    paths = []
    for measure in ("quality", LOG_LOSS):
        values: dict[str, dict[str, dict[int, list[float]]]] = {}
        scenes: dict[str, set[str]] = {}
        for row in rows:
            found = row.get("qualities") if measure == "quality" else row.get(LOG_LOSS)
            if found:
                by_pause = values.setdefault(row["family"], {}).setdefault(row["arm"], {})
                by_pause.setdefault(row["pause"], []).extend(found if measure == "quality" else [found])
                scenes.setdefault(row["family"], set()).add(row["scene"])
        if not values:
            continue
        out.mkdir(parents=True, exist_ok=True)
        titled = {f"{family}, n = {len(scenes[family])} scenes": of_arms for family, of_arms in values.items()}
        for k, group in enumerate(figure_groups(arms, folder.description["reference"])):
            paths.append(out / f"{measure}_over_time{f'_{k + 1}' if k else ''}.svg")
            paths[-1].write_text(standalone(time_figure(titled, group, title_of(measure))))
    return paths


def standalone(svg: str) -> str:
    """A figure of a report as a complete SVG file, with the colours of the report's style sheet."""
    css = (Path(mstfilter.app.report.__file__).parent / "templates" / "style.css").read_text()
    light = css[: css.index("}")]
    colours = {f"--s{k}": hexadecimal(colour(k)) for k in range(len(SERIES))}  # also for colours that the sheet lacks
    colours |= dict(re.findall(r"(--[a-z0-9]+): (#[0-9a-f]{3,6})", light))
    width, height = re.findall(r"[\d.]+", svg[svg.index("viewBox") :])[2:4]
    svg = re.sub(r' style="max-width:\d+px"', "", svg, count=1)
    svg = svg.replace("<svg ", f'<svg {PAGE} width="{width}pt" height="{height}pt" ', 1)
    svg = svg.replace("currentColor", "var(--ink)")
    return re.sub(r"var\((--[a-z0-9]+)\)", lambda found: colours[found[1]], svg)
