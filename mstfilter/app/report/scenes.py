"""Content of the pauses of a run or a recording, for the report and for pages with rotatable scenes.

>>> scenes = scenes_of_run(RunFolder.open("runs/demo"))
>>> view = scenes[-1].views[0]                        # the estimate of the last pause
>>> view.name, view.weight, view.overlay(scenes[-1].camera, 1, 2)

Each hypothesis has a name, weight, quality and the colours of its objects (`mstfilter.app.report.identities`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mstfilter.app.report.identities import TRUTH, Identities, assign_identities, names_of, weigh_distinct
from mstfilter.app.report.pictures import Colour, colour, data_uri, overlay_layer, png_bytes, voxel_picture
from mstfilter.runs import RunFolder
from mstfilter.scene import Camera, Frame, Hypothesis, Recording, VoxelGrid, project

_MOST_VIEWS = 12  # hypotheses of a pause


@dataclass(frozen=True)
class ShownHypothesis:
    """A hypothesis or the truth at a pause."""

    name: str
    text: str
    hypothesis: Hypothesis
    identity: Mapping[int, int]  #: label -> identity, which sets the colour
    weight: float | None = None  #: None for the truth
    colours: Mapping[int, Colour] = field(default_factory=dict)  #: used instead of the colours of the identities
    quality: float | None = None
    members: Sequence[int] = ()  #: indices of identical hypotheses

    def colour(self, label: int) -> Colour:
        """Colour of an object."""
        return self.colours.get(label) or colour(self.identity.get(label, -1))

    @cached_property
    def volumes(self) -> dict[int, int]:
        """Number of voxels of each label."""
        return self.hypothesis.volumes()

    def overlay(self, camera: Camera, scale: int, line: int) -> str:
        """The layer with the objects in a camera's image, as a data URI. `scale` and `line`: see `overlay_layer`."""
        colours = {label: self.colour(label) for label in self.volumes}
        image = project(self.hypothesis, camera)
        return data_uri(png_bytes(overlay_layer(image, colours, scale=scale, line=line)))

    def voxels(self, view: Camera) -> str:
        """A picture of the voxels from a viewpoint, as a data URI."""
        colours = {label: self.colour(label) for label in self.volumes}
        return data_uri(png_bytes(voxel_picture(self.hypothesis.labels, self.hypothesis.grid, view, colours)))


@dataclass(frozen=True)
class ShownPause:
    """The image and the hypotheses of a pause."""

    name: str
    views: Sequence[ShownHypothesis]
    time: float = 0.0
    image: np.ndarray | None = None
    camera: Camera | None = None
    links: Sequence[tuple[int, int]] = ()  #: (view of the last pause, view) if the second descends from the first
    hidden: float = 0.0  #: weight of the hypotheses that are not shown


def scenes_of_run(run: RunFolder) -> list[ShownPause]:
    """The pauses of a run, each with at most twelve distinct hypotheses, the estimate first, and the truth."""
    identities = assign_identities(run)
    scenes: list[ShownPause] = []
    view_of: dict[int, int] = {}
    for t in range(run.n_pauses):
        earlier, scene = view_of, scene_of_run(run, t, identities)
        view_of = {k: v for v, view in enumerate(scene.views) for k in view.members}
        parents = enumerate(run.info(t)["parents"].get("previous") or ())
        links = {(earlier[p], view_of[k]) for k, p in parents if p in earlier and k in view_of}
        scenes.append(replace(scene, links=sorted(links)))
    return scenes


def scene_of_run(run: RunFolder, t: int, identities: Identities, n_views: int = _MOST_VIEWS) -> ShownPause:
    """A pause of a run with at most `n_views` distinct hypotheses and the truth.

    The estimate (`Belief.estimate`) is the first hypothesis, and the others are sorted by weight.
    """
    info, hypotheses, truth = run.info(t), run.hypotheses(t), run.truth(t)
    estimate = run.belief(t).estimate().key
    views, groups = [], weigh_distinct(hypotheses, info["weights"])
    groups.sort(key=lambda group: hypotheses[group[0][0]].key != estimate)
    for place, (members, weight) in enumerate(groups[:n_views]):
        k = members[0]
        quality = None if info["quality"] is None else info["quality"]["objects"][k]
        text = "estimate, " * (place == 0 and len(groups) > 1) + f"weight {weight:.2f}"
        text += "" if quality is None else f", quality {quality:.2f}"
        shown = names_of(members), text, hypotheses[k], identities.of(t, k), weight
        views.append(ShownHypothesis(*shown, quality=quality, members=members))
    if truth is not None:
        known = Hypothesis.from_labels(truth, hypotheses[0].grid)
        views.append(ShownHypothesis("truth", "", known, identities.of(t, TRUTH)))
    hidden = float(sum(weight for _, weight in groups[n_views:]))
    time = float(run.description["recording"]["times"][t])
    return ShownPause(f"pause {t}", views, time, run.rgb(t), run.camera(t), hidden=hidden)


def scenes_of_recording(recording: Recording) -> list[ShownPause]:
    """The pauses of a recording, each with the truth or, if it is unknown, the surface that the camera sees."""
    scenes = []
    for t, clip in enumerate(recording.clips()):
        truth, frame = recording.truth(t), clip.after
        if truth is None:
            view = _surface(frame, clip.grid)
        else:
            known = Hypothesis.from_labels(truth, clip.grid)
            view = ShownHypothesis("truth", "", known, {k: k - 1 for k in known.volumes()})
        scenes.append(ShownPause(f"pause {t}", [view], recording.times[recording.pauses[t]], frame.rgb, frame.camera))
    return scenes


def _surface(frame: Frame, grid: VoxelGrid) -> ShownHypothesis:
    """Voxels that contain a measured point, in the colour of the point, rounded to six levels per channel."""
    points, rgb = frame.points[frame.valid], frame.rgb[frame.valid]
    index = grid.index_of(points)
    inside = grid.contains(index)
    level = (rgb[inside] // 43).astype(np.uint16)
    labels = np.zeros(grid.shape, np.uint16)
    labels[tuple(index[inside].T)] = 1 + level @ np.array([36, 6, 1], np.uint16)
    hypothesis = Hypothesis.from_labels(labels, grid)
    colours = {k: tuple(21 + 43 * ((k - 1) // d % 6) for d in (36, 6, 1)) for k in hypothesis.volumes()}
    return ShownHypothesis("surface", "voxels that contain a measured point", hypothesis, {}, None, colours)  # type: ignore[arg-type]
