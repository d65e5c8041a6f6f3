"""Conversion of hypotheses to plain arrays and back, without pickle.

>>> np.savez_compressed(path, **encode_hypotheses(hypotheses))  # doctest: +SKIP
>>> hypotheses = decode_hypotheses(dict(np.load(path)))  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError
from mstfilter.scene.occupancy import Occupancy
from mstfilter.scene.voxels import Crop, Hypothesis, ObjectRecord, ObjectView, VoxelGrid


def encode_hypotheses(hypotheses: Sequence[Hypothesis]) -> dict[str, np.ndarray]:
    """Convert hypotheses with the same grid to a dictionary of named arrays.

    The arrays are ``labels`` (n, X, Y, Z) uint16, ``origin`` (3,), ``voxel_size`` (), and arrays with one row per
    object: ``owner`` (index of the hypothesis), ``label``, ``id``, ``birth``, ``motion`` and ``pose`` (4, 4),
    ``completion_key``. The field `source` of the objects is stored as ``has_source``, ``source_offset`` (3,),
    ``source_shape`` (3,) and ``source_bits``. The array ``source_bits`` concatenates the packed bits of all `Crop`
    objects.

    If a hypothesis has probabilities, the occupancy is stored as ``voxel_owner`` and ``probability`` (n, X, Y, Z).
    ``source_probability`` concatenates the probabilities of all `Crop` objects. Each `ObjectView` has a row in
    ``view_of`` (row of the object), ``view_offset``, ``view_shape`` (3,), ``view_motion`` (4, 4),
    ``view_key``, ``view_colours`` (n,). ``view_bits`` and ``view_signed`` concatenate the arrays of all `ObjectView`
    objects.
    """
    grid = hypotheses[0].grid
    if any(h.grid != grid for h in hypotheses):
        raise InputError("hypotheses of a file must have the same grid")
    rows = [(n, record) for n, h in enumerate(hypotheses) for record in h.objects]
    crops = [record.source for _, record in rows]
    bits = [np.packbits(c.occupied) for c in crops if c is not None]
    arrays = {
        "labels": np.stack([h.labels for h in hypotheses]),
        "origin": grid.origin,
        "voxel_size": np.array(grid.voxel_size),
        "owner": np.array([n for n, _ in rows], np.int64),
        "label": np.array([r.label for _, r in rows], np.int64),
        "id": np.array([r.id for _, r in rows], np.int64),
        "birth": np.array([r.birth for _, r in rows], np.int64),
        "last_seen": np.array([r.last_seen for _, r in rows], np.int64),
        "motion": _matrices(r.motion for _, r in rows),
        "pose": _matrices(r.pose for _, r in rows),
        "completion_key": np.array([r.completion_key or "" for _, r in rows], np.str_),
        "has_source": np.array([c is not None for c in crops], bool),
        "source_offset": np.array([(0, 0, 0) if c is None else c.offset for c in crops], np.int64).reshape(-1, 3),
        "source_shape": np.array([(0, 0, 0) if c is None else c.occupied.shape for c in crops], np.int64).reshape(
            -1, 3
        ),
        "source_bits": np.concatenate(bits) if bits else np.zeros(0, np.uint8),
    }
    if any(h.occupancy is not None for h in hypotheses):
        shares = [h.shares for h in hypotheses]
        arrays |= {
            "certain": np.array([h.occupancy is None for h in hypotheses]),
            "voxel_owner": np.stack([one.owner for one in shares]),
            "probability": np.stack([one.probability for one in shares]),
            "source_certain": np.array([c is None or c.probability is None for c in crops], bool),
            "source_probability": _joined(
                [c.probability for c in crops if c is not None and c.probability is not None], np.float16
            ),
        }
    views = [(k, view) for k, (_, record) in enumerate(rows) for view in record.views]
    if views:
        arrays |= {
            "view_of": np.array([k for k, _ in views], np.int64),
            "view_offset": np.array([view.offset for _, view in views], np.int64),
            "view_shape": np.array([view.bits.shape for _, view in views], np.int64),
            "view_motion": _matrices(view.motion for _, view in views),
            "view_key": np.array([view.key for _, view in views], np.str_),
            "view_bits": _joined([view.bits for _, view in views], np.uint8),
            "view_signed": _joined([view.signed for _, view in views], np.int8),
            "view_colours": np.array([view.colours for _, view in views], np.float32),
        }
    return arrays


def _matrices(motions: Iterable[RigidTransform]) -> np.ndarray:
    return np.array([T.as_matrix() for T in motions], np.float64).reshape(-1, 4, 4)


def _joined(arrays: Sequence[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype), *(one.ravel() for one in arrays)])


class _Reader:
    """Splits a concatenated array into consecutive arrays."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.at = values, 0

    def take(self, shape: Sequence[int]) -> np.ndarray:
        begin, self.at = self.at, self.at + int(np.prod(shape))
        return self.values[begin : self.at].reshape(shape)


def decode_hypotheses(arrays: Mapping[str, np.ndarray]) -> tuple[Hypothesis, ...]:
    """Convert the arrays of `encode_hypotheses` back to hypotheses."""
    labels = arrays["labels"]
    grid = VoxelGrid(arrays["origin"], arrays["voxel_size"], labels.shape[1:])  # type: ignore[arg-type]
    records: list[list[ObjectRecord]] = [[] for _ in labels]
    begin, views = 0, _decode_views(arrays)
    probabilities = _Reader(arrays["source_probability"]) if "source_probability" in arrays else None
    poses = arrays.get("pose", arrays["motion"])  # version 0.1 has no poses
    last_seen = arrays.get("last_seen", arrays["birth"])  # not in old files
    for row, owner in enumerate(arrays["owner"].tolist()):
        crop = None
        if arrays["has_source"][row]:
            shape = tuple(arrays["source_shape"][row].tolist())
            size = int(np.prod(shape))
            packed = arrays["source_bits"][begin : begin + (size + 7) // 8]
            begin += len(packed)
            occupied = np.unpackbits(packed, count=size).astype(bool).reshape(shape)
            certain = probabilities is None or arrays["source_certain"][row]
            p = None if certain or probabilities is None else probabilities.take(shape)
            crop = Crop(occupied, arrays["source_offset"][row], p)
        records[owner].append(
            ObjectRecord(
                int(arrays["label"][row]),
                int(arrays["id"][row]),
                int(arrays["birth"][row]),
                crop,
                RigidTransform(arrays["motion"][row], normalize=False),  # bit-identical
                str(arrays["completion_key"][row]) or None,
                tuple(views.get(row, ())),
                RigidTransform(poses[row], normalize=False),
                int(last_seen[row]),
            )
        )
    found = []
    for n, (grid_labels, own) in enumerate(zip(labels, records, strict=True)):
        occupancy = None
        if "certain" in arrays and not arrays["certain"][n]:
            occupancy = Occupancy(arrays["voxel_owner"][n], arrays["probability"][n])
        found.append(Hypothesis(grid_labels, grid, tuple(own), occupancy))
    return tuple(found)


def _decode_views(arrays: Mapping[str, np.ndarray]) -> dict[int, list[ObjectView]]:
    """Map the row of each object in the arrays to the views of the object."""
    found: dict[int, list[ObjectView]] = {}
    if "view_of" in arrays:
        bits, signed = _Reader(arrays["view_bits"]), _Reader(arrays["view_signed"])
        colours = arrays.get("view_colours", np.zeros((len(arrays["view_of"]), 0), np.float32))  # not in old files
        for k, row in enumerate(arrays["view_of"].tolist()):
            shape = arrays["view_shape"][k].tolist()
            motion = RigidTransform(arrays["view_motion"][k], normalize=False)
            key = str(arrays["view_key"][k])
            seen = bits.take(shape), signed.take(shape)
            view = ObjectView(arrays["view_offset"][k], *seen, key, motion, colours[k])
            found.setdefault(row, []).append(view)
    return found
