"""The first picture of the README, and its animation: a simulated object is hidden by another and is seen again.

    python experiments/readme_picture/make.py    # writes docs/images/hidden.png and docs/images/hidden.webp
    python experiments/readme_picture/make.py --smoke --out FOLDER    # a small scene: shows only that it works

Columns are the pause before, a pause at which the object is hidden, and the pause at which it is seen again. Rows are
the image, the true voxels, and the voxels of hypotheses of `mst` and of the published method.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.app.report import TRUTH, Colour, assign_identities, colour, viewpoint, voxel_picture
from mstfilter.formats import open_recording
from mstfilter.lab.simulation import scene_family, simulate_recording
from mstfilter.runs import RunFolder, filter_recording
from mstfilter.runs.presets import load_config
from mstfilter.scene import Camera, Recording, VoxelGrid, look_at, render

FAMILY, SEED = "s3", 42
HIDDEN, SHOWN, VOXELS = 0.2, 0.5, 300  # largest visible share if hidden, least if seen, least volume
SMALL = {"width": 160, "height": 120, "n_actions": 2, "frames_per_clip": 8, "voxel_size": 0.02}
PICTURES = Path("docs/images")
METHODS = ("mst", "paper")
#: Method, whether the hypothesis with the largest overlap is shown instead of the most probable, name of the row.
ROWS = (
    ("mst", False, "mst,\nmost probable"),
    ("mst", True, "mst,\nbest of all"),
    ("paper", True, "published,\nbest of all"),
)
BEHIND = {"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 1.5}  # text on a picture
MARKED: Colour = (213, 60, 0)  # the colour of the object; the other objects are pale
REACH = 0.22  # metres around the object that the pictures of voxels show
CELL = (405, 264)  # pixels
Marked = tuple[np.ndarray, np.ndarray]  # a picture, and the mask of the object in it


def visible_shares(recording: Recording) -> dict[int, np.ndarray]:
    """Share of the silhouette of each object that is visible at each pause, for objects in all pauses."""
    shares: dict[int, list[float]] = {}
    for t, index in enumerate(recording.pauses):
        labels, instance = recording.truth(t), recording.instance(index)
        assert labels is not None and instance is not None
        for k in np.flatnonzero(np.bincount(labels.ravel()) >= VOXELS)[1:].tolist():
            whole = silhouette(labels, recording.grid, k, recording.frames[index].camera).sum()
            shares.setdefault(k, []).append(float((instance == k).sum() / max(whole, 1)))
    return {k: np.array(values) for k, values in shares.items() if len(values) == len(recording.pauses)}


def silhouette(labels: np.ndarray, grid: VoxelGrid, label: int, camera: Camera) -> np.ndarray:
    """Pixels of an object as if it were alone."""
    return render(np.where(labels == label, labels, 0), grid, camera).labels > 0


def find_hidden(recording: Recording) -> tuple[int, tuple[int, int, int]]:
    """Label of the first object that is seen, hidden and seen again, and the three pauses. Uses only the truth."""
    for k, share in visible_shares(recording).items():
        for t in np.flatnonzero(share <= HIDDEN).tolist():
            before, after = np.flatnonzero(share[:t] >= SHOWN), np.flatnonzero(share[t:] >= SHOWN)
            if len(before) and len(after):
                return k, (int(before[-1]), t, t + int(after[0]))
    raise SystemExit(f"{recording.name}: no object is seen, hidden and seen again")


class Scene:
    """A recording, its runs, and the object that is marked in all pictures."""

    def __init__(self, recording: Recording, runs: Mapping[str, RunFolder], label: int, pauses: tuple[int, ...]):
        self.recording, self.runs, self.label, self.pauses = recording, runs, label, pauses
        self.identities = {name: assign_identities(run) for name, run in runs.items()}
        self.near = []  # true voxels near the object at the pauses
        self.silhouettes = []  # of the object in the images of the pauses
        for t in pauses:
            labels = recording.truth(t)
            assert labels is not None
            camera = recording.frames[recording.pauses[t]].camera
            self.silhouettes.append(silhouette(labels, recording.grid, label, camera))
            points = recording.grid.centre_of(np.argwhere(labels > 0))
            own = recording.grid.centre_of(np.argwhere(labels == label)).mean(axis=0)
            near = np.zeros_like(labels)
            near[labels > 0] = np.where(
                np.linalg.norm((points - own)[:, :2], axis=1) < REACH / 2, labels[labels > 0], 0
            )
            self.near.append((near, recording.grid))
        # The azimuth from which most of the object is seen at the pause at which it is hidden in the image.
        turns = np.radians(np.arange(0, 360, 15))
        hidden = recording.truth(pauses[1])
        assert hidden is not None
        seen = [(render(hidden, recording.grid, self.view(turn)).labels == label).sum() for turn in turns]
        self.turn = float(turns[int(np.argmax(seen))])

    def view(self, turn: float) -> Camera:
        """A view of the voxels near the object, `turn` radians from the usual one."""
        camera = self.recording.frames[0].camera
        c, s = np.cos(turn), np.sin(turn)
        eye = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ camera.position
        return viewpoint(self.near, camera.at(look_at(eye, eye * 0)), *CELL)

    def overlaps(self, name: str, t: int) -> list[float]:
        """Overlap (intersection over union) of the marked object with the truth in each hypothesis; 0 if absent."""
        truth = self.recording.truth(t)
        assert truth is not None
        true, found = truth == self.label, []
        for k, h in enumerate(self.runs[name].hypotheses(t)):
            own = h.labels == self.label_in(name, t, k)
            found.append(float((own & true).sum() / (own | true).sum()))
        return found

    def label_in(self, name: str, t: int, k: int) -> int:
        """Label of the marked object in hypothesis `k` (or `TRUTH`); -1 if absent."""
        marked = self.identities[name].of(t, TRUTH)[self.label]
        return next((label for label, i in self.identities[name].of(t, k).items() if i == marked), -1)

    def voxels(self, name: str, t: int, k: int, view: Camera) -> Marked:
        """Picture of hypothesis `k` (or of the truth, `TRUTH`), and the silhouette of the marked object."""
        h, own = self.runs[name].hypotheses(t)[max(k, 0)], self.label_in(name, t, k)
        labels = self.recording.truth(t) if k == TRUTH else h.labels
        assert labels is not None
        colours = {x: MARKED if x == own else pale(colour(i)) for x, i in self.identities[name].of(t, k).items()}
        return voxel_picture(labels, h.grid, view, colours), silhouette(labels, h.grid, own, view)

    def most_probable(self, name: str, t: int) -> int:
        """The heaviest hypothesis; the first, if several have the same weight."""
        return int(np.argmax(self.runs[name].info(t)["weights"]))


def window(masks: Sequence[np.ndarray], margin: float) -> tuple[slice, slice]:
    """Rows and columns of the image around all masks (H, W) bool, with the proportions of a cell.

    The window is `margin` times as large as the masks need, but not larger than the image.
    """
    rows, columns = np.nonzero(np.any(masks, axis=0))
    cell, shape = np.array([CELL[1], CELL[0]]), np.array(masks[0].shape)
    spans = np.array([np.ptp(rows), np.ptp(columns)])
    size = (cell * min(margin * (spans / cell).max(), (shape / cell).min())).astype(int)
    low = np.clip((np.array([rows.mean(), columns.mean()]) - size / 2).astype(int), 0, shape - size)
    return slice(low[0], low[0] + size[0]), slice(low[1], low[1] + size[1])


def pale(rgb: Colour) -> Colour:
    """A colour, mixed with light grey."""
    r, g, b = (round(0.4 * c + 0.6 * 225) for c in rgb)
    return r, g, b


def show(axes: Any, picture: np.ndarray, mask: np.ndarray, line: str = "-") -> None:
    """Draw a picture with an outline around the object."""
    axes.imshow(picture, aspect="auto", interpolation="antialiased")
    if mask.any():
        padded = np.pad(mask, 1)
        at = [np.arange(-1, n + 1) for n in mask.shape]
        axes.contour(at[1], at[0], padded, [0.5], colors="white", linewidths=3.6)
        axes.contour(at[1], at[0], padded, [0.5], colors="black", linewidths=1.8, linestyles=line)
    axes.set(xticks=[], yticks=[], xlim=(-0.5, mask.shape[1] - 0.5), ylim=(mask.shape[0] - 0.5, -0.5))
    axes.spines[:].set_visible(False)


def new_figure(width: float, height: float, rows: int, columns: int) -> tuple[Any, np.ndarray]:
    """A figure without a display, and its axes (rows, columns)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
    return figure, figure.subplots(rows, columns, squeeze=False)


def draw(scene: Scene, out: Path) -> None:
    """Draw the three pauses."""
    figure, cells = new_figure(8.75, 9.3, len(ROWS) + 2, 3)
    box, view, video = window(scene.silhouettes, 2.6), scene.view(scene.turn), scene.recording
    columns = zip(scene.pauses, ("seen", "hidden", "seen again"), scene.silhouettes, strict=True)
    for column, (t, head, true) in enumerate(columns):
        index = video.pauses[t]
        cells[0, column].set_title(f"{head} (pause {t}, {video.times[index]:.0f} s)", fontsize=12.5)
        show(cells[0, column], video.frames[index].rgb[box], true[box], "--")
        show(cells[1, column], *scene.voxels("mst", t, TRUTH, view))
        for axes, (name, best, _) in zip(cells[2:, column], ROWS, strict=True):
            overlaps = scene.overlaps(name, t)
            k = int(np.argmax(overlaps)) if best else scene.most_probable(name, t)
            show(axes, *scene.voxels(name, t, k, view))
            text = f"overlap {overlaps[k]:.2f}" if overlaps[k] else "not found"
            axes.text(0.02, 0.04, text, transform=axes.transAxes, fontsize=12.5, bbox=BEHIND)
    for row, text in enumerate(("image", "true voxels", *(text for *_, text in ROWS))):
        cells[row, 0].set_ylabel(text, fontsize=12.5, color="#1d2126")
    figure.savefig(out, dpi=125, metadata={"Software": None})


def animate(scene: Scene, out: Path) -> None:
    """The video of the recording beside the voxels of `mst` after the last pause, in a slowly turning view."""
    from PIL import Image

    def pictures() -> Iterator[Image.Image]:
        box = window(scene.silhouettes, 3.6)
        for index, frame in enumerate(scene.recording.frames):
            t = sum(p <= index for p in scene.recording.pauses) - 1
            phase = 2 * np.pi * index / len(scene.recording)
            k, view = scene.most_probable("mst", t), scene.view(scene.turn + 0.3 * np.sin(phase))
            instance = scene.recording.instance(index)
            assert instance is not None
            figure, ((left, right),) = new_figure(8.0, 3.3, 1, 2)
            show(left, frame.rgb[box], (instance == scene.label)[box])
            show(right, *scene.voxels("mst", t, k, view))
            left.set_title(f"camera, {scene.recording.times[index]:.1f} s", fontsize=12.5)
            right.set_title(f"mst, after the image of pause {t}", fontsize=12.5)
            figure.set_dpi(100)
            figure.canvas.draw()
            yield Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())

    first, *others = pictures()
    times = [600 if k in scene.recording.pauses else 130 for k in range(len(scene.recording))]
    first.save(out, save_all=True, append_images=others, duration=times, loop=0, quality=70, method=4)


def main(out: Path, work: Path, smoke: bool) -> None:
    """Simulate, filter, draw."""
    import matplotlib.style

    source = work / "recording"
    family = replace(scene_family("demo"), **SMALL) if smoke else scene_family(FAMILY)
    recording = (
        open_recording(source) if source.is_dir() else simulate_recording(family, 0 if smoke else SEED, source)
    )
    label, pauses = (1, (0, 1, 2)) if smoke else find_hidden(recording)
    runs = {name: filter_recording(recording, load_config(name), work / name, seed=0) for name in METHODS}
    scene = Scene(recording, runs, label, pauses)
    out.mkdir(parents=True, exist_ok=True)
    with matplotlib.style.context("mstfilter.app.report.figures"):
        draw(scene, out / "hidden.png")
        animate(scene, out / "hidden.webp")
    print(f"{recording.name}: object {label}, pauses {pauses}", *sorted(out.glob("hidden.*")))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=PICTURES, help="folder of the pictures")
    parser.add_argument("--work", type=Path, help="folder for the recording and the runs, reused; default: temporary")
    parser.add_argument("--smoke", action="store_true", help="a small scene; needs --out")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == PICTURES:
        parser.error("--smoke would overwrite the pictures: name another folder with --out")
    with tempfile.TemporaryDirectory() as folder:
        main(arguments.out, arguments.work or Path(folder), arguments.smoke)
