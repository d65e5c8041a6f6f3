"""The report of a run: one HTML file that needs nothing beside it.

>>> write_report("runs/demo")                     # runs/demo/report.html
>>> write_report("runs/demo", "demo.html")

It is made from the run folder alone, of a run that is done or was interrupted, wherever the folder has been moved,
and loads no code of the user: components are known by what they recorded. Pictures are embedded, figures are inline
SVG, there is no script and no link. Times of the steps aside, the same run gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mstfilter.report.cards import cards_of_pause, close_up, data_uri, truth_card
from mstfilter.report.content import Numbers, different, numbers_of, seconds_text
from mstfilter.report.figures import genealogy_figure, health_figure, quality_figure
from mstfilter.report.identities import identity_colours
from mstfilter.report.page import render, write_page
from mstfilter.report.pictures import jpeg_bytes, viewpoint
from mstfilter.report.tables import counts, flatten, note_rows, shown
from mstfilter.study import RunFolder

__all__ = ["write_report"]

_TITLES = {
    "initial": "Initial particles",
    "transition": "Transition",
    "proposal": "Proposal",
    "update": "Update",
    "resampler": "Resampling",
    "build": "Building the chosen",
}


def write_report(run: RunFolder | str | Path, out: str | Path | None = None) -> Path:
    """Write the report of a run folder.

    Parameters
    ----------
    run : RunFolder or path
        The run, finished or not.
    out : path, optional
        The HTML file. Default: ``report.html`` in the run folder.

    Returns
    -------
    Path
        The file, written under a temporary name and renamed.

    Raises
    ------
    InputError
        The folder is no run folder, or the file cannot be written.
    """
    run = RunFolder.open(run.path if isinstance(run, RunFolder) else run)
    path = run.path / "report.html" if out is None else Path(out)
    return write_page(path, _page(run))


def _page(run: RunFolder) -> str:
    filters: dict[str, Callable[..., Any]] = dict(
        different=different, shown=shown, seconds=seconds_text, percent=lambda x: f"{100 * x:.3g} %"
    )
    numbers = numbers_of(run)
    return render(
        "report.html",
        filters,
        run=numbers,
        pauses=_pauses(run, numbers),
        figures=_figures(numbers),
        parts=[_part(numbers, slot) for slot in numbers.slots],
        config=_config(numbers.description.get("config") or {}),
        facts=_facts(numbers.description),
    )


def _pauses(run: RunFolder, numbers: Numbers) -> list[dict[str, Any]]:
    """Pictures of all pauses."""
    if not numbers.steps:
        return []
    identities = identity_colours(run)
    volumes: list[tuple[Any, Any]] = []
    for t in range(len(numbers.steps)):
        hypotheses, truth = run.hypotheses(t), run.truth(t)
        volumes.extend((h.labels, h.grid) for h in hypotheses)
        if truth is not None:
            volumes.append((truth, hypotheses[0].grid))
    view = viewpoint(volumes, run.camera(0))
    pauses = []
    for t, step in enumerate(numbers.steps):
        camera = run.camera(t)
        cards, hidden = cards_of_pause(run, t, identities, view)
        pauses.append(
            {
                "t": t,
                "step": step,
                "photo": data_uri(jpeg_bytes(run.rgb(t)), "jpeg"),
                "width": camera.width,
                "height": camera.height,
                "close_up": close_up(volumes, camera),
                "cards": cards,
                "hidden": hidden,
                "truth": truth_card(run, t, identities, view),
            }
        )
    return pauses


def _figures(numbers: Numbers) -> dict[str, Any]:
    """Inline SVG by name."""
    from markupsafe import Markup

    steps = numbers.steps
    if not steps:
        return {}
    found = {}
    known = numbers.with_truth
    if known:
        floors = {name: [steps[t].floors[name] for t in known] for name in steps[known[0]].floors or ()}  # type: ignore[index]
        qualities = [steps[t].quality["objects"] for t in known]  # type: ignore[index]
        found["quality"] = quality_figure(known, qualities, [steps[t].weights for t in known], floors)
    if len(steps) == 1:  # the tiles say it all
        return {name: Markup(svg) for name, svg in found.items()}
    found["health"] = health_figure(
        range(len(steps)),
        [(step.info["ess"], step.info["n_candidates"]) for step in steps],
        [None if t == 0 else (step.info["unique_ancestors"], step.info["n"]) for t, step in enumerate(steps)],
    )
    found["genealogy"] = genealogy_figure(
        [step.weights for step in steps],
        [step.parents("previous") for step in steps],
        [step.parents("proposed") for step in steps],
    )
    return {name: Markup(svg) for name, svg in found.items()}


def _part(numbers: Numbers, slot: str) -> dict[str, Any]:
    """What a component did, over all pauses."""
    notes = [step.notes(slot) for step in numbers.steps]
    bars = []
    for key, table in counts(notes).items():
        names = sorted({name for row in table for name in row}, key=lambda n: (-sum(r.get(n, 0) for r in table), n))
        bars.append({"key": key, "names": names, "rows": table})
    barred = {bar["key"] for bar in bars}
    rest = [{k: v for k, v in note.items() if k not in barred} for note in notes]
    return {
        "slot": slot,
        "title": _TITLES.get(slot, slot),
        "component": numbers.component(slot),
        "bars": bars,
        "rows": note_rows(rest),
        "seconds": [step.seconds.get(slot, 0.0) for step in numbers.steps],
    }


def _config(config: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Configuration as ``path = value``, grouped by slot, plain values of the filter first."""
    plain = [(k, shown(v)) for k, v in config.items() if not isinstance(v, Mapping)]
    groups = [("filter", plain)] if plain else []
    for slot, part in config.items():
        if isinstance(part, Mapping):
            rows = [(k.removesuffix(".component"), shown(v)) for k, v in flatten(part, slot).items()]
            groups.append((_TITLES.get(slot, slot), rows))
    return groups


def _facts(description: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What was run, for the end of the page."""
    recording = description.get("recording") or {}
    facts = [
        ("preset", str(description.get("description") or "–")),
        ("seed", shown(description.get("seed"))),
        ("status", str(description.get("status", "–"))),
        ("recording", str(recording.get("name", "–"))),
        ("recording key", str(recording.get("key", "–"))),
        ("generator", shown(recording.get("generator"))),
    ]
    facts += [(name, str(version)) for name, version in (description.get("versions") or {}).items()]
    return [fact for fact in facts if fact[1] not in ("", "–")]
