"""Which object is which, over hypotheses and over time, so that the same object keeps its colour.

>>> identities = identity_colours(run)              # Identities of a whole run
>>> identities.of(t, hypothesis_index)              # {label: identity 0, 1, 2, ...}
>>> identities.colours(t, hypothesis_index)         # {label: (r, g, b)}

Hypotheses number their objects on their own, so labels say nothing across them. Within one pause, objects are
alike where their voxels overlap. From pause to pause an object is followed through the hypothesis it descends
from by its stable id, wherever it has moved; else by the overlap with what was seen there at the last pause.
Truth, where present, takes part first, as one more hypothesis whose labels persist. The assignment is for the
eye alone: it enters no number.


The pictures of a pause, ready for a page: hypotheses that are the same share a card.

>>> cards, hidden = cards_of_pause(run, t, identities, view)
>>> cards[0].overlay, cards[0].voxels           # data URIs of RGBA pictures
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mstfilter.report.pictures import Colour, colour, hexadecimal, layer, png_bytes, voxel_picture
from mstfilter.runs import RunFolder
from mstfilter.scene import Camera, Hypothesis, VoxelGrid, project
from mstfilter.scoring import overlap

__all__ = [
    "Card",
    "Identities",
    "Tag",
    "by_weight",
    "cards_of_pause",
    "close_up",
    "data_uri",
    "identity_colours",
    "truth_card",
]

TRUTH = -1  # stands where the index of a hypothesis stands

_INHERITED = 0.5  # what descent is worth beside an overlap (Jaccard index) of 1 at this pause
_EARLIER = 0.4  # what an overlap of 1 with the last pause is worth
_LEAST = 0.2  # less evidence than this makes a new identity
_PERSISTS = 2.0  # labels of the truth outweigh any overlap
_REFERENCES = 6  # hypotheses of a pause that later ones are compared with


@dataclass(frozen=True)
class Identities:
    """Identity of every object of every hypothesis.

    Parameters
    ----------
    table : mapping
        ``(pause, hypothesis) -> {label: identity}``; hypothesis -1 is the truth.
    """

    table: Mapping[tuple[int, int], Mapping[int, int]] = field(default_factory=dict)

    def of(self, t: int, k: int) -> Mapping[int, int]:
        """``{label: identity}`` of hypothesis `k` (-1: the truth) at pause `t`."""
        return self.table.get((t, k), {})

    def colours(self, t: int, k: int) -> dict[int, Colour]:
        """``{label: (r, g, b)}`` of hypothesis `k` (-1: the truth) at pause `t`."""
        return {label: colour(identity) for label, identity in self.of(t, k).items()}


def identity_colours(run: RunFolder) -> Identities:
    """Identities of all objects of a run, pause by pause."""
    book = _Book()
    for t in range(run.n_pauses):
        info = run.info(t)
        parents = dict(info.get("parents") or {}).get("previous")
        book.add(t, run.hypotheses(t), info["weights"], parents, run.truth(t))
    return Identities(book.table)


class _Book:
    """Identities so far, and where each was last seen."""

    def __init__(self) -> None:
        self.table: dict[tuple[int, int], dict[int, int]] = {}
        self._ids: dict[tuple[int, int], dict[int, int]] = {}  # (pause, hypothesis) -> {stable id: identity}
        # Voxels with identity + 1 (0 none) of the truth and the heaviest hypotheses: of this pause, of the last.
        self._now: list[np.ndarray] = []
        self._before: list[np.ndarray] = []
        self._n = 0

    def add(
        self,
        t: int,
        hypotheses: Sequence[Hypothesis],
        weights: Sequence[float],
        parents: Sequence[int] | None,
        truth: np.ndarray | None,
    ) -> None:
        """All hypotheses of a pause: truth first, then by weight."""
        self._before, self._now = self._now, []
        if truth is not None:
            labels = np.flatnonzero(np.bincount(truth.ravel(), minlength=1)[1:]) + 1
            ids = {int(k): int(k) for k in labels}
            self._assign(t, TRUTH, truth, ids, self._ids.get((t - 1, TRUTH), {}), _PERSISTS)
        first: dict[bytes, int] = {}
        for k in by_weight(weights):
            h = hypotheses[k]
            ids = {o.label: o.id for o in h.objects}
            same = first.setdefault(h.key, k)
            if same != k:
                self.table[t, k] = self.table[t, same]
                self._ids[t, k] = {ids[label]: identity for label, identity in self.table[t, k].items()}
                continue
            parent = -2 if parents is None else int(parents[k])
            self._assign(t, k, h.labels, ids, self._ids.get((t - 1, parent), {}), _INHERITED)

    def _assign(
        self,
        t: int,
        k: int,
        labels: np.ndarray,
        ids: Mapping[int, int],
        inherited: Mapping[int, int],
        descent: float,
    ) -> None:
        from scipy.optimize import linear_sum_assignment

        own = list(ids)
        score = np.zeros((len(own), self._n))
        if own and self._n:
            for images, worth in ((self._now, 1.0), (self._before, _EARLIER)):
                overlaps = [_overlaps(labels, image, own, self._n) for image in images]
                if overlaps:
                    score += worth * np.max(overlaps, axis=0)
        for row, label in enumerate(own):
            identity = inherited.get(ids[label])
            if identity is not None:
                score[row, identity] += descent
        rows, columns = linear_sum_assignment(-score)
        pairs = zip(rows.tolist(), columns.tolist(), strict=True)
        found = {own[r]: int(c) for r, c in pairs if score[r, c] >= _LEAST}
        for label in own:
            if label not in found:
                found[label] = self._n
                self._n += 1
        self.table[t, k] = {label: found[label] for label in own}
        self._ids[t, k] = {ids[label]: found[label] for label in own}
        if len(self._now) < _REFERENCES:
            lookup = np.zeros(int(labels.max()) + 1, np.int64)
            for label, identity in found.items():
                lookup[label] = identity + 1
            self._now.append(lookup[labels])


def by_weight(weights: Sequence[float]) -> list[int]:
    """Indices from the heaviest to the lightest; equal ones in their order."""
    return sorted(range(len(weights)), key=lambda k: -weights[k])


def _overlaps(labels: np.ndarray, image: np.ndarray, own: list[int], n: int) -> np.ndarray:
    """Jaccard indices (len(own), n) of objects and identities."""
    table = overlap(labels, image)
    jaccard = table.jaccard()
    out = np.zeros((len(own), n))
    where = {int(label): row for row, label in enumerate(table.labels_a)}
    present = table.labels_b > 0
    for row, label in enumerate(own):
        if label in where:
            out[row, table.labels_b[present] - 1] = jaccard[where[label], present]
    return out


MOST_CARDS = 12


@dataclass(frozen=True)
class Tag:
    """The number of an object, where it stands in the image; x, y in pixels."""

    text: str
    colour: str
    x: float
    y: float


@dataclass(frozen=True)
class Card:
    """One hypothesis (or several that are the same, or the truth) at one pause."""

    indices: tuple[int, ...]
    weight: float
    n_objects: int
    voxels_occupied: int
    quality: float | None
    overlay: str
    voxels: str
    tags: tuple[Tag, ...]

    @property
    def name(self) -> str:
        """``#0`` or ``#0, #3``, ``truth`` where it is that."""
        if not self.indices:
            return "truth"
        names = [f"#{k}" for k in self.indices[:4]]
        more = len(self.indices) - len(names)
        return ", ".join(names) + (f" and {more} more" if more else "")


def data_uri(data: bytes, kind: str = "png") -> str:
    """Bytes of an image as a data URI."""
    return f"data:image/{kind};base64,{b64encode(data).decode()}"


def cards_of_pause(run: RunFolder, t: int, identities: Identities, view: Camera) -> tuple[list[Card], float]:
    """Cards of the distinct hypotheses of a pause, heaviest first, and the weight of those that are not shown."""
    info, hypotheses, camera = run.info(t), run.hypotheses(t), run.camera(t)
    groups: dict[bytes, list[int]] = {}
    for k, h in enumerate(hypotheses):
        groups.setdefault(h.key, []).append(k)
    weight = [sum(info["weights"][k] for k in members) for members in groups.values()]
    order = by_weight(weight)
    members = list(groups.values())
    quality = info.get("quality")
    cards = []
    for g in order[:MOST_CARDS]:
        k = members[g][0]
        q = None if quality is None else quality["objects"][k]
        cards.append(_card(hypotheses[k], camera, tuple(members[g]), weight[g], q, identities.of(t, k), view))
    return cards, float(sum(weight[g] for g in order[MOST_CARDS:]))


def truth_card(run: RunFolder, t: int, identities: Identities, view: Camera) -> Card | None:
    """The truth of a pause; None where it is unknown."""
    truth = run.truth(t)
    if truth is None:
        return None
    hypothesis = Hypothesis.from_labels(truth, run.hypotheses(t)[0].grid)
    return _card(hypothesis, run.camera(t), (), 0.0, None, identities.of(t, TRUTH), view)


def close_up(volumes: Sequence[tuple[np.ndarray, VoxelGrid]], camera: Camera) -> tuple[float, float, float, float]:
    """The part of the image that shows all occupied voxels, with a margin: x, y, width, height in pixels.

    It has the proportions of the image, and is the whole image where nothing is occupied.
    """
    occupied: dict[bytes, tuple[np.ndarray, VoxelGrid]] = {}
    for labels, grid in volumes:
        seen = occupied.get(grid.key)
        occupied[grid.key] = ((labels > 0) if seen is None else seen[0] | (labels > 0), grid)
    size = np.array([camera.width, camera.height], float)
    uv = np.concatenate([camera.project(g.centre_of(np.argwhere(mask)))[0] for mask, g in occupied.values()])
    uv = np.clip(uv[np.isfinite(uv).all(axis=-1)], 0, size)
    if len(uv) == 0:
        return 0.0, 0.0, *size.tolist()
    lower, upper = uv.min(axis=0), uv.max(axis=0)
    share = float(np.clip(((upper - lower) / size).max() * 1.3 + 0.06, 0.2, 1))
    corner = np.clip((lower + upper - share * size) / 2, 0, (1 - share) * size)
    x, y, width, height = np.round([*corner, *(share * size)], 1).tolist()
    return x, y, width, height


def _card(
    hypothesis: Hypothesis,
    camera: Camera,
    indices: Sequence[int],
    weight: float,
    quality: float | None,
    identity: Mapping[int, int],
    view: Camera,
) -> Card:
    colours = {label: colour(i) for label, i in identity.items()}
    image = project(hypothesis, camera)
    # Contours stay about as fine on a small image as on a large one.
    scale = max(1, round(960 / camera.width))
    return Card(
        tuple(indices),
        float(weight),
        hypothesis.n_objects,
        sum(hypothesis.volumes().values()),
        quality,
        data_uri(png_bytes(layer(image, colours, scale=scale, line=max(2, round(scale * camera.width / 340))))),
        data_uri(png_bytes(voxel_picture(hypothesis.labels, hypothesis.grid, view, colours))),
        tuple(_tags(image, identity)),
    )


def _tags(image: np.ndarray, identity: Mapping[int, int]) -> list[Tag]:
    """A number in the widest place of every object that shows enough of itself; larger objects go first."""
    from scipy.ndimage import distance_transform_edt, find_objects

    least, apart = 0.009 * image.shape[1], 0.03 * image.shape[1]
    places = []
    for label, box in enumerate(find_objects(image.astype(np.int32)), 1):
        if box is None or label not in identity:
            continue
        inside = distance_transform_edt(np.pad(image[box] == label, 1))[1:-1, 1:-1]
        row, column = np.unravel_index(int(inside.argmax()), inside.shape)
        places.append((float(inside[row, column]), label, float(column + box[1].start), float(row + box[0].start)))
    tags: list[Tag] = []
    for radius, label, x, y in sorted(places, reverse=True):
        if radius >= least and all(np.hypot(tag.x - x, tag.y - y) > apart for tag in tags):
            tags.append(Tag(str(identity[label] + 1), hexadecimal(colour(identity[label])), x + 0.5, y + 0.5))
    return tags
