"""What a belief says of a scene: a picture over the image, and sentences that a person reads.

>>> answer = Answer.of(belief, table, camera)
>>> answer.sentences
['4 objects in view.', '1 is hidden and remembered: 4 (.80).',
 '1 border is open: between objects 2 and 3 (.47 that both sides are one object). A push against 3, as the
 arrow shows, would tell most.']
>>> answer.outlines, answer.borders, answer.push       # in pixels, for SVG or matplotlib
>>> plot_answer(answer, image)                  # the picture; `Belief.plot(image, camera)` draws it too
>>> changes(before, now)                        # what a push did, from the tables of two pauses
['Moved: 2 (by 4 cm).', '2 and 3 are one object with probability .02 (.47 before).']

The report, the console and notebooks show the same picture and the same words. No ground truth is needed. A border
between two objects that surely are two is none that is open: only where they meet is uncertain, by a few pixels.
Objects that exist with a probability below .05 are left out.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import matplotlib.style
import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from mstfilter.app.report.charts import Drawing
from mstfilter.app.report.export import mesh_bytes
from mstfilter.app.report.pictures import border_colour, close_up, colour, hexadecimal
from mstfilter.mst.belief import Belief, BelievedObject, Border, ObjectTable, PushCandidate, push_candidates
from mstfilter.runs import RunFolder
from mstfilter.scene import Camera, project, render

_APART = 0.06  # least distance of two tags, as a share of the width of the image
_SURE = 0.05  # probabilities nearer to 0 or 1 are not mentioned
_MOVED = 0.01  # metres
_NEAR = 0.2  # metres within which a new object is looked for beside one that was perhaps several
_CHANGED = 0.1  # of a probability
_MOST = 5  # cases of a sentence that are listed
_ARROW = 0.06  # metres, length of the arrow of a push before its contact

Point = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Tag:
    """A short text in the picture, with the point that it is about."""

    text: str
    place: Point  #: of the middle of the text, (column, row)
    about: Point


@dataclass(frozen=True, eq=False)
class Outline:
    """The outline of an object in the image; of a hidden one, where it would be seen."""

    number: int
    hidden: bool
    polygons: Sequence[np.ndarray]  #: each (m, 2), (column, row); none if the object is outside the image
    tag: Tag | None = None

    @property
    def path(self) -> str:
        """The polygons as a path of SVG."""
        return _path(self.polygons)


@dataclass(frozen=True, eq=False)
class OpenBorder:
    """A border between one object and two."""

    one_object: float  #: probability
    numbers: tuple[int, ...]  #: of the objects on its sides, in the table: one, or two
    polygons: Sequence[np.ndarray]  #: around the border; each (m, 2), (column, row)
    tag: Tag

    @property
    def path(self) -> str:
        """The polygons as a path of SVG."""
        return _path(self.polygons)

    @property
    def text(self) -> str:
        """Where it is, in words."""
        if len(self.numbers) == 2:
            return f"between objects {self.numbers[0]} and {self.numbers[1]}"
        return f"inside object {self.numbers[0]}" if self.numbers else "beside the objects"


class Arrow(NamedTuple):
    """A push in the image."""

    start: Point  #: (column, row)
    end: Point  #: the contact
    number: int  #: of the object that is pushed

    @classmethod
    def of(cls, push: PushCandidate, camera: Camera, number: int) -> Arrow:
        """The arrow of a push against the object with a number."""
        (x, y), (u, v) = camera.project(np.array([push.contact - _ARROW * push.direction, push.contact]))[0].tolist()
        return cls((x, y), (u, v), number)


@dataclass(frozen=True, eq=False)
class Answer:
    """The objects of a table in an image, and the borders that are open."""

    table: ObjectTable
    box: tuple[float, float, float, float]  #: part of the image to be shown: x, y, width, height in pixels
    outlines: Sequence[Outline] = field(default_factory=tuple)
    borders: Sequence[OpenBorder] = field(default_factory=tuple)  #: the most uncertain first
    #: Pairs of objects that are two, and of which it is uncertain where they meet.
    meeting: Sequence[tuple[int, int]] = field(default_factory=tuple)
    push: Arrow | None = None  #: the push that would tell most, for a tool that can reach the whole grid

    @classmethod
    def of(cls, belief: Belief, table: ObjectTable, camera: Camera) -> Answer:
        """The answer of a belief and its table of objects in the image of a camera."""
        table = replace(table, objects=tuple(one for one in table if one.existence >= _SURE))
        box = close_up([belief.estimate()], camera)
        shown = box[2] / camera.width
        image = _label_image(belief, camera)
        tags = _Tags(camera.width, camera.height, _APART * shown * camera.width)
        number_of = {one.label: one.number for one in table if one.in_estimate}
        open_borders, asked, meeting = [], [], []
        for border in belief.open_borders(camera):
            numbers = _numbers(border, image, number_of)
            if len(numbers) == 2 and table.by_number(numbers[0]).one_with.get(numbers[1], 0.0) <= _SURE:
                meeting.append((numbers[0], numbers[1]))
                continue
            thick = np.zeros(image.shape, np.uint8)
            thick[border.pixels[:, 1], border.pixels[:, 0]] = 1
            x, y = border.middle.tolist()
            tag = tags.place(share(border.one_object), (x + 0.5, y + 0.5), beside=True)
            around = _polygons(_grown(thick, max(1, round(shown * camera.width / 320))))
            open_borders.append(OpenBorder(border.one_object, numbers, around, tag))
            asked.append(border)
        masks = [_mask(belief, one, image, camera) for one in table]
        order = np.argsort([-int(mask.sum()) for mask in masks], kind="stable").tolist()
        found: dict[int, Outline] = {}
        for k in order:
            one = table[k]
            named = tags.place(str(one.number), widest(masks[k])[1]) if masks[k].any() else None
            around = _polygons(masks[k].astype(np.uint8), outer=True)
            found[k] = Outline(one.number, not one.visible, around, named)
        outlines = tuple(found[k] for k in range(len(table)))
        push = _push(belief, camera, asked, number_of) if asked else None
        return cls(table, box, outlines, tuple(open_borders), tuple(dict.fromkeys(meeting)), push)

    @cached_property
    def sentences(self) -> list[str]:
        """How many objects there are, what is hidden, and what is open."""
        seen = {one.lineage: one.number for one in self.table if one.visible}
        unseen = [(one, seen.get(one.lineage)) for one in self.table if not one.visible]
        hidden = [one for one, visible in unseen if visible is None]
        found = [f"{_count(len(self.table) - len(unseen), 'object')} in view."]
        if hidden:
            names = _listed([f"{one.number} ({share(one.existence)})" for one in hidden])
            found.append(f"{len(hidden)} {'is' if len(hidden) == 1 else 'are'} hidden and remembered: {names}.")
        found += [
            f"Perhaps {visible} is hidden elsewhere, as {one.number} ({share(one.existence)})."
            for one, visible in unseen
            if visible is not None
        ]
        if self.borders:
            texts = self._open_borders()
            n = len(texts)
            found.append(f"{n} border{' is' if n == 1 else 's are'} open: {_listed(texts)}.")
            if self.push is not None:
                found.append(f"A push against {self.push.number}, as the arrow shows, would tell most.")
        else:
            found.append("No border is open.")
        if self.meeting:
            pairs = _listed([f"{a} and {b}" for a, b in self.meeting])
            found.append(f"Uncertain by a few pixels is where these meet, which are two: {pairs}.")
        asked = {number for border in self.borders for number in border.numbers}
        parts = [one for one in self.table if one.several > _CHANGED and one.number not in asked]
        if parts:
            listed = _listed([f"{one.number} ({share(one.several)})" for one in parts])
            found.append(f"Perhaps several objects, with something between them: {listed}.")
        return found

    def _open_borders(self) -> list[str]:
        """The open borders in words; those between the same objects are named together."""
        places: dict[str, list[str]] = {}
        for border in self.borders:
            places.setdefault(border.text, []).append(share(border.one_object))
        texts, meaning = [], " that both sides are one object"  # said once
        for text, probabilities in places.items():
            n = len(probabilities)
            where = f", at {n} places" if n > 1 else ""
            numbers = " and ".join(probabilities) if n < 3 else f"{min(probabilities)} to {max(probabilities)}"
            texts.append(f"{text}{where} ({numbers}{meaning})")
            meaning = ""
        return texts


@matplotlib.style.context("mstfilter.app.report.figures")
def plot_answer(answer: Answer, image: np.ndarray) -> Drawing:
    """The picture of an answer over the image (H, W, 3): outlines with numbers, and open borders with probabilities.

    Hidden objects are dashed. The colour of a border goes from yellow (two objects) to pink (one). An arrow shows
    `push`.
    """
    _, _, width, height = answer.box
    figure = Drawing(figsize=(6.4, 6.4 * height / width), layout="constrained")
    draw_answer(figure.subplots(), answer, image)
    return figure


def draw_answer(axes: Axes, answer: Answer, image: np.ndarray) -> None:
    """Draw what `plot_answer` shows into the axes of a figure of your own."""
    x, y, width, height = answer.box
    axes.imshow(image, extent=(0, image.shape[1], image.shape[0], 0))
    axes.set(xlim=(x, x + width), ylim=(y + height, y))
    axes.set_axis_off()
    glow = [patheffects.withStroke(linewidth=3, foreground="#0c1016")]
    for one in answer.outlines:
        for points in one.polygons:
            style: Any = {"linestyle": "--" if one.hidden else "-", "path_effects": glow}
            axes.add_patch(
                Polygon(points, fill=False, edgecolor=hexadecimal(colour(one.number - 1)), lw=1.5, **style)
            )
    for border in answer.borders:
        for points in border.polygons:
            axes.add_patch(Polygon(points, facecolor=hexadecimal(border_colour(border.one_object)), edgecolor="none"))
    if answer.push is not None:
        arrow: Any = {"arrowstyle": "-|>,head_width=0.4,head_length=0.7", "color": "#f6f6f2", "lw": 3}
        axes.annotate("", answer.push.end, answer.push.start, arrowprops=arrow)
    tags = [(one.tag, "white", 11) for one in answer.outlines if one.tag is not None]
    tags += [(one.tag, hexadecimal(border_colour(one.one_object)), 13) for one in answer.borders]
    for tag, ink, size in tags:
        if np.hypot(*np.subtract(tag.place, tag.about)) > 0.0125 * width:
            axes.plot(*zip(tag.place, tag.about, strict=True), color="white", lw=0.8)
        place: Any = {"ha": "center", "va": "center", "fontsize": size, "fontweight": "bold"}
        axes.text(*tag.place, tag.text, color=ink, path_effects=glow, **place)


def plot_belief(belief: Belief, image: np.ndarray, camera: Camera) -> Drawing:
    """The picture of a belief over the image (H, W, 3) of a camera; see `plot_answer`."""
    return plot_answer(Answer.of(belief, belief.objects(camera), camera), image)


def answers_of_run(run: RunFolder) -> list[tuple[Answer, list[str]]]:
    """The answer of each pause of a run, and what changed since the pause before."""
    found: list[tuple[Answer, list[str]]] = []
    for t, table in enumerate(run.tables()):
        answer = Answer.of(run.belief(t), table, run.camera(t))
        found.append((answer, changes(found[-1][0].table, table) if found else []))
    return found


def changes(before: ObjectTable, now: ObjectTable) -> list[str]:
    """What happened between two pauses, in sentences; the tables have common numbers."""
    old, new = ({one.number: one for one in table} for table in (before, now))
    both = [(old[k], new[k]) for k in sorted(old.keys() & new.keys())]
    parts = _parts(old, new)
    found = []
    shifts = [(b.number, _shift(a, b)) for a, b in both if b.number not in parts or a.lineage == b.lineage]
    moved = [f"{k} (by {100 * shift:.0f} cm)" for k, shift in shifts if shift > _MOVED]
    if moved:
        found.append(f"Moved: {_listed(moved)}.")
    for a, b in both:
        for other in sorted({*a.one_with, *b.one_with}):
            if a.number < other and other in new and other in old:
                p, q = a.one_with.get(other, 0.0), b.one_with.get(other, 0.0)
                if abs(p - q) > _CHANGED:
                    pair = f"{a.number} and {other}"
                    found.append(f"{pair} are one object with probability {share(q)} ({share(p)} before).")
    for a, b in both:
        if a.number in parts:
            two = 1 - b.one_with.get(parts[a.number], 0.0)
            said = "is" if two >= 1 - _SURE else f"is with probability {share(two)}"
            pair = f"{a.number} and {parts[a.number]}"
            found.append(f"{a.number} {said} two objects, {pair} ({share(a.several)} before).")
        elif abs(a.several - b.several) > _CHANGED:
            found.append(
                f"{a.number} is several objects with probability {share(b.several)} ({share(a.several)} before)."
            )
    gone = [b for a, b in both if a.visible and not b.visible]
    found += [f"{one.number} is hidden now, and is remembered ({share(one.existence)})." for one in gone]
    found += [f"{b.number} is seen again." for a, b in both if b.visible and not a.visible]
    fresh = [str(k) for k in sorted(new.keys() - old.keys()) if k not in parts.values()]
    if fresh:
        found.append(f"New: {_listed(fresh)}.")
    lost = [f"{k} ({share(old[k].existence)} before)" for k in sorted(old.keys() - new.keys())]
    if lost:
        found.append(f"No longer there: {_listed(lost)}.")
    return found or ["Nothing changed."]


def _shift(before: BelievedObject, now: BelievedObject) -> float:
    """How far the middle of an object has moved, metres. What only its new shape has moved does not count."""
    if before.lineage == now.lineage:
        motion = now.pose * before.pose.inv()
        return float(np.linalg.norm(motion.apply(before.centre) - before.centre))
    return float(np.linalg.norm(now.centre - before.centre))


#: The columns of the table of objects: keys of `table_cells`, and their heads.
TABLE_HEADS = {
    "number": "object",
    "exists": "exists",
    "seen": "seen",
    "middle": "middle, cm",
    "spread": "± cm",
    "size": "size, cm",
    "volume": "volume, cm³",
    "range": "80 % range",
    "moved": "moved",
    "maybe": "perhaps",
}


def table_cells(table: ObjectTable) -> list[dict[str, str]]:
    """The table of objects as a person reads it: the texts of a row for each object, in the order of the numbers."""
    return [_object_row(one) for one in sorted(table, key=lambda one: one.number)]


def mesh_link(table: ObjectTable) -> str:
    """The smooth objects of a table as a data URI of a .glb file; empty if there are none."""
    if not len(table):
        return ""
    data = mesh_bytes(table, "glb", {one.number: colour(one.number - 1) for one in table})
    return f"data:model/gltf-binary;base64,{b64encode(data).decode()}"


def _object_row(one: BelievedObject) -> dict[str, str]:
    """The texts of a row of the table of objects."""
    maybe = [f"one with {k} ({share(p)})" for k, p in one.one_with.items() if p > _SURE]
    maybe += [f"several ({share(one.several)})"] if one.several > _SURE else []
    moved = float(np.linalg.norm(one.shift)), float(np.degrees(one.pose.rotation.magnitude()))
    volume, low, high = (f"{1e6 * v:.0f}" for v in (one.volume, *one.volume_range))
    return {
        "number": str(one.number),
        "colour": hexadecimal(colour(one.number - 1)),
        "exists": share(one.existence),
        "seen": "now" if one.visible else f"hidden since pause {one.last_seen + 1}",
        "middle": ", ".join(f"{100 * x:.0f}" for x in one.centre),
        "spread": f"{100 * float(np.linalg.norm(one.spread)):.1f}",
        "size": " × ".join(f"{100 * side:.0f}" for side in one.sides),
        "volume": volume,
        "range": f"{low} to {high}",
        "moved": f"{100 * moved[0]:.0f} cm, {moved[1]:.0f}°" if moved[0] > 1e-3 or moved[1] > 0.5 else "",
        "maybe": ", ".join(maybe),
    }


def share(p: float) -> str:
    """A probability with two digits, such as .47; .00 and 1.00 are written so."""
    text = f"{p:.2f}"
    return text[1:] if text.startswith("0") else text


def _count(n: int, name: str) -> str:
    return f"{n} {name}{'' if n == 1 else 's'}"


def _listed(items: Sequence[str], separator: str = ", ") -> str:
    more = len(items) - _MOST
    return separator.join(items[:_MOST]) + (f" and {more} more" if more > 0 else "")


def _parts(old: dict[int, BelievedObject], new: dict[int, BelievedObject]) -> dict[int, int]:
    """New objects that were parts of one that was perhaps several, by the number of the latter."""
    found: dict[int, int] = {}
    for k in sorted(new.keys() - old.keys()):
        near = [
            (float(np.linalg.norm(one.centre - new[k].centre)), number)
            for number, one in old.items()
            if one.several > _SURE and number in new and number not in found and new[k].visible
        ]
        if near and min(near)[0] < _NEAR:
            found[min(near)[1]] = k
    return found


def _push(belief: Belief, camera: Camera, borders: Sequence[Border], number_of: Mapping[int, int]) -> Arrow | None:
    """The most informative push along one of some borders, of a tool that reaches the whole grid."""
    grid = belief.grid
    if camera.T_world_camera is None or not belief.estimate().n_objects:
        return None
    for best in push_candidates(belief, camera, (grid.origin, grid.upper), borders=borders):
        number = number_of.get(best.label)
        if number is not None:
            return Arrow.of(best, camera, number)
    return None


def _numbers(border: Border, image: np.ndarray, number_of: dict[int, int]) -> tuple[int, ...]:
    """The objects of the estimate that most pixels of both sides of a border show."""
    found = []
    for side in border.sides:
        counts = np.bincount(image[side], minlength=1)
        counts[0] = 0
        if counts.any() and (number := number_of.get(int(counts.argmax()))) and number not in found:
            found.append(number)
    return tuple(sorted(found))


def _label_image(belief: Belief, camera: Camera) -> np.ndarray:
    """The label (H, W) of the estimate at each pixel.

    Voxels are coarser than pixels. If the segmentations of this image are known, each of their cells has the label
    that most of its pixels show, so outlines are those of the image.
    """
    image = project(belief.estimate(), camera)
    seen = belief.segmentations
    if seen is None or not seen.are_of(camera):
        return image
    return np.concatenate([[0], seen.cell_labels(image)])[seen.cells]


def _mask(belief: Belief, one: BelievedObject, image: np.ndarray, camera: Camera) -> np.ndarray:
    """Where an object is in the image (H, W) bool; of a hidden one, as if nothing were in front of it."""
    if one.in_estimate and one.visible:
        return _closed(image == one.label)
    hypothesis = belief.hypotheses[one.hypothesis]
    alone = (hypothesis.labels == one.label).astype(np.uint16)
    return render(alone, hypothesis.grid, camera).labels > 0


def _closed(mask: np.ndarray) -> np.ndarray:
    """A mask (H, W) without narrow gaps, such as pixels without a reading, and without specks."""
    import cv2

    size = 2 * max(1, round(mask.shape[1] / 160)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    whole = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, disc)
    n, parts, stats, _ = cv2.connectedComponentsWithStats(whole)
    if n < 2:
        return mask
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.asarray(np.isin(parts, 1 + np.flatnonzero(areas > 0.03 * areas.max())))


def _grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    import cv2

    size = 2 * pixels + 1
    return cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))


def _polygons(mask: np.ndarray, outer: bool = False) -> list[np.ndarray]:
    """The contours of a mask (H, W) uint8, or the `outer` ones alone. Pixel (0, 0) is the square to (1, 1)."""
    import cv2

    mode = cv2.RETR_EXTERNAL if outer else cv2.RETR_CCOMP
    contours, _ = cv2.findContours(mask, mode, cv2.CHAIN_APPROX_NONE)
    found = [cv2.approxPolyDP(contour, 0.7, True)[:, 0] + 0.5 for contour in contours]
    return [points for points in found if len(points) > 2]


def _path(polygons: Sequence[np.ndarray]) -> str:
    return "".join("M" + " ".join(f"{x:g},{y:g}" for x, y in points.tolist()) + "Z" for points in polygons)


def widest(mask: np.ndarray) -> tuple[float, Point]:
    """The point of a mask that is farthest from its border, after its distance in pixels. The mask is not empty."""
    from scipy.ndimage import distance_transform_edt

    inside = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(inside.argmax()), mask.shape)
    return float(inside[row, column]), (float(column) + 0.5, float(row) + 0.5)


class _Tags:
    """Places for texts, so that none covers another."""

    def __init__(self, width: int, height: int, apart: float) -> None:
        self.size, self.apart = np.array([width, height], float), apart
        self.taken: list[np.ndarray] = []

    def place(self, text: str, about: Point, beside: bool = False) -> Tag:
        """The nearest free place to a point, or `beside` it."""
        apart, at = self.apart, np.array(about)
        angles = np.arange(16) * np.pi / 8
        ring = np.column_stack([np.cos(angles), np.sin(angles)])
        rings = [at + radius * apart * ring for radius in (0.8, 1.2, 1.7, 2.3)]
        tried = np.concatenate(rings if beside else [at[None], *rings])
        tried = tried[((tried > apart / 3) & (tried < self.size - apart / 3)).all(axis=1)]
        free = [p for p in tried if all(np.linalg.norm((p - q) * (1, 1.4)) > apart for q in self.taken)]
        x, y = (free[0] if free else np.clip(at, apart / 3, self.size - apart / 3)).tolist()
        self.taken.append(np.array([x, y]))
        return Tag(text, (x, y), about)
