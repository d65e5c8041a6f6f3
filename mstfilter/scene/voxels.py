"""Voxel grids, and hypotheses on them.

A `Hypothesis` is the particle of a filter of scenes: an object label for every voxel, where 0 is free space. The z
axis of the world points up, and the table is at z = 0.

>>> import numpy as np
>>> from mstfilter.scene import Hypothesis, VoxelGrid
>>> grid = VoxelGrid((-0.5, -0.5, 0.0), 0.01, (100, 100, 50))
>>> labels = np.zeros(grid.shape, np.uint16)
>>> labels[40:50, 40:50, :10] = 1
>>> Hypothesis.from_labels(labels, grid).volumes()
{1: 1000}
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import IntFlag
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.base.errors import InputError
from mstfilter.base.lazy import late
from mstfilter.scene.arrays import content_key, frozen
from mstfilter.scene.occupancy import Occupancy

MAX_LABEL = 65535
MAX_VOXELS = 2**28
_IDS = MAX_LABEL + 1  # ids of the objects that are first proposed at one pause
_NO_MOTION = RigidTransform.identity()  # shared: making it takes longer than the rest of a record


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """A regular grid of cubic voxels.

    Parameters
    ----------
    origin : (3,) metres
        Minimum corner of the first voxel.
    voxel_size : float
        Edge of a voxel in metres.
    shape : (3,) int
        Number of voxels along x, y, z.
    """

    origin: np.ndarray
    voxel_size: float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        origin, size, counts = (_numbers(v) for v in (self.origin, self.voxel_size, self.shape))
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise InputError(f"grid origin is {self.origin!r}, expected three finite numbers in metres")
        if size.shape != () or not (np.isfinite(size) and size > 0):
            raise InputError(
                f"voxel size is {self.voxel_size!r}, expected metres > 0",
                "for a workspace with two corners: VoxelGrid.from_bounds(lower, upper, voxel_size)",
            )
        if counts.shape != (3,) or not (
            np.isfinite(counts).all() and (counts >= 1).all() and (counts % 1 == 0).all()
        ):
            raise InputError(
                f"grid shape is {self.shape!r}, expected three counts of at least 1",
                "a workspace needs an extent along every axis",
            )
        shape = tuple(int(n) for n in self.shape)
        if shape[0] * shape[1] * shape[2] > MAX_VOXELS:
            raise InputError(
                f"a grid of {shape[0]} x {shape[1]} x {shape[2]} voxels of {float(size):g} m is too large",
                "workspace and voxel size are in metres",
            )
        object.__setattr__(self, "origin", frozen(origin))
        object.__setattr__(self, "voxel_size", float(self.voxel_size))
        object.__setattr__(self, "shape", shape)

    @classmethod
    def from_bounds(cls, lower: np.ndarray, upper: np.ndarray, voxel_size: float) -> VoxelGrid:
        """The grid that covers a box given by two corners in metres."""
        lower, upper, size = _numbers(lower), _numbers(upper), _numbers(voxel_size)
        if size.ndim or not 0 < size < np.inf:
            raise InputError(f"voxel size is {voxel_size!r}, expected one number of metres > 0", "voxels are cubes")
        shapes = lower.shape == upper.shape == (3,)
        if not (shapes and (lower < upper).all() and np.isfinite(upper - lower).all()):
            raise InputError(
                f"workspace from {lower.tolist()} to {upper.tolist()} in voxels of {voxel_size} m has no voxel",
                "min must be below max in all three axes, in metres",
            )
        with np.errstate(over="ignore"):
            shape = np.maximum(1, np.ceil((upper - lower) / size - 1e-6))
        return cls(lower, float(size), tuple(shape.tolist()))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, VoxelGrid) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)

    @cached_property
    def key(self) -> bytes:
        """Content key."""
        return content_key("grid", self.origin, self.voxel_size, self.shape)

    @property
    def text(self) -> str:
        """Size of the workspace and of its voxels, as text for messages."""
        extent = " x ".join(f"{self.voxel_size * n:.2f}" for n in self.shape)
        return f"workspace {extent} m, {' x '.join(map(str, self.shape))} voxels of {1000 * self.voxel_size:g} mm"

    @property
    def upper(self) -> np.ndarray:
        """Corner of the grid with the largest coordinates, (3,) metres."""
        return self.origin + self.voxel_size * np.array(self.shape)

    def centres(self) -> np.ndarray:
        """(X, Y, Z, 3) voxel centres in metres."""
        index = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), axis=-1)
        return self.centre_of(index)

    def centre_of(self, index: np.ndarray) -> np.ndarray:
        """Centres (..., 3) in metres of voxel indices (..., 3)."""
        return self.origin + (np.asarray(index) + 0.5) * self.voxel_size

    def index_of(self, points: np.ndarray) -> np.ndarray:
        """Voxel indices (..., 3) int64 of world points, which may be outside the grid. NaN gives -1."""
        index = np.floor((np.asarray(points) - self.origin) / self.voxel_size)
        return np.where(np.isfinite(index), index, -1).astype(np.int64)

    def contains(self, index: np.ndarray) -> np.ndarray:
        """(...) bool: whether indices (..., 3) are inside the grid."""
        index = np.asarray(index)
        return np.asarray(((index >= 0) & (index < np.array(self.shape))).all(axis=-1))


def _numbers(value: object) -> np.ndarray:
    """Values as float64, or NaN if the values are not numbers."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.array(np.nan)


def occupied_box(mask: np.ndarray) -> tuple[slice, ...] | None:
    """Slices of the smallest box that contains all True cells of a mask, or None for an empty mask."""
    box = []
    for axis in range(mask.ndim):
        hits = np.flatnonzero(mask.any(axis=tuple(a for a in range(mask.ndim) if a != axis)))
        if len(hits) == 0:
            return None
        box.append(slice(int(hits[0]), int(hits[-1]) + 1))
    return tuple(box)


@dataclass(frozen=True, eq=False)
class Crop:
    """Voxels of one object inside a small box of the grid."""

    occupied: np.ndarray  #: (a, b, c) bool, the box
    offset: np.ndarray  #: (3,) int, index of the first voxel of the crop in the grid
    #: (a, b, c) float16, probability that the object occupies the voxel; None: 1 where `occupied` is True, else 0
    probability: np.ndarray | None = None

    def __repr__(self) -> str:
        return f"Crop of {int(self.occupied.sum())} voxels at {self.offset.tolist()}"

    def __post_init__(self) -> None:
        object.__setattr__(self, "occupied", frozen(np.asarray(self.occupied, dtype=bool)))
        object.__setattr__(self, "offset", frozen(np.asarray(self.offset, dtype=np.int64)))
        if self.probability is not None:
            object.__setattr__(self, "probability", frozen(np.asarray(self.probability, dtype=np.float16)))

    @classmethod
    def of(cls, mask: np.ndarray, probability: np.ndarray | None = None) -> Crop:
        """Crop a mask (X, Y, Z) and probabilities to the box of True voxels. An empty mask gives an empty crop."""
        box = occupied_box(mask if probability is None else mask | (probability > 0))
        if box is None:
            return cls(np.zeros((0, 0, 0), bool), np.zeros(3, np.int64))
        offset = np.array([side.start for side in box])
        return cls(mask[box].copy(), offset, None if probability is None else probability[box].copy())

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """Slices of the grid that select the box of the crop."""
        a, b, c = (slice(int(o), int(o) + n) for o, n in zip(self.offset, self.occupied.shape, strict=True))
        return a, b, c


class Seen(IntFlag):
    """Flags for how one frame observes a voxel, relative to one object (`ObjectView.bits`)."""

    SURFACE = 1  #: visible surface of the object
    OTHER_SURFACE = 2  #: visible surface of another object or of the background
    FREE = 4  #: in front of the measured surface
    BEHIND = 8  #: behind the surface of the object
    HIDDEN = 16  #: behind another surface

    def among(self, bits: Any) -> Any:
        """Whether at least one of the flags is set, for each element of a uint8 array or torch tensor."""
        return (bits & int(self)) > 0


@dataclass(frozen=True, eq=False)
class ObjectView:
    """One frame's observation of the voxels of a box around an object, and the object's motion since the frame."""

    offset: np.ndarray  #: (3,) int, index of the box's first voxel in the grid
    bits: np.ndarray  #: (a, b, c) uint8, flags of `Seen`
    signed: np.ndarray  #: (a, b, c) int8, signed distance behind the measured surface (`encode_box`)
    key: str  #: key of the contents
    #: Rigid motion of the object in world metres since the frame.
    motion: RigidTransform = field(default_factory=lambda: _NO_MOTION)
    #: (n,) float32, visible area of each colour (`mstfilter.scene.areas_of_colours`); may be empty.
    colours: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))

    def moved(self, T: RigidTransform) -> ObjectView:
        """The view after a rigid motion T of the object."""
        return replace(self, motion=T * self.motion)

    @cached_property
    def name(self) -> tuple[str, bytes]:
        """Key that identifies the contents and the motion of the view."""
        return self.key, self.motion.as_matrix().tobytes()


@dataclass(frozen=True, eq=False)
class ObjectRecord:
    """Data of one object in a hypothesis: label, identity, motion and views."""

    label: int  #: value of the object in the label grid, 1 .. 65535
    id: int  #: identity of the object over time, within one lineage of hypotheses; different in each object
    birth: int = 0  #: index of the pause at which the object was first proposed
    #: Occupancy of the object after its last change other than a rigid motion. None: its current voxels.
    source: Crop | None = None
    #: Rigid motion in world metres since `source`; the identity if `source` is None.
    motion: RigidTransform = field(default_factory=lambda: _NO_MOTION)
    completion_key: str | None = None  #: key of the image segment from which the object was made
    views: tuple[ObjectView, ...] = ()  #: observations of the object in frames, oldest first
    #: Rigid motion in world metres since the object was first proposed, also across changes of its voxels.
    pose: RigidTransform = field(default_factory=lambda: _NO_MOTION)
    last_seen: int = 0  #: index of the last pause whose image showed the object

    def __repr__(self) -> str:
        moved = ", moved" * (self.pose is not _NO_MOTION)
        return f"ObjectRecord(label={self.label}, id={self.id}, birth={self.birth}{moved})"

    @classmethod
    def born(
        cls,
        label: int,
        birth: int,
        completion_key: str | None = None,
        views: tuple[ObjectView, ...] = (),
        taken: Collection[int] = (),
    ) -> ObjectRecord:
        """The `ObjectRecord` of a new object.

        Each pair of `birth` and `label` gives a different `id`, which is not one of the ids `taken`.
        """
        identity = free_id(birth * _IDS + label, taken)
        return cls(label, identity, birth, completion_key=completion_key, views=views, last_seen=birth)

    def moved(self, T: RigidTransform, source: Crop) -> ObjectRecord:
        """The `ObjectRecord` after a rigid motion T. `source` has the voxels before the first motion."""
        total = T if self.source is None else T * self.motion
        views = tuple(view.moved(T) for view in self.views)
        return replace(self, source=source, motion=total, views=views, pose=T * self.pose)

    def changed(self) -> ObjectRecord:
        """The `ObjectRecord` after a change of the voxels that is not a rigid motion."""
        return replace(self, source=None, motion=_NO_MOTION)


def free_id(identity: int, taken: Collection[int]) -> int:
    """The id of an object, changed if it is one of the ids `taken`. New objects keep different ids."""
    while identity in taken:
        identity += _IDS
    return identity


def as_labels(labels: np.ndarray, where: str = "label grid") -> np.ndarray:
    """Integer labels as uint16. Raises InputError if a label is not an integer from 0 to 65535."""
    labels = np.asarray(labels)
    if labels.dtype == np.uint16:
        return labels
    if labels.dtype == bool:
        return labels.astype(np.uint16)
    if not np.issubdtype(labels.dtype, np.integer):
        raise InputError(f"{where} has type {labels.dtype}, expected integers", "0 is free, objects are 1 .. 65535")
    if labels.size and (labels.min() < 0 or labels.max() > MAX_LABEL):
        raise InputError(
            f"{where} holds labels from {labels.min()} to {labels.max()}, expected 0 .. {MAX_LABEL}",
            "0 is free; renumber the objects",
        )
    return labels.astype(np.uint16)


def labels_on(grid: VoxelGrid, labels: np.ndarray) -> np.ndarray:
    """Labels as uint16. Raises InputError if the labels do not have the shape of the grid."""
    labels = as_labels(labels)
    if labels.shape != grid.shape:
        raise InputError(f"label grid has shape {labels.shape}, the voxel grid is {grid.shape}")
    return labels


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One answer to "what is on the table?": an object, or none, for every voxel. It is the particle of the filter.

    A hypothesis is frozen. `from_labels` makes one of a label grid; `with_labels` and `without` return changed
    copies, in which the objects keep their identities.

    Parameters
    ----------
    labels : (X, Y, Z) uint16
        0 is free or unknown space, and k >= 1 an object. The numbers need not be consecutive, and mean nothing
        outside the hypothesis: what follows an object over time is the `id` of its `ObjectRecord`.
    grid : VoxelGrid
        Where the voxels are.
    objects : tuple of ObjectRecord
        One record for each label, in ascending order of labels, with different ids.
    occupancy : Occupancy, optional
        How probable it is that each voxel is occupied. By default, this is 0 or 1, as the labels say.
    """

    labels: np.ndarray
    grid: VoxelGrid
    objects: tuple[ObjectRecord, ...] = ()
    occupancy: Occupancy | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", frozen(labels_on(self.grid, self.labels)))
        if self.occupancy is not None and self.occupancy.shape != self.grid.shape:
            raise InputError(f"occupancy has shape {self.occupancy.shape}, the voxel grid is {self.grid.shape}")
        numbers = [o.label for o in self.objects]
        if any(b <= a for a, b in pairwise(numbers)):
            raise InputError(f"object records are not in ascending order of labels: {numbers}")
        ids = Counter(o.id for o in self.objects)
        if len(ids) < len(self.objects):
            shared = ids.most_common(1)[0][0]
            of_id = [o.label for o in self.objects if o.id == shared]
            raise InputError(
                f"objects with the labels {of_id} have one id, {shared}",
                "ObjectRecord.born(label, birth, taken=ids) gives a new object an id that no other object has",
            )
        if numbers != list(self.volumes()):
            no_record = sorted(set(self.volumes()) - set(numbers))
            no_voxel = sorted(set(numbers) - set(self.volumes()))
            raise InputError(
                "labels in the grid and in the object records differ: "
                f"no record for {len(no_record)} labels {no_record[:5]}, no voxel for {len(no_voxel)} {no_voxel[:5]}",
                "use Hypothesis.from_labels, or with_labels to change a hypothesis",
            )

    def __repr__(self) -> str:
        volumes = [f"{label}: {n}" for label, n in self._volumes.items()]
        more = ", ..." if len(volumes) > 12 else ""
        lines = [f"Hypothesis of {len(volumes)} {'object' if len(volumes) == 1 else 'objects'}", self.grid.text]
        return "\n  ".join([*lines, f"voxels by label: {', '.join(volumes[:12])}{more}"] if volumes else lines)

    show = late("mstfilter.app.report.viewer:show_hypothesis", "The voxels as a page that can be rotated.")
    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    @classmethod
    def from_labels(cls, labels: np.ndarray, grid: VoxelGrid, birth: int = 0) -> Hypothesis:
        """A hypothesis from a label grid (X, Y, Z). Every object gets a new `ObjectRecord`.

        `birth` is the index of the pause.
        """
        labels = labels_on(grid, labels)
        present = np.flatnonzero(np.bincount(labels.ravel()))
        records = tuple(ObjectRecord.born(int(k), birth) for k in present if k > 0)
        return cls(labels, grid, records)

    def born_at(self, birth: int) -> Hypothesis:
        """The hypothesis with all objects first proposed at the pause `birth`, with the ids of this pause."""
        if all(record.birth == birth for record in self.objects):
            return self
        records = (replace(r, birth=birth, last_seen=birth, id=birth * _IDS + r.label) for r in self.objects)
        return replace(self, objects=tuple(records))

    def with_labels(self, labels: np.ndarray) -> Hypothesis:
        """A hypothesis with the same objects and a new label grid.

        Objects whose voxels change lose their `source` and `motion`, and those without voxels are removed. Raises
        InputError if a label has no `ObjectRecord`.
        """
        labels = labels_on(self.grid, labels)
        different = labels != self.labels
        changed = set(np.unique(labels[different])) | set(np.unique(self.labels[different]))
        present = np.bincount(labels.ravel(), minlength=MAX_LABEL + 1) > 0
        records = (record.changed() if record.label in changed else record for record in self.objects)
        return self.relabelled(labels, tuple(record for record in records if present[record.label]))

    def relabelled(self, labels: np.ndarray, objects: tuple[ObjectRecord, ...]) -> Hypothesis:
        """The hypothesis with other labels and object records. Voxels with a changed label get probability 0 or 1."""
        occupancy = self.occupancy
        if occupancy is not None:
            known = np.array([0, *(record.label for record in objects)])
            occupancy = occupancy.relabelled(self.labels, labels, known)
        return Hypothesis(labels, self.grid, objects, occupancy)

    def without(self, voxels: np.ndarray) -> Hypothesis:
        """The hypothesis with some `voxels` (X, Y, Z) bool set to free. See `with_labels`."""
        found = self.with_labels(np.where(voxels, 0, self.labels).astype(np.uint16))
        occupancy = found.occupancy
        return found if occupancy is None else replace(found, occupancy=occupancy.without(voxels))

    @property
    def shares(self) -> Occupancy:
        """The field `occupancy`, or if it is None, probability 1 at every occupied voxel."""
        return self.occupancy or Occupancy(self.labels, (self.labels > 0).astype(np.float16))

    def crop(self, label: int) -> Crop:
        """The voxels of an object, with probabilities if the hypothesis has some."""
        if self.occupancy is None:
            return Crop.of(self.labels == label)
        labelled = np.flatnonzero(self.labels == label)
        voxels, owners, p = self.occupancy.stored
        own = (owners == label) & (p > 0)
        index = np.stack(np.unravel_index(np.concatenate([labelled, voxels[own]]), self.grid.shape), axis=1)
        if not len(index):
            return Crop.of(np.zeros((0, 0, 0), bool))
        offset = index.min(axis=0)
        shape = tuple(index.max(axis=0) - offset + 1)
        occupied, probability = np.zeros(shape, bool), np.zeros(shape, np.float16)
        inside, known = np.split(index - offset, [len(labelled)])
        occupied[tuple(inside.T)] = True
        probability[tuple(known.T)] = p[own]
        return Crop(occupied, offset, probability)

    @cached_property
    def key(self) -> bytes:
        """Content key of the labels. The occupancy has a separate key."""
        return content_key("hypothesis", self.labels, self.grid.key)

    @cached_property
    def _volumes(self) -> Mapping[int, int]:
        counts = np.bincount(self.labels[self.labels > 0])
        return {int(k): int(counts[k]) for k in np.flatnonzero(counts)}

    def volumes(self) -> dict[int, int]:
        """Number of voxels of each object, by label in ascending order."""
        return dict(self._volumes)

    @property
    def n_objects(self) -> int:
        """Number of objects."""
        return len(self.objects)

    def record(self, label: int) -> ObjectRecord:
        """The `ObjectRecord` of a label."""
        for record in self.objects:
            if record.label == label:
                return record
        raise InputError(f"no object with label {label}; there are {[o.label for o in self.objects]}")

    def mask(self, label: int) -> np.ndarray:
        """(X, Y, Z) bool: the voxels of an object."""
        return self.labels == label

    def points(self, label: int) -> np.ndarray:
        """(n, 3) centres of the voxels of an object in world metres."""
        self.record(label)
        return self.grid.centre_of(np.argwhere(self.labels == label))

    mesh = late("mstfilter.app.report.export:object_mesh", "Corners and triangles of the surface of an object.")

    def pose(self, label: int) -> RigidTransform:
        """Rigid motion of an object in world metres since the object was first proposed.

        It consists of the tracked motions, so it lacks any that the camera did not record and after which the object
        was recognised at another place.
        """
        return self.record(label).pose

    def box(self, label: int) -> tuple[RigidTransform, np.ndarray]:
        """Oriented bounding box of the voxels of an object.

        Returns T_world_box and the lengths (3,) of the sides in metres. The origin is the centre of the box, and the
        z axis points up. The horizontal sides are the smallest rectangle around the voxels in the top view.
        """
        import cv2

        points, half = self.points(label), self.grid.voxel_size / 2
        corners = (points[:, None, :2] + half * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])).reshape(-1, 2)
        middle = corners.mean(axis=0)  # float32 is exact near 0 only
        (x, y), (width, depth), angle = cv2.minAreaRect((corners - middle).astype(np.float32))
        low, high = points[:, 2].min() - half, points[:, 2].max() + half
        centre = [x + middle[0], y + middle[1], (low + high) / 2]
        turn = Rotation.from_euler("z", angle, degrees=True)
        return RigidTransform.from_components(centre, turn), np.array([width, depth, high - low])
