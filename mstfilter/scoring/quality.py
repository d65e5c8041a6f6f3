"""Quality of a segmentation, trivial baselines, and the visibility of objects.

For every region of a segmentation, weighted coverage takes the largest Jaccard index J with a region of another
segmentation. Weighted coverage is the mean of J, weighted by the sizes of regions:

    ``side(A -> B) = sum_{a in A} size(a) max_{b in B} J(a, b)``

Weighted coverage has three forms:

``objects`` (default)
    ``q = (side(A->B) / V_A + side(B->A) / V_B) / 2``. Only objects are regions; V_A is the volume of all of A.
``paper``
    The published text (Price et al. 2021, section V). Free space is a region too, and both sides are divided by the
    size of the grid.
``authors``
    The formula of the authors' program. Only objects are regions, and both sides are divided by V_A.

>>> import numpy as np
>>> a = np.array([1, 1, 2, 2, 0]); b = np.array([1, 1, 1, 1, 0])
>>> weighted_coverage(a, b)
0.5

`one_blob` and `connected_components` are trivial baselines that are shown beside every quality. Trivial baselines
keep the occupied voxels of a hypothesis and change only the object labels. A filter that is not better than a trivial
baseline detects occupied space but not objects.

>>> object_status(recording, 2)  # doctest: +SKIP
{1: 'visible', 2: 'hidden', 3: 'unseen'}

Quality is also computed for visible, hidden and unseen objects. No method can represent an object that was never
seen. The quality of hidden objects shows the contribution of tracking.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.scene import Recording, as_labels, scaled_area

Form = Literal["objects", "paper", "authors"]
FORMS: tuple[Form, ...] = get_args(Form)


@dataclass(frozen=True, eq=False)
class Overlap:
    """Sizes of the regions of two segmentations and of their intersections, including the region of label 0.

    Parameters
    ----------
    labels_a, labels_b : (na,), (nb,) int
        Labels that occur, ascending.
    counts : (na, nb) int
        Cells with label ``labels_a[i]`` in a and ``labels_b[j]`` in b.
    """

    labels_a: np.ndarray
    labels_b: np.ndarray
    counts: np.ndarray

    @property
    def sizes_a(self) -> np.ndarray:
        """Number (na,) of cells of each region of a."""
        return self.counts.sum(axis=1)

    @property
    def sizes_b(self) -> np.ndarray:
        """Number (nb,) of cells of each region of b."""
        return self.counts.sum(axis=0)

    def jaccard(self) -> np.ndarray:
        """Intersection over union (na, nb) of each region of a with each region of b."""
        union = self.sizes_a[:, None] + self.sizes_b[None, :] - self.counts
        return self.counts / union

    def objects(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Intersections (na, nb), sizes (na,), (nb,), and intersections over union of objects, without label 0."""
        rows, columns = self.labels_a > 0, self.labels_b > 0
        box = np.ix_(rows, columns)
        return self.counts[box], self.sizes_a[rows], self.sizes_b[columns], self.jaccard()[box]


def overlap(a: np.ndarray, b: np.ndarray) -> Overlap:
    """The contingency table of two label arrays of the same shape, in one pass."""
    a, b = as_labels(a, "first segmentation"), as_labels(b, "second segmentation")
    if a.shape != b.shape:
        raise InputError(f"segmentations have shapes {a.shape} and {b.shape}, expected the same shape")
    compact_a, labels_a = _compact(a)
    compact_b, labels_b = _compact(b)
    na, nb = len(labels_a), len(labels_b)
    counts = np.bincount(compact_a.ravel() * nb + compact_b.ravel(), minlength=na * nb)
    return Overlap(labels_a, labels_b, counts.reshape(na, nb))


def _compact(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    present = np.flatnonzero(np.bincount(labels.ravel(), minlength=1))
    table = np.zeros(int(present[-1]) + 1 if len(present) else 1, np.int64)
    table[present] = np.arange(len(present))
    return table[labels], present


def weighted_coverage(a: np.ndarray, b: np.ndarray, form: Form = "objects") -> float:
    """Quality of segmentation `a` against `b` in [0, 1].

    Parameters
    ----------
    a, b : integer arrays of the same shape
        Labels, 0 is background or free.
    form : {"objects", "paper", "authors"}
        The module describes the forms. The quality is 1 without any objects. Except in the form ``paper``, it is 0 if
        only one argument has objects.
    """
    return quality_of(overlap(a, b), form)


def quality_of(table: Overlap, form: Form = "objects") -> float:
    """`weighted_coverage` of two segmentations from their contingency table."""
    if form not in FORMS:
        raise InputError(f"quality has no form {form!r}", f"there are: {', '.join(FORMS)}")
    if form == "paper":
        sizes_a, sizes_b, jaccard = table.sizes_a, table.sizes_b, table.jaccard()
    else:
        _, sizes_a, sizes_b, jaccard = table.objects()
    volume_a, volume_b = sizes_a.sum(), sizes_b.sum()
    if volume_a == 0 or volume_b == 0:
        return 1.0 if volume_a == volume_b else 0.0
    side_a = (sizes_a * jaccard.max(axis=1)).sum()
    side_b = (sizes_b * jaccard.max(axis=0)).sum()
    if form == "objects":
        return float((side_a / volume_a + side_b / volume_b) / 2)
    return float((side_a + side_b) / (2 * volume_a))


def one_blob(labels: np.ndarray) -> np.ndarray:
    """All occupied voxels as one object, (X, Y, Z) uint16."""
    return (labels > 0).astype(np.uint16)


def connected_components(labels: np.ndarray) -> np.ndarray:
    """Connected components of the occupied voxels (sharing a face), (X, Y, Z) int32."""
    from scipy.ndimage import label

    return label(labels > 0)[0]


Status = Literal["visible", "hidden", "unseen"]
STATUSES: tuple[Status, ...] = get_args(Status)

MIN_PIXELS = 100  # of a 640 x 480 image: 2.3 cm^2 at 0.8 m


def object_status(recording: Recording, t: int, min_pixels: float = MIN_PIXELS) -> dict[int, Status]:
    """Status of every object that has true voxels at pause `t`, by its label, ascending.

    A *visible* object is in the instance image of the pause, a *hidden* object only in an earlier image, and an
    *unseen* object in no image. Frames between pauses are not used.

    Parameters
    ----------
    recording : Recording
        A recording with true voxels and instance images at the pauses.
    t : int
        Number of the pause.
    min_pixels : float
        An object with at least this number of pixels in an image of 640 x 480 pixels counts as shown. The number
        scales with the area of the image.

    Raises
    ------
    InputError
        If the recording has no true voxels at pause `t`, or no instance image at pause `t` or at an earlier pause.
    """
    if not 0 <= t < len(recording.pauses):
        raise InputError(f"recording {recording.name} has no pause {t}, it has {len(recording.pauses)}")
    labels = recording.truth(t)
    if labels is None:
        raise InputError(f"recording {recording.name} has no true voxels at pause {t}")
    shown = [shown_objects(_instance(recording, earlier), min_pixels) for earlier in range(t + 1)]
    return status_of(labels, shown[t], set().union(*shown[:t]))


def status_of(labels: np.ndarray, visible: Set[int], earlier: Set[int]) -> dict[int, Status]:
    """Status of the objects of true `labels`, given objects `visible` in the image, and those in `earlier` images."""
    present = np.unique(labels[labels > 0]).tolist()
    return {k: "visible" if k in visible else "hidden" if k in earlier else "unseen" for k in present}


def shown_objects(image: np.ndarray, min_pixels: float = MIN_PIXELS) -> set[int]:
    """Labels with enough pixels in an instance image (H, W). `object_status` explains `min_pixels`."""
    counts = np.bincount(image.ravel())
    return set(np.flatnonzero(counts >= max(1.0, scaled_area(min_pixels, image.size))).tolist())


def _instance(recording: Recording, t: int) -> np.ndarray:
    image = recording.instance(recording.pauses[t])
    if image is None:
        raise InputError(f"recording {recording.name} has no instance image at pause {t}")
    return image
