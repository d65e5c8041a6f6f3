"""Folders of instance masks from another program, with several alternatives for each pause.

>>> write_masks("masks", 0, [labels_a, labels_b], weights=[0.7, 0.3])    # label images (H, W), 0 = no mask
>>> masks = read_masks("masks", 0, (480, 640))
>>> len(masks.trees), masks.weights
(2, array([0.7, 0.3]))

The page "Your own front end" of the documentation describes the files.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mstfilter.base.errors import InputError, naming
from mstfilter.base.files import atomic_folder, locked, reading, write_text
from mstfilter.base.reading import MAX_FILE, read_bytes, read_json, unpack_arrays
from mstfilter.formats import read_labels
from mstfilter.mst.frontends.mask_trees import label_tree, mask_tree
from mstfilter.mst.segmentation import Tree
from mstfilter.scene import content_key, memo

MAX_MASKS = 65535  #: Largest label, and largest number of masks in a file
_SUFFIXES = (".png", ".npz")
_WEIGHTS = "weights.json"
#: Number of axes, kinds of type, and words for an error, of the arrays in an npz file.
_KINDS = {"labels": (2, "iu", "integers (H, W)"), "masks": (3, "b", "bool (n, H, W)")}


_Masks = tuple[np.ndarray, np.ndarray]  # label image (H, W) or masks (n, H, W), and the score (n,) of each mask


@dataclass(frozen=True, eq=False)
class PauseMasks:
    """The alternative segmentations of a pause."""

    weights: np.ndarray  #: (k,) probabilities, their sum is 1
    trees: tuple[Tree, ...]  #: the masks of each alternative; leaf 0 is the rest of the image
    stops: tuple[np.ndarray, ...]  #: probabilities to stop at the nodes of each tree (see `mask_tree`)
    key: bytes  #: key of the content of the files


def read_masks(folder: str | Path, pause: int, shape: tuple[int, int]) -> PauseMasks:
    """Read the masks of a pause. `shape` is the shape (H, W) of the image.

    Files are read at each call, but unchanged content is parsed only once. Raises InputError if the folder has no
    masks for the pause, or if a file is invalid.
    """
    if not str(folder):
        raise InputError("the folder of masks is not given", "set folder, for example proposal.folder=masks")
    where = _find(Path(folder), pause)
    files = [where] if where.is_file() else _alternatives(where)
    content = {path: read_bytes(path, "masks") for path in files}
    weights = read_weights(where, files) if len(files) > 1 else None
    named = (part for path, data in content.items() for part in (path.name, data))
    key = content_key("masks", shape, weights, *named)

    def parsed() -> PauseMasks:
        return _pause_masks({path: _read(path, data, shape) for path, data in content.items()}, weights, key)

    return memo("mask_files", key, parsed)


def _entries(folder: Path) -> list[Path]:
    """Entries of a folder in order of their names, without hidden entries."""
    return sorted(p for p in folder.iterdir() if not p.name.startswith("."))


def has_masks(folder: str | Path, first: int) -> bool:
    """Whether a folder has masks with the number `first` or a larger one."""
    return max(_by_pause(Path(folder)), default=-1) >= first


def _by_pause(folder: Path) -> dict[int, list[Path]]:
    """The files and folders of each pause."""
    if not folder.is_dir():
        raise InputError(f"folder of masks does not exist: {folder}")
    found: dict[int, list[Path]] = {}
    for path in _entries(folder):
        name = path.name if path.is_dir() else path.stem
        if name.isdecimal() and (path.is_dir() or path.suffix in _SUFFIXES):
            found.setdefault(int(name), []).append(path)
    return found


def _find(folder: Path, pause: int) -> Path:
    """The file or folder of a pause."""
    found = _by_pause(folder)
    if not found:
        raise InputError(
            f"folder {folder} has no masks",
            "the masks of pause 0 are the file 000000.png or .npz, or the folder 000000",
        )
    if pause not in found:
        numbers = ", ".join(map(str, sorted(found)))
        raise InputError(
            f"folder {folder} has no masks for pause {pause}; it has {numbers}", "files are numbered by pause, from 0"
        )
    if len(found[pause]) > 1:
        raise InputError(
            f"folder {folder} has masks for pause {pause} twice: {', '.join(p.name for p in found[pause])}",
            f"put alternatives into the folder {pause:06d}",
        )
    return found[pause][0]


def _alternatives(folder: Path) -> list[Path]:
    """The mask files of a pause."""
    files = [p for p in _entries(folder) if p.name != _WEIGHTS]
    for path in files:
        if path.is_dir() or path.suffix not in _SUFFIXES:
            raise InputError(f"{path} is not a file of masks", f"expected {', '.join(_SUFFIXES)}")
    if not files:
        raise InputError(f"folder {folder} has no masks", f"expected files {', '.join(_SUFFIXES)}")
    return files


def read_weights(folder: Path, files: list[Path]) -> list[float] | None:
    """The weight of each file from weights.json; None if this file does not exist."""
    path = folder / _WEIGHTS
    if not path.is_file():
        return None
    weights = read_json(path, "weights")
    names = {p.name for p in files}
    if not isinstance(weights, dict) or set(weights) != names:
        raise InputError(f"{path} does not have one weight for each of {', '.join(sorted(names))}")
    for name, value in weights.items():
        valid = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0
        if not valid:
            raise InputError(f"{path}: weight of {name} is {value!r}, expected a finite number of at least 0")
    if sum(weights.values()) <= 0:
        raise InputError(f"{path}: all weights are 0")
    return [float(weights[p.name]) for p in files]


def alternatives_of(
    alternatives: Sequence[np.ndarray | tuple[np.ndarray, Sequence[float] | np.ndarray]], shape: tuple[int, int]
) -> PauseMasks:
    """The alternatives of an image of `shape` (H, W), as `write_masks` takes them. InputError if one is invalid."""
    if not len(alternatives):
        raise InputError("there are no masks", "for an image without objects, give a label image of zeros")
    found: dict[Path, _Masks] = {}
    for k, one in enumerate(alternatives):
        name = Path(f"alternative {k}")
        found[name] = _checked(name, _arrays(one), shape)
    return _pause_masks(found, None, content_key("masks", shape, *(a for pair in found.values() for a in pair)))


def _arrays(one: np.ndarray | tuple[np.ndarray, Sequence[float] | np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of an alternative by their names in an npz file."""
    masks, scores = one if isinstance(one, tuple) else (one, None)
    masks = np.asarray(masks)
    named = {"labels" if masks.ndim == 2 else "masks": masks}
    return named if scores is None else {**named, "scores": np.asarray(scores, dtype=np.float64)}


def _pause_masks(found: Mapping[Path, _Masks], weights: Sequence[float] | None, key: bytes) -> PauseMasks:
    """The alternatives as trees. Without weights, these are the mean scores."""
    trees, stops, means = [], [], []
    for path, (masks, scores) in found.items():
        with naming(str(path)):
            tree, stop = (label_tree if masks.ndim == 2 else mask_tree)(masks, scores)
        trees.append(tree)
        stops.append(stop)
        means.append(_mean_of_largest(masks, scores))
    given = np.array(means if weights is None else weights)
    share = given / given.sum() if given.sum() > 0 else np.full(len(given), 1 / len(given))
    return PauseMasks(share, tuple(trees), tuple(stops), key)


def _mean_of_largest(masks: np.ndarray, scores: np.ndarray) -> float:
    """Mean score of the masks that no other mask contains; 1 if there are no masks."""
    if len(scores) == 0:
        return 1.0
    if masks.ndim == 2:
        return float(scores.mean())
    flat = masks.reshape(len(masks), -1)
    order = np.argsort(-flat.sum(axis=1), kind="stable")
    taken, largest = np.zeros(flat.shape[1], dtype=bool), []
    for k in order.tolist():
        if not taken[flat[k].argmax()]:
            largest.append(k)
        taken |= flat[k]
    return float(scores[largest].mean())


def _check_shape(path: Path, found: Sequence[int], shape: tuple[int, int]) -> None:
    if tuple(found) != tuple(shape):
        raise InputError(
            f"masks of {path} are {found[0]} x {found[1]} pixels, the image is {shape[0]} x {shape[1]} (H x W)",
            "masks have the size of the image",
        )


def _read(path: Path, data: bytes, shape: tuple[int, int]) -> _Masks:
    """The masks and scores of the content of a file."""
    if path.suffix == ".png":
        labels = read_label_image(path, shape)
        return labels, np.ones(len(np.unique(labels[labels > 0])))
    with reading(path, "masks", "expected arrays of numbers from numpy.savez; objects (pickle) are not read"):
        arrays = unpack_arrays(io.BytesIO(data), MAX_FILE)
    return _checked(path, arrays, shape)


def read_label_image(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Read a label image (H, W). Raises InputError if the shape of the image is not `shape`."""
    labels = read_labels(path)
    _check_shape(path, labels.shape, shape)
    return labels


def _checked(path: Path, arrays: Mapping[str, np.ndarray], shape: tuple[int, int]) -> _Masks:
    """The masks and scores among some arrays; InputError, with the path, if they are invalid."""
    kind = "labels" if "labels" in arrays else "masks"
    if kind not in arrays:
        raise InputError(f"{path} has no array labels or masks, only {', '.join(sorted(arrays)) or 'nothing'}")
    masks, (ndim, types, expected) = arrays[kind], _KINDS[kind]
    if masks.ndim != ndim or masks.dtype.kind not in types:
        raise InputError(f"{path}: {kind} has shape {masks.shape} and type {masks.dtype}, expected {expected}")
    _check_shape(path, masks.shape[-2:], shape)
    low, high = (masks.min(initial=0), masks.max(initial=0)) if kind == "labels" else (0, len(masks))
    if low < 0 or high > MAX_MASKS:
        raise InputError(
            f"{path}: labels are {low} to {high}, expected 0 to {MAX_MASKS}",
            "labels have 16 bits; number the masks from 1",
        )
    n = len(masks) if kind == "masks" else len(np.unique(masks[masks > 0]))
    scores = arrays.get("scores", np.ones(n))
    if not np.issubdtype(scores.dtype, np.number):
        raise InputError(f"{path}: scores has type {scores.dtype}, expected numbers")
    return masks, scores


def write_masks(
    folder: str | Path,
    pause: int,
    alternatives: Sequence[np.ndarray | tuple[np.ndarray, Sequence[float] | np.ndarray]],
    weights: Sequence[float] | None = None,
) -> None:
    """Write the alternatives of a pause as npz files. Earlier masks are replaced.

    No file is written if the masks do not pass the checks of `read_masks`.

    Parameters
    ----------
    folder : str or Path
    pause : int
        `Clip.index` of the clip. The masks are a segmentation of the last frame of the clip.
    alternatives : sequence
        Each alternative is a label image (H, W), or disjoint or nested masks (n, H, W) bool, or a pair of such an
        array and its scores.
    weights : sequence of float, optional
        One weight for each alternative. By default, the weights are computed from the scores.
    """
    path = Path(folder) / f"{pause:06d}"
    if not len(alternatives) or (weights is not None and len(weights) != len(alternatives)):
        given = "none" if weights is None else len(weights)
        raise InputError(
            f"there are {len(alternatives)} alternatives and {given} weights, expected at least 1 of each"
        )
    with locked(path), atomic_folder(path, "replace") as partial:
        for k, one in enumerate(alternatives):
            name, arrays = partial / f"{k}.npz", _arrays(one)
            shape = next(iter(arrays.values())).shape[-2:]
            _pause_masks({name: _checked(name, arrays, shape)}, None, b"")  # the checks of the reader
            np.savez_compressed(name, **arrays)  # type: ignore[arg-type]
        if weights is not None:
            write_text(partial / _WEIGHTS, json.dumps({f"{k}.npz": float(w) for k, w in enumerate(weights)}))
            read_weights(partial, _alternatives(partial))
