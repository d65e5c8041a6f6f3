"""HTML pages with three-dimensional scenes, for any browser.

>>> run_page("runs/demo").save("run.html")             # one file: time line, image, voxels, weights, genealogy, truth
>>> recording_page(recording).save("recording.html")   # images and truth, or the surface that the camera sees

`Hypothesis.show`, the report of a run and ``mstfilter view`` use these pages. A page loads nothing from a network.
"""

from __future__ import annotations

import html
import json
import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.app.report.answer import TABLE_HEADS, Answer, answers_of_run, mesh_link, table_cells
from mstfilter.app.report.pictures import data_uri, hexadecimal, jpeg_bytes
from mstfilter.app.report.scenes import ShownHypothesis, ShownPause, scenes_of_recording, scenes_of_run
from mstfilter.base.files import check_output, write_text
from mstfilter.runs import RunFolder
from mstfilter.scene import Hypothesis, Recording, occupied_box


@dataclass(frozen=True)
class ScenePage:
    """A page with scenes that can be rotated. A notebook shows the page below the cell."""

    text: str  #: HTML, self-contained
    title: str

    def __repr__(self) -> str:
        return f"ScenePage {self.title!r}: .save('scene.html') writes it"

    def _repr_html_(self) -> str:
        return self.frame(460)

    def frame(self, height: int) -> str:
        """The page as a frame of `height` pixels for another page. The frame cannot access the other page."""
        style = f'width="100%" height="{height}" style="border:0" sandbox="allow-scripts"'
        return f'<iframe title="{html.escape(self.title)}" srcdoc="{html.escape(self.text)}" {style}></iframe>'

    def save(self, path: str | Path) -> Path:
        """Write the page to a file, which any browser opens."""
        check_output(Path(path))
        write_text(path, self.text)
        return Path(path)


def show_hypothesis(hypothesis: Hypothesis, title: str = "") -> ScenePage:
    """The voxels of a hypothesis as a page: drag to rotate, click and scroll to zoom, click an object to hide it."""
    order = {record.label: k for k, record in enumerate(hypothesis.objects)}
    return _page(
        [ShownPause("", [ShownHypothesis("", "", hypothesis, order)])], title or f"{hypothesis.n_objects} objects"
    )


def run_page(
    run: RunFolder | str | Path,
    *,
    photos: bool = True,
    head: bool = True,
    scenes: Sequence[ShownPause] | None = None,
) -> ScenePage:
    """All pauses of a run as a page.

    `photos` adds the images to the voxels. `head` adds the title, what is known in words, the table of objects, and a
    mesh of them. `scenes` are those of `scenes_of_run`, if they were made before. Raises InputError if the folder is
    damaged or no pause is complete.
    """
    run = (run if isinstance(run, RunFolder) else RunFolder.open(run)).check_begun()
    description = run.description
    title = str(description["recording"]["name"])
    answers = answers_of_run(run) if head else []
    shown = scenes_of_run(run) if scenes is None else scenes
    return _page(shown, title, str(description["description"]), answers, photos=photos, head=head)


def recording_page(recording: Recording) -> ScenePage:
    """The pauses of a recording as a page: image and truth, or the surface that the camera sees."""
    counts = {"frame": len(recording), "pause": len(recording.pauses)}
    note = ", ".join(f"{n} {name}{'s' * (n != 1)}" for name, n in counts.items())
    return _page(scenes_of_recording(recording), recording.name, note)


def _page(
    scenes: Sequence[ShownPause],
    title: str,
    note: str = "",
    answers: Sequence[tuple[Answer, list[str]]] = (),
    *,
    photos: bool = True,
    head: bool = True,
) -> ScenePage:
    boxes = [box for scene in scenes for v in scene.views if (box := occupied_box(v.hypothesis.labels > 0))]
    grid = scenes[0].views[0].hypothesis.grid
    ends = np.array([[(s.start, s.stop) for s in box] for box in boxes] or [[(0, n) for n in grid.shape]])
    low, high = ends[..., 0].min(axis=0), ends[..., 1].max(axis=0)
    camera = scenes[0].camera
    away = np.array([0.6, -0.8]) if camera is None else camera.position[:2] - grid.centre_of((low + high) / 2)[:2]
    data = {
        "voxel": grid.voxel_size,
        "floor": -float(grid.origin[2]) / grid.voxel_size,
        "low": low.tolist(),
        "high": high.tolist(),
        "yaw": round(float(np.arctan2(away[0], -away[1])) - np.radians(35 if camera is not None else 0), 3),
        "camera": None if camera is None else ((camera.position - grid.origin) / grid.voxel_size).round(1).tolist(),
        "head": head,
        "pauses": [_scene_data(scene, photos) for scene in scenes],
        "columns": list(TABLE_HEADS.values()),
        "said": [_said(answer, happened, title) for answer, happened in answers],
    }
    template = (files("mstfilter.app.report") / "templates" / "viewer.html").read_text(encoding="utf-8")
    text = json.dumps(data).replace("<", "\\u003c")
    values = {"title": html.escape(title), "note": html.escape(note), "data": text}
    return ScenePage(re.sub(r"\{\{ (title|note|data) \}\}", lambda found: values[found[1]], template), title)


def _scene_data(scene: ShownPause, photos: bool) -> dict[str, Any]:
    """Data of a pause for the script of the page. The labels in the occupied box are encoded by `encode_runs`."""
    views = []
    voxel = scene.views[0].hypothesis.grid.voxel_size ** 3
    for view in scene.views:
        hypothesis = view.hypothesis
        box = occupied_box(hypothesis.labels > 0) or (slice(0, 0),) * 3
        inside, overlay = hypothesis.labels[box], None
        volumes = hypothesis.volumes()
        if photos and scene.image is not None and scene.camera is not None and not view.colours:
            overlay = view.overlay(scene.camera, 1, max(1, scene.camera.width // 340))
        views.append(
            {
                "name": view.name,
                "text": view.text,
                "weight": view.weight,
                "overlay": overlay,
                "low": [s.start for s in box],
                "shape": inside.shape,
                "runs": b64encode(encode_runs(inside).tobytes()).decode(),
                "objects": [
                    {
                        "label": label,
                        "id": view.identity.get(label, label),
                        "colour": hexadecimal(view.colour(label)),
                        "text": ""
                        if view.colours
                        else f"{view.identity.get(label, label) + 1}: {1e6 * n * voxel:.0f} cm³",
                    }
                    for label, n in sorted(volumes.items(), key=lambda pair: view.identity.get(pair[0], pair[0]))
                ],
            }
        )
    photo = data_uri(jpeg_bytes(scene.image), "jpeg") if photos and scene.image is not None else None
    name = f"{scene.name}, {scene.time:.1f} s" if scene.name else ""
    return {"name": name, "photo": photo, "views": views, "links": scene.links}


def _said(answer: Answer, happened: Sequence[str], title: str) -> dict[str, Any]:
    """What is known at a pause, in words, and the rows of the table of objects, for the script of the page."""
    rows = table_cells(answer.table)
    return {
        "text": " ".join([*happened, *answer.sentences]),
        "rows": [[row["colour"], *(row[name] for name in TABLE_HEADS)] for row in rows],
        "mesh": mesh_link(answer.table),
        "file": f"{title}.glb",
    }


def encode_runs(labels: np.ndarray) -> np.ndarray:
    """Run-length encoding of labels in C order: rows (label, length) of 16-bit numbers. Long runs are split."""
    flat = labels.ravel()
    if not len(flat):
        return np.zeros((0, 2), "<u2")
    starts = np.flatnonzero(np.concatenate([[True], flat[1:] != flat[:-1]]))
    lengths, most = np.diff(starts, append=len(flat)), np.iinfo(np.uint16).max
    pieces = -(-lengths // most)
    last = np.cumsum(pieces) - 1
    rows = np.repeat(np.column_stack([flat[starts], np.full(len(starts), most)]), pieces, axis=0)
    rows[last, 1] = lengths - most * (pieces - 1)
    return rows.astype("<u2")
