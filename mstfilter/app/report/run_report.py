"""The report of a run: one self-contained HTML file.

>>> write_report("runs/demo")                     # runs/demo/report.html
>>> write_report("runs/demo", "demo.html")

The report is made from the folder of a finished or an interrupted run, and loads no user code. Pictures are embedded,
figures are inline SVG, and there are no links. The only script rotates the three-dimensional view, in a frame that
cannot access the rest of the page. A repeated run gives an identical file, except for the times of steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.app.report.answer import TABLE_HEADS, Answer, answers_of_run, mesh_link, table_cells, widest
from mstfilter.app.report.figures import quality_figure, reliability_figure
from mstfilter.app.report.page import fill_template, flatten, note_rows, seconds_text, short_text, write_page
from mstfilter.app.report.pictures import (
    border_colour,
    close_up,
    colour,
    data_uri,
    hexadecimal,
    jpeg_bytes,
    viewpoint,
)
from mstfilter.app.report.run_numbers import SLOT_TITLES, RunNumbers, read_numbers
from mstfilter.app.report.scenes import ShownHypothesis, ShownPause, scenes_of_run
from mstfilter.app.report.viewer import run_page
from mstfilter.runs import RunFolder
from mstfilter.scene import Camera, Hypothesis, project
from mstfilter.scoring import forecast_table


def write_report(
    run: RunFolder | str | Path, out: str | Path | None = None, numbers: RunNumbers | None = None
) -> Path:
    """Write the report of a run, finished or not, as HTML, by default to ``report.html`` in the run folder.

    `numbers` is the result of `read_numbers`, if it was computed before. Returns the path of the file. Raises
    InputError if the folder is not a run folder, or the file cannot be written.
    """
    from markupsafe import Markup

    run = RunFolder.open(run.path if isinstance(run, RunFolder) else run).check()
    numbers = read_numbers(run) if numbers is None else numbers
    filters: dict[str, Callable[..., Any]] = {
        "short_text": short_text,
        "seconds": seconds_text,
        "percent": lambda x: f"{100 * x:.3g} %",
    }
    scenes = scenes_of_run(run) if numbers.steps else []
    page = fill_template(
        "report.html",
        filters,
        run=numbers,
        pauses=_pauses(run, numbers, scenes),
        columns=TABLE_HEADS,
        figures=_figures(numbers),
        rotatable=Markup(run_page(run, photos=False, head=False, scenes=scenes).frame(640)) if numbers.steps else "",
        parts=[_part(numbers, slot) for slot in numbers.slots],
        config=flatten(numbers.description["config"]),
    )
    return write_page(run.path / "report.html" if out is None else Path(out), page)


def _pauses(run: RunFolder, numbers: RunNumbers, scenes: Sequence[ShownPause]) -> list[dict[str, Any]]:
    """The answer, the image and the hypotheses of each pause, for the template."""
    found = answers_of_run(run)
    volumes = [view.hypothesis for scene in scenes for view in scene.views]
    view = viewpoint(volumes, run.camera(0)) if scenes else None
    pauses: list[dict[str, Any]] = []
    for t, (step, scene, (answer, happened)) in enumerate(zip(numbers.steps, scenes, found, strict=True)):
        assert scene.camera is not None and view is not None
        content = scene_content(scene, volumes, view)
        shown = {"answer": _answer(answer, mesh=t == len(found) - 1), "box": answer.box, "changes": happened}
        pauses.append({"t": t, "step": step, **shown, **content})
    return pauses


def _answer(answer: Answer, mesh: bool) -> dict[str, Any]:
    """The picture, the words and the table of the objects, for the template; with `mesh`, their mesh."""
    return {
        "sentences": answer.sentences,
        "outlines": [(one, hexadecimal(colour(one.number - 1))) for one in answer.outlines],
        "borders": [(one, hexadecimal(border_colour(one.one_object))) for one in answer.borders],
        "push": answer.push,
        "rows": table_cells(answer.table),
        "mesh": mesh_link(answer.table) if mesh else "",
    }


def scene_content(scene: ShownPause, volumes: Sequence[Hypothesis], view: Camera) -> dict[str, Any]:
    """Image and hypotheses of a pause, for the template. The close-up shows all `volumes`, `view` is a viewpoint."""
    assert scene.camera is not None and scene.image is not None
    n = sum(len(one.members) for one in scene.views)
    cards = [_card(one, scene.camera, view, n) for one in scene.views]
    return {
        "photo": data_uri(jpeg_bytes(scene.image), "jpeg"),
        "width": scene.camera.width,
        "height": scene.camera.height,
        "close_up": close_up(volumes, scene.camera),
        "cards": [card for card in cards if card["weight"] is not None],
        "hidden": scene.hidden,
        "further": [card for card in cards if card["weight"] is None],
    }


def _card(one: ShownHypothesis, camera: Camera, view: Camera, n: int) -> dict[str, Any]:
    """Pictures and numbers of a group of identical hypotheses, or of the ground truth, for the template."""
    # Small images are enlarged, so that contours are about as fine as on large ones.
    scale = max(1, round(960 / camera.width))
    return {
        "name": one.name.capitalize() if one.weight is None else f"{len(one.members)} of {n}",
        "weight": one.weight,
        "n_objects": one.hypothesis.n_objects,
        "voxels_occupied": sum(one.volumes.values()),
        "quality": one.quality,
        "overlay": one.overlay(camera, scale, max(2, round(scale * camera.width / 340))),
        "voxels": one.voxels(view),
        "tags": _place_tags(project(one.hypothesis, camera), one.identity),
    }


def _place_tags(image: np.ndarray, identity: Mapping[int, int]) -> list[dict[str, Any]]:
    """Number and position (at the widest part) of each object that is large enough in the image, largest first."""
    from scipy.ndimage import find_objects

    min_radius, min_distance = 0.009 * image.shape[1], 0.03 * image.shape[1]
    places = []
    for label, box in enumerate(find_objects(image.astype(np.int32)), 1):
        if box is None or label not in identity:
            continue
        radius, (x, y) = widest(image[box] == label)
        places.append((radius, label, x + box[1].start, y + box[0].start))
    tags: list[dict[str, Any]] = []
    for radius, label, x, y in sorted(places, reverse=True):
        apart = all(np.hypot(tag["x"] - x, tag["y"] - y) > min_distance for tag in tags)
        if radius >= min_radius and apart:
            tags.append({"text": str(identity[label] + 1), "x": x, "y": y})
    return tags


def _figures(numbers: RunNumbers) -> dict[str, Any]:
    """Inline SVG of each figure, by name."""
    from markupsafe import Markup

    steps = numbers.steps
    found = {}
    known = numbers.with_truth
    if known:
        at = [steps[t] for t in known]
        compared, baselines = (_columns([getattr(step, name) for step in at]) for name in ("compared", "baselines"))
        qualities, weights = [step.quality for step in at if step.quality], [step.weights for step in at]
        found["quality"] = Markup(quality_figure(known, qualities, weights, compared, baselines))
    beliefs = [step.belief.counts[0].astype(np.int64) for step in steps if step.belief is not None]
    if beliefs:
        found["reliability"] = Markup(reliability_figure({"all pauses": forecast_table(sum(beliefs))}))
    return found


def _columns(rows: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """Lists of the values of all rows, by name; NaN if a row lacks the name."""
    return {name: [row.get(name, np.nan) for row in rows] for name in dict.fromkeys(n for row in rows for n in row)}


def _part(numbers: RunNumbers, slot: str) -> dict[str, Any]:
    """Extra values and times of the component in a slot, over all pauses."""
    return {
        "slot": slot,
        "title": SLOT_TITLES.get(slot, slot),
        "component": numbers.component(slot),
        "rows": note_rows([step.notes(slot) for step in numbers.steps]),
        "seconds": [step.seconds.get(slot, 0.0) for step in numbers.steps],
    }
