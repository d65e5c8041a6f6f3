"""The pictures of docs/changes.md: the published method and `mst` on the same simulated recording.

    python experiments/readme_picture/changes.py [--family s2] [--seed 0] [--out docs/images]
    python experiments/readme_picture/changes.py --smoke --out FOLDER    # a small scene: shows only that it works

In each picture the two methods get the same input. An object has the colour of the true object that it overlaps.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from make import SMALL, window

import mstfilter
from mstfilter.app.report import match_objects, overlay, viewpoint, voxel_picture
from mstfilter.lab.simulation import scene_family, simulate_recording
from mstfilter.mst.belief import Belief
from mstfilter.mst.completion import Extrude
from mstfilter.scene import Clip, Hypothesis, project
from mstfilter.scoring import overlap, weighted_coverage
from mstfilter.smc import Population, Systematic

FOLDER = Path("docs/images")
PAPER, MST = mstfilter.preset("paper"), mstfilter.preset("mst")
Rows = dict[str, dict[str, np.ndarray]]


def rng(stream: int = 0) -> np.random.Generator:
    """A generator for one component; both methods get the same."""
    return np.random.default_rng(stream)


def save(rows: Rows, path: Path, size: float = 2.1) -> None:
    """Draw named rows of titled pictures with 128 colours, so that the file is small."""
    import matplotlib.style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    n_columns = max(map(len, rows.values()))
    with matplotlib.style.context("mstfilter.app.report.figures"):
        figure = Figure((size * n_columns + 0.3, 0.85 * size * len(rows)), layout="constrained")
        canvas = FigureCanvasAgg(figure)
        figure.get_layout_engine().set(w_pad=0.02, h_pad=0.05, wspace=0.01, hspace=0.01)
        for line, (name, cells) in zip(
            figure.subplots(len(rows), n_columns, squeeze=False), rows.items(), strict=True
        ):
            for axes in line:
                axes.set(xticks=[], yticks=[])
                axes.spines[:].set_visible(False)
            for axes, (title, picture) in zip(line, cells.items(), strict=False):
                axes.imshow(picture, interpolation="antialiased")
                axes.set_title(title, fontsize=9, loc="left")
            line[0].set_ylabel(name, fontsize=10)
        figure.set_dpi(110)
        canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
        picture.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)
    print(path, f"{path.stat().st_size / 1000:.0f} kB")


class Scene:
    """One clip of a recording with its truth, and how hypotheses are drawn over its last image."""

    def __init__(self, clip: Clip, truth: Sequence[Hypothesis]) -> None:
        self.clip, self.truth = clip, truth
        self.frame = clip.after
        self.part = window([project(h, self.frame.camera) > 0 for h in truth], 1.25)

    def colours(self, hypotheses: Sequence[Hypothesis]) -> list[dict]:
        """Colours of the objects of each hypothesis."""
        return match_objects([self.truth[-1], *hypotheses], [2.0, *[1.0] * len(hypotheses)])[1:]

    def images(self, hypotheses: Sequence[Hypothesis], rgb: np.ndarray | None = None) -> list[np.ndarray]:
        """The hypotheses over an image (default: the last one)."""
        rgb, camera = self.frame.rgb if rgb is None else rgb, self.frame.camera
        colours = self.colours(hypotheses)
        return [overlay(rgb, project(h, camera), c)[self.part] for h, c in zip(hypotheses, colours, strict=True)]

    def voxels(self, hypotheses: Sequence[Hypothesis]) -> list[np.ndarray]:
        """The hypotheses as voxels."""
        view = viewpoint([*self.truth, *hypotheses], self.frame.camera, 400, 300)
        colours = self.colours(hypotheses)
        return [voxel_picture(h.labels, h.grid, view, c) for h, c in zip(hypotheses, colours, strict=True)]

    def both(self, hypotheses: Mapping[str, Hypothesis]) -> Rows:
        """Titled hypotheses over the image, and as voxels."""
        shown = list(hypotheses.values())
        rows = {"over the image": self.images(shown), "voxels": self.voxels(shown)}
        return {name: dict(zip(hypotheses, cells, strict=True)) for name, cells in rows.items()}

    def quality(self, hypothesis: Hypothesis) -> str:
        """Quality in the volume, for a title."""
        return f"quality {weighted_coverage(hypothesis.labels, self.truth[-1].labels):.2f}"


def segmentation(scene: Scene) -> Rows:
    """The most probable cut and samples of one image, with the trees of both methods."""
    rows = {}
    for name, method in {"paper": PAPER, "mst": MST}.items():
        proposal = replace(method.proposal, completer=Extrude())
        drawn = proposal.sample(rng(), scene.clip, 5)
        best = replace(proposal, sampler=mstfilter.preset("single_frame").proposal.sampler).sample(
            rng(), scene.clip, 1
        )
        titles = ["most probable segmentation", *[f"sample {k}" for k in (1, 2, 3)]]
        shown = [best.best, *drawn.particles[:3]]
        print(
            f"segmentation, {name}: {[h.n_objects for h in shown]} segments, {scene.truth[-1].n_objects} true objects"
        )
        rows[name] = dict(zip(titles, scene.images(shown), strict=True))
    return rows


def tracking(scene: Scene) -> Rows:
    """The true objects of the pause before, moved by the transitions of both methods."""
    before = Population((scene.truth[0],))
    moved = {
        name: method.transition.predict(rng(), before, scene.clip).best
        for name, method in {"paper": PAPER, "mst": MST}.items()
    }
    rows = scene.both({"before the motion": scene.truth[0], **moved, "truth after the motion": scene.truth[-1]})
    rows["over the image"]["before the motion"] = scene.images(scene.truth[:1], scene.clip.before.rgb)[0]
    return rows


def shapes(scene: Scene) -> Rows:
    """One segmentation of the image, completed by both methods."""
    sampler = mstfilter.preset("single_frame").proposal.sampler
    shown = {}
    for name, completer in {"paper": Extrude(), "mst": MST.update.completer}.items():
        made = replace(MST.proposal, sampler=sampler, completer=completer).sample(rng(), scene.clip, 1).best
        shown[f"{name}, {scene.quality(made)}"] = made
    return scene.both(shown | {"truth": scene.truth[-1]})


def fusion(scene: Scene, before: Population) -> Rows:
    """The same samples and predictions, combined by the updates of both methods."""
    predicted = MST.transition.predict(rng(1), before, scene.clip)
    proposed = replace(MST.proposal, completer=MST.update.completer).sample(rng(2), scene.clip, 5)
    shown = {"a prediction": predicted.particles[0], "a sample": proposed.particles[0]}
    for name, method in {"paper": PAPER, "mst": MST}.items():
        made = method.update.update(rng(3), predicted, proposed, scene.clip)
        chosen = Systematic().resample(rng(4), made, 1).best
        shown[f"{name}, {scene.quality(chosen)}"] = chosen
    return scene.both(shown | {"truth": scene.truth[-1]})


def result(scene: Scene, last: Mapping[str, Hypothesis]) -> Rows:
    """The estimates of both methods at the last pause."""
    true = scene.truth[-1]
    seen = np.bincount(project(true, scene.frame.camera).ravel(), minlength=true.labels.max() + 1)
    for name, h in last.items():
        print(f"result, {name}: {h.n_objects} objects, {true.n_objects} true objects")
        for k, volume in true.volumes().items():
            own = overlap(true.labels == k, h.labels)
            best = own.jaccard()[-1, 1:].argmax() + 1  # without free space
            found, share = own.sizes_b[best], own.jaccard()[-1, best]
            print(f"  {volume} voxels, {seen[k]} pixels: {found} voxels, overlap {share:.2f}")
    return scene.both({f"{n}, {scene.quality(h)}": h for n, h in last.items()} | {"truth": scene.truth[-1]})


def main(family: str, seed: int, out: Path, smoke: bool) -> None:
    """Simulate, run both methods, draw."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        chosen = replace(scene_family("demo"), **SMALL) if smoke else scene_family(family)
        recording = simulate_recording(chosen, seed, Path(folder) / "recording")
        clips = recording.clips()
        truth = [Hypothesis.from_labels(recording.truth(t), recording.grid) for t in range(len(clips))]
        states = {name: [s for s, _ in f.iterate(clips, 0)] for name, f in {"paper": PAPER, "mst": MST}.items()}
        first, second, final = (Scene(clips[t], truth[max(0, t - 1) : t + 1]) for t in (0, 1, -1 % len(clips)))
        pictures = {
            "segmentation": segmentation(first),
            "tracking": tracking(second),
            "shapes": shapes(first),
            "fusion": fusion(second, states["mst"][0].population),
            "result": result(final, {name: Belief(s[-1].population).estimate() for name, s in states.items()}),
        }
    for name, rows in pictures.items():
        save(rows, out / f"changes-{name}.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--family", default="s2")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=FOLDER)
    parser.add_argument("--smoke", action="store_true", help="a small scene; needs --out")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == FOLDER:
        parser.error("--smoke would overwrite the pictures: name another folder with --out")
    main(arguments.family, arguments.seed, arguments.out, arguments.smoke)
