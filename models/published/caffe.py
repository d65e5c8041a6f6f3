"""Weights in files of Caffe, read without Caffe.

>>> blobs = read_caffemodel("COB_PASCALContext_trainval.caffemodel")
>>> blobs["conv1"][0].shape                              # weights, then bias
(64, 3, 7, 7)

A ``.caffemodel`` is a message `NetParameter` in the wire format of protocol buffers. Four messages of caffe.proto are
read: in `NetParameter` the field 100 (``layer``); in a layer its name (1) and blobs (7); in a blob its data (5, or 8
for double) and its shape (7). All other fields are skipped, as are the layers of files before 2015 (field 2). Nothing
in the file is executed.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.reading import MAX_WEIGHTS, read_bytes

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # wire types
_MAX_AXES = 32  # Caffe's own limit


class _Damaged(Exception):
    """Bytes that are no message."""


def read_caffemodel(path: str | Path) -> dict[str, tuple[np.ndarray, ...]]:
    """Blobs (float32) of all layers that have some, by the name of the layer.

    Raises InputError if the file is missing, truncated or no Caffe model.
    """
    path = Path(path)
    data = memoryview(read_bytes(path, "weights", "give the path of a file", limit=MAX_WEIGHTS))
    found: dict[str, tuple[np.ndarray, ...]] = {}
    try:
        for number, value in _fields(data):
            if number != 100 or not isinstance(value, memoryview):
                continue
            name, blobs = _layer(value)
            if blobs and name in found:
                _fail(f"two layers are named {name!r}")
            if blobs:
                found[name] = blobs
    except (_Damaged, UnicodeDecodeError, ValueError) as error:
        raise InputError(
            f"{path} is not a complete Caffe model: {error}", "expected a .caffemodel; download it again"
        ) from error
    if not found:
        raise InputError(f"{path} has no layer with weights", "expected a .caffemodel")
    return found


def _fail(message: str) -> NoReturn:
    raise _Damaged(message)


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """The number at a position, and the position after it."""
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            _fail(f"byte {at}: a number does not end")
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Numbers and values of the fields of a message; bytes for lengths and fixed sizes."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(data, at)
            yield number, value
            continue
        if kind == _BYTES:
            size, at = _varint(data, at)
        elif kind in (_FIXED64, _FIXED32):
            size = 8 if kind == _FIXED64 else 4
        else:
            _fail(f"byte {at}: wire type {kind}")
        if number == 0 or at + size > len(data):
            _fail(f"byte {at}: field {number} has {size} bytes, {len(data) - at} are left")
        yield number, data[at : at + size]
        at += size


def _layer(data: memoryview) -> tuple[str, tuple[np.ndarray, ...]]:
    name, blobs = "", []
    for number, value in _fields(data):
        if number == 1 and isinstance(value, memoryview):
            name = bytes(value).decode()
        elif number == 7 and isinstance(value, memoryview):
            blobs.append(value)
    return name, tuple(_blob(blob, name) for blob in blobs)


def _blob(data: memoryview, layer: str) -> np.ndarray:
    shape: list[int] = []
    parts: dict[int, list[memoryview]] = {5: [], 8: []}
    for number, value in _fields(data):
        if number == 7 and isinstance(value, memoryview):
            shape = _shape(value)
        elif number in parts and isinstance(value, memoryview):
            parts[number].append(value)  # one packed run, or one value
    kind = 5 if parts[5] else 8
    values = np.frombuffer(b"".join(parts[kind]), "<f4" if kind == 5 else "<f8")
    size = 1
    for length in shape:
        size *= length
    if size != len(values):
        _fail(f"a blob of layer {layer!r} has {len(values)} values and shape {tuple(shape)}")
    return values.astype(np.float32).reshape(shape)


def _shape(data: memoryview) -> list[int]:
    """Lengths of the axes of a blob."""
    lengths: list[int] = []
    for number, value in _fields(data):
        if number != 1:
            continue
        if isinstance(value, int):
            lengths.append(value)
            continue
        at = 0
        while at < len(value):
            length, at = _varint(value, at)
            lengths.append(length)
    if len(lengths) > _MAX_AXES:
        _fail(f"a blob has {len(lengths)} axes")
    return lengths
