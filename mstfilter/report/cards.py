"""The pictures of a pause, ready for a page: hypotheses that are the same share a card.

>>> cards, hidden = cards_of_pause(run, t, identities, view)
>>> cards[0].overlay, cards[0].voxels           # data URIs of RGBA pictures
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.report.identities import TRUTH, Identities, by_weight
from mstfilter.report.palette import colour, hexadecimal
from mstfilter.report.pictures import layer, png_bytes, voxel_picture
from mstfilter.scene import Camera, Hypothesis, VoxelGrid, project
from mstfilter.study import RunFolder

__all__ = ["Card", "Tag", "cards_of_pause", "close_up", "data_uri", "truth_card"]

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
