"""Hypotheses as plain arrays and files. No pickle; the same hypotheses give the same bytes.

>>> save_hypotheses(path, hypotheses, log_weights=lw)
>>> hypotheses, extra = load_hypotheses(path)

Arrays of the file: ``labels`` (n, X, Y, Z) uint16, ``origin`` (3,), ``voxel_size`` (), and one row an object:
``owner`` (which hypothesis), ``label``, ``id``, ``birth``, ``motion`` (4, 4), ``completion_key``, ``apart`` (ids,
comma separated); the source crops as ``has_source``, ``source_offset`` (3,), ``source_shape`` (3,) and all their
bits one after another.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.errors import InputError
from mstfilter.scene.voxels import Crop, Hypothesis, ObjectRecord, VoxelGrid

__all__ = ["decode", "encode", "load_hypotheses", "save_hypotheses"]


def encode(hypotheses: Sequence[Hypothesis]) -> dict[str, np.ndarray]:
    """Hypotheses on one grid as named arrays."""
    grid = hypotheses[0].grid
    if any(h.grid != grid for h in hypotheses):
        raise InputError("hypotheses of a file must share one grid")
    rows = [(n, record) for n, h in enumerate(hypotheses) for record in h.objects]
    crops = [record.source for _, record in rows]
    bits = [np.packbits(c.occupied) for c in crops if c is not None]
    return {
        "labels": np.stack([h.labels for h in hypotheses]),
        "origin": grid.origin,
        "voxel_size": np.array(grid.voxel_size),
        "owner": np.array([n for n, _ in rows], np.int64),
        "label": np.array([r.label for _, r in rows], np.int64),
        "id": np.array([r.id for _, r in rows], np.int64),
        "birth": np.array([r.birth for _, r in rows], np.int64),
        "motion": np.array([r.motion.as_matrix() for _, r in rows], np.float64).reshape(-1, 4, 4),
        "completion_key": np.array([r.completion_key or "" for _, r in rows], np.str_),
        "apart": np.array([",".join(map(str, sorted(r.apart))) for _, r in rows], np.str_),
        "has_source": np.array([c is not None for c in crops], bool),
        "source_offset": np.array([(0, 0, 0) if c is None else c.offset for c in crops], np.int64).reshape(-1, 3),
        "source_shape": np.array([(0, 0, 0) if c is None else c.occupied.shape for c in crops], np.int64).reshape(
            -1, 3
        ),
        "source_bits": np.concatenate(bits) if bits else np.zeros(0, np.uint8),
    }


def decode(arrays: dict[str, np.ndarray]) -> tuple[Hypothesis, ...]:
    """Hypotheses from the arrays of `encode`."""
    labels = arrays["labels"]
    grid = VoxelGrid(arrays["origin"], float(arrays["voxel_size"]), labels.shape[1:])
    records: list[list[ObjectRecord]] = [[] for _ in labels]
    begin = 0
    for row, owner in enumerate(arrays["owner"].tolist()):
        crop = None
        if arrays["has_source"][row]:
            shape = tuple(arrays["source_shape"][row].tolist())
            size = int(np.prod(shape))
            packed = arrays["source_bits"][begin : begin + (size + 7) // 8]
            begin += len(packed)
            crop = Crop(np.unpackbits(packed, count=size).astype(bool).reshape(shape), arrays["source_offset"][row])
        records[owner].append(
            ObjectRecord(
                int(arrays["label"][row]),
                int(arrays["id"][row]),
                int(arrays["birth"][row]),
                crop,
                RigidTransform(arrays["motion"][row], normalize=False),  # bit for bit
                str(arrays["completion_key"][row]) or None,
                frozenset(int(other) for other in str(arrays["apart"][row]).split(",") if other),
            )
        )
    return tuple(Hypothesis(grid_labels, grid, tuple(r)) for grid_labels, r in zip(labels, records, strict=True))


def save_hypotheses(path: Path, hypotheses: Sequence[Hypothesis], **extra: np.ndarray) -> None:
    """Write hypotheses and further arrays as a compressed .npz."""
    arrays: dict[str, Any] = {**encode(hypotheses), **extra}
    with Path(path).open("wb") as file:  # by handle: numpy would add .npz to another name
        np.savez_compressed(file, **arrays)


def load_hypotheses(path: Path) -> tuple[tuple[Hypothesis, ...], dict[str, np.ndarray]]:
    """Hypotheses of a file, and all its arrays."""
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
    except FileNotFoundError:
        raise InputError(f"file of hypotheses is missing: {path}") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"file of hypotheses cannot be read: {path} ({error})") from error
    try:
        return decode(arrays), arrays
    except (KeyError, IndexError, ValueError) as error:
        raise InputError(f"not a file of hypotheses: {path} ({error!r})") from error
