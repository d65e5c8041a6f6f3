"""What is measured of the divisions of a region: numbers, and a picture of the seam.

The *seam* of a division is where its two sides meet in the image. A person who wonders whether there is one object or
two looks at its ends, where the outlines of two objects do not quite fit, and along it, for a line that goes straight
through faces, prints and edges. So each division is described by

- the `FEATURES` of the pair of its sides, as those that the tree merges;
- `SEAM_FEATURES`: how the evidence runs along the seam, how well the sides fit to each other, whether the region or
  its sides are the more compact, what the tree says of the most similar of its own merges, and by which angle the
  upright faces of one side are turned against those of the other (parts of one thing are parallel, things that were
  set down beside each other hardly ever);
- a *strip*: an image of `STRIP` pixels that follows the seam, in `STRIP_CHANNELS`.

>>> measures = SeamMeasures.of(image)
>>> x, strips = measures.describe(pixels, divisions(image, pixels))       # (k, f) float32, (k, c, 64, 24) uint8
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from mstfilter.mst.segmentation.boundary import filled_disparity
from mstfilter.mst.segmentation.divisions import KINDS, Division, SeamImage
from mstfilter.mst.segmentation.pair_measures import FEATURES, pair_features
from mstfilter.mst.segmentation.regions import BORDER_SIGN, REGION, border_terms, edge_maps, pixel_terms
from mstfilter.scene import posed_camera, scaled_length

STRIP = (64, 24)  #: pixels along and across the seam
#: Channels of a strip: the two sides; other objects; whether there is a reading; boundary map; log odds of a border;
#: relief of the disparity; slope of the disparity across and along the seam; height; Lab colour; distance from the
#: plane.
STRIP_CHANNELS = (
    *("first", "second", "others", "reading", "boundary", "border", "relief"),
    *("slope across", "slope along", "height", "lightness", "a", "b", "distance"),
)
SEAM_FEATURES = (
    *KINDS,
    *("log length", "length share", "size ratio", "log region"),
    *("seam evidence", "seam low evidence", "seam strong share", "region evidence", "seam border"),
    *("step along", "top gap", "bottom gap", "near end", "far end"),
    *("hull gain", "solid region", "solid sides", "ground hull gain", "rectangle gain"),
    *("tree overlap", "tree odds", "divided above"),
    *("turn", "flat faces", "face pixels"),
)
_LEVELS = 128.0  # a strip stores x as rint(x * 64) + 128, so -2 .. 1.98 in 256 levels
_REACH = 1.3  # a strip is so many times as long as its seam
_NEAR = 0.025  # metres from the plane within which the ends of the sides are compared
_FACE = 4.0  # pixels of an image of 640 x 480, blur of the slopes from which normals are found
_FLAT, _AWAY = 0.25, 3.0  # strength of the curvature of a face, and pixels of such an image to what is no face
_MOST_TURN = 12.0  # degrees


@dataclass(frozen=True, eq=False)
class SeamMeasures:
    """Measures divisions of the regions of one image."""

    image: SeamImage
    objects: np.ndarray  #: (H, W) bool, all pixels of objects
    maps: np.ndarray  #: (H, W, 4), see `edge_maps`
    smooth: np.ndarray  #: (H, W)
    terms: np.ndarray  #: (p, C) of the pixels of objects with a reading, with the heights
    term_of: np.ndarray  #: (H, W) row of `terms`, -1 for none
    faces: np.ndarray  #: (H, W) complex, see `_upright_faces`

    @classmethod
    def of(cls, image: SeamImage, objects: np.ndarray) -> SeamMeasures:
        """The measures of an image with the pixels (H, W) bool of its objects."""
        bend, maps, smooth = edge_maps(image.frame, image.boundary, image.seen)
        at = np.nonzero(objects & image.frame.valid)
        terms, bins = pixel_terms(image.frame, bend, image.seen, at)
        terms[np.arange(len(bins)), REGION["heights"].start + bins] = 1
        term_of = np.full(objects.shape, -1)
        term_of[at] = np.arange(len(bins))
        flat = objects & image.frame.valid & (np.maximum(maps[..., 1], maps[..., 2]) < _FLAT)
        return cls(image, objects, maps, smooth, terms, term_of, _upright_faces(image, smooth, flat))

    @cached_property
    def _channels(self) -> list[list[np.ndarray]]:
        """The channels of strips that do not depend on the seam, at full and at half size.

        Each is in parts (H, W, 4), since OpenCV warps no more channels at once.
        """
        image, frame = self.image, self.image.frame
        width = frame.depth.shape[1]
        disparity = filled_disparity(frame)
        relief = disparity - cv2.GaussianBlur(disparity, (0, 0), scaled_length(12, width))
        lab = cv2.cvtColor(frame.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
        slopes = (cv2.Sobel(self.smooth, cv2.CV_32F, *axis) / 8 for axis in ((1, 0), (0, 1)))
        planes = [
            self.objects.astype(np.float32),
            frame.valid.astype(np.float32),
            image.boundary,
            image.seen.border / 6,
            relief / 16,
            *slopes,
            np.nan_to_num(image.points[..., 2]) * 8,
            (lab[..., 0] - 50) / 50,
            lab[..., 1] / 50,
            lab[..., 2] / 50,
            np.zeros_like(image.boundary),
        ]
        full = [np.clip(np.stack(planes[k : k + 4], axis=-1), -2, 2).astype(np.float32) for k in (0, 4, 8)]
        half = [cv2.resize(part, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for part in full]
        return [full, half]

    def describe(
        self, pixels: np.ndarray, found: list[Division], below: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Features (k, f) float32 and strips (k, c, *STRIP) uint8 of divisions of a region with flat pixels (n,).

        `below` says that the region is a side of another division. Of six equal boxes, three are more probably
        several objects if the six are.
        """
        region = _Region(self, pixels)
        x = np.column_stack([region.pair_features(found), region.seam_features(found, below)])
        strips = np.stack([region.strip(division) for division in found])
        return x.astype(np.float32), strips


def _upright_faces(image: SeamImage, smooth: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """How upright faces are turned about the vertical: (H, W) complex, ``w exp(4 i angle)``.

    The angle is that of the horizontal part of the surface normal. Faces at right angles count alike, so a sum over
    the pixels of a box has the angle of the box. The weight w, 0 to 1, is small where a face is not upright, and 0 at
    bends and borders, which are pixels that are not `flat` (H, W) and those beside them. The normal follows from the
    gradient of the `smooth` disparity (H, W), which is linear on a plane.
    """
    camera, width = posed_camera(image.frame), flat.shape[1]
    reach = 2 * max(1, round(scaled_length(_AWAY, width))) + 1
    trusted = cv2.erode((flat & (image.evidence < 0.5)).astype(np.float32), np.ones((reach, reach), np.uint8))
    sigma = scaled_length(_FACE, width)
    mass = cv2.GaussianBlur(trusted, (0, 0), sigma)
    x, y = (
        cv2.GaussianBlur(trusted * cv2.Sobel(smooth, cv2.CV_32F, *axis) / 8, (0, 0), sigma) / np.maximum(mass, 1e-3)
        for axis in ((1, 0), (0, 1))
    )
    x, y, rays = x * camera.K[0, 0], y * camera.K[1, 1], camera.rays()
    normal = np.stack([x, y, smooth - x * rays[..., 0] - y * rays[..., 1]], axis=-1)
    normal = normal @ camera.pose.rotation.as_matrix().T
    across = normal[..., 0] + 1j * normal[..., 1]
    upright = np.abs(across) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-9)
    return np.asarray(trusted * upright**6 * (across / np.maximum(np.abs(across), 1e-12)) ** 4)


class _Region:
    """The pixels of one region with their terms, and the pairs of neighbouring pixels in it."""

    def __init__(self, measures: SeamMeasures, pixels: np.ndarray) -> None:
        self.measures, self.image, self.pixels = measures, measures.image, pixels
        h, w = self.image.evidence.shape
        self.rows, self.columns = np.divmod(pixels, w)
        self.box = (self.rows.min(), self.rows.max() + 1, self.columns.min(), self.columns.max() + 1)
        self.index = np.full((h, w), -1)
        self.index.ravel()[pixels] = np.arange(len(pixels))
        which = measures.term_of.ravel()[pixels]
        self.read = which >= 0
        self.terms = measures.terms[which[self.read]]
        self.points = self.image.points.reshape(-1, 3)[pixels[self.read]]
        self.faces = measures.faces.ravel()[pixels]
        self.pairs = []
        self.outside = np.zeros(len(pixels))  # number of neighbours outside the region
        for axis in (0, 1):
            last = self.index.shape[axis] - 1
            a = np.take(self.index, np.arange(last), axis)
            b = np.take(self.index, np.arange(1, last + 1), axis)
            both = np.nonzero((a >= 0) & (b >= 0))
            self.pairs.append((a[both], b[both], axis, both))
            for here, there in ((a, b), (b, a)):
                self.outside += np.bincount(here[(here >= 0) & (there < 0)], minlength=len(pixels))

    def pair_features(self, found: list[Division]) -> np.ndarray:
        """`FEATURES` (k, f) of the two sides. Borders with the table are those with anything outside the region."""
        sides = np.array([one.side for one in found])
        inside = sides[:, self.read].astype(float)
        total = self.terms.sum(axis=0)
        a = inside @ self.terms
        b = total - a
        border = np.zeros((len(found), len(BORDER_SIGN)))
        for k, side in enumerate(sides):
            for i, j, axis, at in self.pairs:
                crossing = side[i] != side[j]
                rows = border_terms(self.measures.maps, self.measures.smooth, axis, tuple(x[crossing] for x in at))
                rows[side[j[crossing]]] *= BORDER_SIGN
                border[k] += rows.sum(axis=0)
        around = sides @ self.outside, (~sides) @ self.outside
        for sums, outside in zip((a, b), around, strict=True):
            sums[:, REGION["perimeter"].start] = outside + border[:, 0]
        none = np.zeros_like(border)
        scale = scaled_length(1, self.index.shape[1])
        self.border = border
        return pair_features(a, b, border, none, none, scale, FEATURES)

    def seam(self, side: np.ndarray) -> np.ndarray:
        """The pixels (m, 2) (column, row) of the seam."""
        found = []
        for i, j, _, _ in self.pairs:
            crossing = side[i] != side[j]
            for k in (i[crossing], j[crossing]):
                found.append(np.column_stack([self.columns[k], self.rows[k]]))
        return np.concatenate(found)

    def seam_features(self, found: list[Division], below: bool) -> np.ndarray:
        """`SEAM_FEATURES` (k, f)."""
        evidence = self.image.evidence
        w = evidence.shape[1]
        scale = scaled_length(1, w)
        wide = cv2.dilate(evidence, np.ones((3, 3), np.uint8))
        usual = float(evidence.ravel()[self.pixels].mean())
        n = len(self.pixels)
        all_hull, all_ground, all_box = self._hulls(np.ones(n, bool))
        rows = []
        for division in found:
            side = division.side
            seam = self.seam(side)
            if not len(seam):
                rows.append([0.0] * len(SEAM_FEATURES))
                continue
            on = wide[seam[:, 1], seam[:, 0]]
            border = self.image.seen.border[seam[:, 1], seam[:, 0]]
            small = min(side.sum(), n - side.sum())
            hulls = np.array([self._hulls(part) for part in (side, ~side)])
            rows.append(
                [
                    *(float(division.kind == kind) for kind in KINDS),
                    np.log(len(seam) / scale),
                    np.log(len(seam) / np.sqrt(small)),
                    abs(np.log(side.sum() / (n - side.sum()))),
                    np.log(n / scale**2),
                    float(on.mean()),
                    float(np.sort(on)[len(on) // 4]),
                    float((on > 0.4).mean()),
                    usual,
                    float(np.clip(border, -6, 6).mean()),
                    *self._fit(division),
                    float(np.log(all_hull / hulls[:, 0].sum())),
                    float(np.log(n / all_hull)),
                    float(np.log(n / hulls[:, 0].sum())),
                    float(np.log(all_ground / max(hulls[:, 1].sum(), 1e-6))),
                    float(np.log(all_box / max(hulls[:, 2].sum(), 1e-6))),
                    *(division.overlap, division.odds, float(below)),
                    *self._turn(side),
                ]
            )
        return np.array(rows)

    def _hulls(self, part: np.ndarray) -> tuple[float, float, float]:
        """Areas of the convex hull in the image (pixels) and on the ground, and of the smallest rectangle (m2)."""
        rows, columns = self.rows[part], self.columns[part]
        new = np.flatnonzero(np.diff(rows, prepend=-1))  # pixels are in the order of the rows
        ends = np.concatenate([new, np.append(new[1:], len(rows)) - 1])
        hull = cv2.convexHull(np.column_stack([columns[ends], rows[ends]]).astype(np.int32))
        # A pixel has an area, so the hull of its corners is larger than that of its middle.
        image = cv2.contourArea(hull) + cv2.arcLength(hull, True) / 2 + 1
        points = self.points[_some(np.flatnonzero(part[self.read]))][:, :2].astype(np.float32)
        if len(points) < 5:
            return image, 1e-6, 1e-6
        ground = cv2.convexHull(points)
        _, size, _ = cv2.minAreaRect(ground)
        return image, max(cv2.contourArea(ground), 1e-6), max(size[0] * size[1], 1e-6)

    def _fit(self, division: Division) -> list[float]:
        """How the sides differ near the plane, in cm: median step along it, heights, and ends along it."""
        if division.kind == "tree":
            normal, offset = np.zeros(3), 0.0
            side = division.side[self.read]
            near = np.ones(len(side), bool)
            tangent = np.array([1.0, 0.0, 0.0])
        else:
            normal, offset = division.normal, division.offset
            along = self.points @ normal - offset
            side = along < 0
            near = np.abs(along) < _NEAR
            tangent = np.array([-normal[1], normal[0], 0.0]) if not normal[2] else np.array([1.0, 0.0, 0.0])
        a, b = (self.points[_some(np.flatnonzero(near & one))] for one in (side, ~side))
        if min(len(a), len(b)) < 20:
            return [0.0] * 5
        heights = [_spread(part[:, 2]) for part in (a, b)]
        ends = [_spread(part @ tangent) for part in (a, b)]
        gaps = 100 * (np.array(ends[0]) - ends[1])
        up = 100 * (np.array(heights[0]) - heights[1])
        return np.clip(np.abs([gaps[1], up[2], up[0], gaps[0], gaps[2]]), 0, 6).tolist()

    def _turn(self, side: np.ndarray) -> list[float]:
        """Angle in degrees between faces of the sides, how well they agree (0 to 1), and log of their pixels."""
        parts = [self.faces[one] for one in (side, ~side)]
        weights = [float(np.abs(part).sum()) for part in parts]
        a, b = (part.sum() / max(weight, 1e-9) for part, weight in zip(parts, weights, strict=True))
        turn = np.rad2deg(abs(np.angle(a * np.conj(b)))) / 4
        pixels = min(weights) / scaled_length(1, self.index.shape[1]) ** 2
        return [min(turn, _MOST_TURN), abs(a * b), float(np.log1p(pixels))]

    def strip(self, division: Division) -> np.ndarray:
        """The strip (c, *STRIP) uint8 of a division."""
        seam = self.seam(division.side).astype(np.float64)
        if not len(seam):
            return np.full((len(STRIP_CHANNELS), *STRIP), _LEVELS, np.uint8)
        middle = seam.mean(axis=0)
        spread = seam - middle
        axis = np.linalg.eigh(spread.T @ spread)[1][:, 1]
        axis *= -1 if axis[1] < 0 or (axis[1] == 0 and axis[0] < 0) else 1  # downwards in the image
        across = np.array([axis[1], -axis[0]])  # to the right
        reach = np.abs(spread @ axis).max() + 2
        middle = middle + axis * ((spread @ axis).max() + (spread @ axis).min()) / 2
        length, breadth = STRIP
        unit = max(2 * _REACH * reach / length, 0.5)
        # Pixel (i, j) of the strip is at middle + unit ((i - l / 2) axis + (j - b / 2) across).
        matrix = np.column_stack([unit * across, unit * axis, middle])
        matrix[:, 2] -= unit * ((breadth - 1) / 2 * across + (length - 1) / 2 * axis)

        def warped(parts: list[np.ndarray], matrix: np.ndarray) -> np.ndarray:
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            return np.concatenate(
                [cv2.warpAffine(part, matrix, (breadth, length), flags=flags) for part in parts], axis=-1
            )

        half = unit > 2
        fixed = warped(self.measures._channels[int(half)], matrix * 0.5 if half else matrix)
        top, bottom, left, right = self.box
        h, w = bottom - top + 2, right - left + 2
        masks = np.zeros((h, w, 4), np.float32)
        at = self.rows - top + 1, self.columns - left + 1
        masks[(*at, 0)], masks[(*at, 1)] = division.side, ~division.side
        if division.kind != "tree":
            points = self.image.points.reshape(-1, 3)[self.pixels]
            masks[(*at, 2)] = np.clip(np.nan_to_num(points @ division.normal - division.offset) * 30, -2, 2)
        shifted = matrix.copy()
        shifted[:, 2] -= (left - 1, top - 1)
        own = warped([masks], shifted)
        first, second = own[..., 0], own[..., 1]
        flip = (first * np.arange(breadth)).sum() * second.sum() > (second * np.arange(breadth)).sum() * first.sum()
        if flip:  # the first side is on the left
            first, second = second, first
        slope_x, slope_y = fixed[..., 5], fixed[..., 6]
        turned = slope_x * across[0] + slope_y * across[1], slope_x * axis[0] + slope_y * axis[1]
        planes = [
            first,
            second,
            np.clip(fixed[..., 0] - first - second, 0, 1),
            *np.moveaxis(fixed[..., 1:5], -1, 0),
            *turned,
            *np.moveaxis(fixed[..., 7:11], -1, 0),
            own[..., 2] * (-1 if flip else 1),
        ]
        return np.clip(np.rint(np.stack(planes) * 64 + _LEVELS), 0, 255).astype(np.uint8)


def _some(index: np.ndarray) -> np.ndarray:
    """Every so many of the entries (n,), about 800 of them."""
    return index[:: max(1, len(index) // 800)]


def _spread(values: np.ndarray) -> np.ndarray:
    """The percentiles 3, 50 and 97."""
    return np.sort(values)[(np.array([0.03, 0.5, 0.97]) * (len(values) - 1)).astype(int)]
