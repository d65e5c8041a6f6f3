"""Scenes in three dimensions: pages that any browser opens, and files for the viewer rerun.

>>> run_page("runs/demo").save("run.html")             # one file: time line, image, voxels, weights, genealogy, truth
>>> recording_page(recording).save("recording.html")   # images and truth, or the surface that the camera sees
>>> save_rerun(RunFolder.open("runs/demo"), "run.rrd") # the same for rerun (extra `viewer`)

`Hypothesis.show`, the report of a run and ``mstfilter view`` use the same page. A page loads nothing from a network.
"""

from __future__ import annotations

import html
import json
import os
import subprocess
import sys
import uuid
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.errors import InputError, missing_library
from mstfilter.files import atomic_path, check_output, write_text
from mstfilter.report.pictures import colour, data_uri, hexadecimal, jpeg_bytes
from mstfilter.report.scenes import ShownHypothesis, ShownPause, scenes_of_recording, scenes_of_run
from mstfilter.runs import RunFolder
from mstfilter.scene import Camera, Hypothesis, Recording, occupied_box, project


@dataclass(frozen=True)
class ScenePage:
    """A page with scenes that can be rotated. A notebook shows the page in place."""

    text: str  #: HTML, self-contained
    title: str

    def __repr__(self) -> str:
        return f"ScenePage {self.title!r}: .save('scene.html') writes it"

    def _repr_html_(self) -> str:
        return self.frame(460)

    def frame(self, height: int) -> str:
        """The page as a frame of another page, `height` pixels high, whose script cannot access the other page."""
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


def run_page(run: RunFolder | str | Path, *, photos: bool = True, head: bool = True) -> ScenePage:
    """All pauses of a run as a page; without `photos` only voxels, without `head` no title."""
    run = (run if isinstance(run, RunFolder) else RunFolder.open(run)).check()
    description = run.description
    title = str(description["recording"]["name"])
    return _page(scenes_of_run(run), title, str(description["description"]), photos=photos, head=head)


def recording_page(recording: Recording) -> ScenePage:
    """The pauses of a recording as a page: image and truth, or the surface that the camera sees."""
    counts = {"frame": len(recording), "pause": len(recording.pauses)}
    note = ", ".join(f"{n} {name}{'s' * (n != 1)}" for name, n in counts.items())
    return _page(scenes_of_recording(recording), recording.name, note)


def _page(
    scenes: Sequence[ShownPause], title: str, note: str = "", *, photos: bool = True, head: bool = True
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
        "head": head,
        "pauses": [_scene_data(scene, photos) for scene in scenes],
    }
    template = (files("mstfilter.report") / "templates" / "viewer.html").read_text(encoding="utf-8")
    text = json.dumps(data).replace("<", "\\u003c")
    for name, value in (("title", html.escape(title)), ("note", html.escape(note)), ("data", text)):
        template = template.replace(f"{{{{ {name} }}}}", value)
    return ScenePage(template, title)


def _scene_data(scene: ShownPause, photos: bool) -> dict[str, Any]:
    """A pause for the script of the page. Labels are runs (label, length) of the occupied box, with 16 bits each."""
    views = []
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
                        "text": "" if view.colours else f"{view.identity.get(label, label) + 1}: {n} voxels",
                    }
                    for label, n in sorted(volumes.items(), key=lambda pair: view.identity.get(pair[0], pair[0]))
                ],
            }
        )
    photo = data_uri(jpeg_bytes(scene.image), "jpeg") if photos and scene.image is not None else None
    name = f"{scene.name}, {scene.time:.1f} s" if scene.name else ""
    return {"name": name, "photo": photo, "views": views, "links": scene.links}


def encode_runs(labels: np.ndarray) -> np.ndarray:
    """Runs of equal labels in C order as rows (label, length), with 16 bits each. Long runs are split."""
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


def save_rerun(source: RunFolder | Recording, path: str | Path) -> Path:
    """Write a run or a recording as a rerun file (.rrd), with the arrangement of its views.

    Raises MissingLibraryError without the library rerun-sdk, and InputError if the file cannot be written.
    """
    rr = import_rerun()
    check_output(Path(path))
    scenes = scenes_of_run(source.check()) if isinstance(source, RunFolder) else scenes_of_recording(source)
    with atomic_path(path) as partial:
        name = source.description["recording"]["name"] if isinstance(source, RunFolder) else source.name
        with rr.RecordingStream(f"mstfilter {name}", recording_id=uuid.uuid4(), send_properties=False) as stream:
            stream.save(partial, default_blueprint=_blueprint(scenes))
            _log_scenes(stream, scenes)
            if isinstance(source, Recording):
                _log_frames(stream, source)
            stream.flush()
            stream.disconnect()
    return Path(path)


def show_rerun(path: str | Path) -> None:
    """Open a file in the viewer of rerun, and wait until its window is closed.

    The viewer listens only on 127.0.0.1, on a free port. The viewer's analytics are off. rerun sends none if the
    variable ``CI`` is set, which is set only for the viewer.
    """
    import_rerun()
    environment = {k: v for k, v in os.environ.items() if k != "FORCE_RERUN_ANALYTICS"} | {"CI": "1"}
    # -P: the module is not searched in the working folder, which may hold unknown files.
    command = [sys.executable, "-P", "-m", "rerun_cli", str(path), "--bind", "127.0.0.1", "--port", "auto"]
    done = subprocess.run(command, env=environment)
    if done.returncode:
        raise InputError(
            f"the viewer of rerun ended with exit code {done.returncode}",
            "it needs a display and a graphics driver; --html FILE writes a page that any browser opens",
        )


def import_rerun() -> Any:
    """The library rerun."""
    try:
        import rerun
        import rerun.blueprint  # noqa: F401
    except ImportError as error:
        hint = "--html FILE writes a page that any browser opens, without rerun"
        raise missing_library(error, "the viewer", hint, library="rerun-sdk") from error
    return rerun


def _entities(scene: ShownPause) -> dict[str, ShownHypothesis]:
    """Name of the entity of each view: hypotheses are numbered from heavy to light."""
    return {(view.name if view.weight is None else f"hypothesis_{v}"): view for v, view in enumerate(scene.views)}


def _log_scenes(stream: Any, scenes: Sequence[ShownPause]) -> None:
    """Images, labels in the image, voxels, weights and quality at the pauses, and the genealogy."""
    rr = import_rerun()
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    identities = {i for scene in scenes for view in scene.views for i in view.identity.values()}
    classes = [rr.AnnotationInfo(id=0, color=(0, 0, 0, 0))]  # free pixels are transparent
    classes += [rr.AnnotationInfo(id=i + 1, label=str(i + 1), color=colour(i)) for i in sorted(identities)]
    stream.log("world", rr.AnnotationContext(classes), static=True)
    names = dict.fromkeys(name for scene in scenes for name in _entities(scene))
    for t, scene in enumerate(scenes):
        stream.set_time("pause", sequence=t)
        stream.set_time("time", duration=scene.time)
        views, camera = _entities(scene), scene.camera
        if camera is not None and scene.image is not None:
            _log_camera(stream, camera)
            stream.log("world/camera/image", rr.Image(scene.image).compress(jpeg_quality=92))
        for name in names:
            if name not in views:
                stream.log(f"world/{name}", rr.Clear(recursive=True))
                stream.log(f"world/camera/image/{name}", rr.Clear(recursive=True))
                continue
            view = views[name]
            labels, grid = view.hypothesis.labels, view.hypothesis.grid
            voxels = np.argwhere((labels > 0) & ~_enclosed(labels))
            of_voxel = labels[tuple(voxels.T)]
            colours = {k: view.colour(k) for k in view.hypothesis.volumes()}
            boxes = rr.Boxes3D(
                centers=grid.centre_of(voxels),
                half_sizes=np.full((len(voxels), 3), grid.voxel_size / 2),
                colors=np.array([colours[k] for k in of_voxel.tolist()], np.uint8).reshape(-1, 3),
                fill_mode="solid",
            )
            stream.log(f"world/{name}", boxes)
            if camera is not None and view.identity:
                table = np.zeros(int(labels.max(initial=0)) + 1, np.uint16)
                for label, identity in view.identity.items():
                    table[label] = identity + 1
                seen = rr.SegmentationImage(table[project(view.hypothesis, camera)], opacity=0.6)
                stream.log(f"world/camera/image/{name}", seen)
            for what in ("weight", "quality"):
                value = getattr(view, what)
                if value is not None:
                    stream.log(f"{what}/{name}", rr.Scalars(value))
    nodes = [(t, v, view) for t, scene in enumerate(scenes) for v, view in enumerate(scene.views) if view.weight]
    graph = rr.GraphNodes(
        [f"{t}/{v}" for t, v, _ in nodes],
        positions=np.array([(160 * t, 60 * v) for t, v, _ in nodes], float).reshape(-1, 2),
        labels=[f"{t}: {view.name}" for t, _, view in nodes],
        radii=[4 + 16 * np.sqrt(view.weight or 0) for _, _, view in nodes],
    )
    edges = [(f"{t - 1}/{a}", f"{t}/{b}") for t, scene in enumerate(scenes) for a, b in scene.links]
    stream.log("genealogy", graph, rr.GraphEdges(edges, graph_type="directed"), static=True)


def _log_camera(stream: Any, camera: Camera) -> None:
    rr = import_rerun()
    pose = rr.Transform3D(translation=camera.position, mat3x3=camera.pose.rotation.as_matrix())
    lens = rr.Pinhole(image_from_camera=camera.K, resolution=[camera.width, camera.height])
    stream.log("world/camera", pose)
    stream.log("world/camera/image", lens)


def _log_frames(stream: Any, recording: Recording) -> None:
    """Colour and depth of all frames."""
    rr = import_rerun()
    stream.reset_time()
    for time, frame in zip(recording.times, recording.frames, strict=True):
        stream.set_time("time", duration=time)
        _log_camera(stream, frame.camera)
        stream.log("world/camera/image", rr.Image(frame.rgb).compress(jpeg_quality=92))
        depth = rr.DepthImage(np.nan_to_num(frame.depth), meter=1.0)
        stream.log("world/camera/image/depth", depth)


def _enclosed(labels: np.ndarray) -> np.ndarray:
    """Voxels (X, Y, Z) bool whose six neighbours belong to the same object."""
    padded = np.pad(labels, 1)
    inside = np.ones(labels.shape, bool)
    for axis in range(3):
        for step in (-1, 1):
            inside &= np.roll(padded, step, axis)[1:-1, 1:-1, 1:-1] == labels
    return inside


def _blueprint(scenes: Sequence[ShownPause]) -> Any:
    """The image with the heaviest hypothesis, a view of each hypothesis, weights, and genealogy."""
    rrb = import_rerun().blueprint
    names = list(dict.fromkeys(name for scene in scenes for name in _entities(scene)))
    first, image = names[0], "world/camera/image"
    boxes = [
        rrb.Spatial3DView(origin="world", contents=["world/camera", f"world/{name}"], name=name) for name in names
    ]
    photo = rrb.Spatial2DView(origin=image, contents=[image, f"{image}/{first}"], name=f"image, {first}")
    rows = [rrb.Horizontal(photo, rrb.Grid(*boxes), column_shares=[2, 3])]
    if any(view.weight is not None for scene in scenes for view in scene.views):
        series = [rrb.TimeSeriesView(origin=what, name=what) for what in ("weight", "quality")]
        rows.append(rrb.Horizontal(*series, rrb.GraphView(origin="genealogy", name="genealogy")))
    return rrb.Blueprint(rrb.Vertical(*rows, row_shares=[3, 1][: len(rows)]), collapse_panels=True)
