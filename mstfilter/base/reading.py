"""Reads files of unknown origin safely.

>>> info = read_json(folder / "info.json", "a run folder")
>>> arrays = read_arrays(folder / "truth.npz", "true volumes")

All readers use `open_regular`, which opens only regular files, because reading a pipe or a device might never end.
The file size is compared with a limit. The unpacked size of arrays is read from headers before memory is allocated.
Functions that take a path raise `InputError` with this path.
"""

from __future__ import annotations

import io
import json
import math
import os
import stat
import tomllib
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeVar

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.files import reading

if TYPE_CHECKING:
    from pydantic import BaseModel

#: Limit of the size of a file, and of the unpacked arrays of a file, in bytes. The environment variable sets it.
MAX_FILE = int(os.environ.get("MSTFILTER_MAX_BYTES", 2**29))
MAX_TEXT = 2**25  #: Largest text file that is parsed, in bytes: parsed values need 20 times the memory
MAX_WEIGHTS = 2**32  #: Largest file of weights of a network, in bytes
MAX_TOML = 2**17  #: Largest TOML file, in bytes

_Model = TypeVar("_Model", bound="BaseModel")


@contextmanager
def open_regular(path: str | Path, limit: int | None = None) -> Iterator[io.BufferedReader]:
    """A regular file of at most `limit` bytes, opened for reading. Raises InputError for other files.

    The default of `limit` is `MAX_FILE`.
    """
    # Without O_NONBLOCK the call waits for the other end of a pipe.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            what = "folder" if stat.S_ISDIR(status.st_mode) else "pipe, socket or device"
            raise InputError(f"{path} is a {what}, expected a file")
        most = MAX_FILE if limit is None else limit
        if status.st_size > most:
            raise InputError(f"{path} has {status.st_size} bytes, at most {most} are read")
        yield file


def read_bytes(path: Path, kind: str, *hints: str, limit: int | None = None) -> bytes:
    """The content of a regular file of at most `limit` bytes. See `reading` for the other parameters."""
    with reading(path, kind, *hints), open_regular(path, limit) as file:
        return file.read()


def read_text(path: Path, kind: str, *hints: str, limit: int = MAX_TEXT) -> str:
    """The content of a UTF-8 text file of at most `limit` bytes. See `reading` for the other parameters."""
    with reading(path, kind, *hints):
        return read_bytes(path, kind, *hints, limit=limit).decode("utf-8-sig")


def read_json(path: Path, kind: str, *hints: str) -> Any:
    """The content of a JSON file. See `reading` for the parameters."""
    with reading(path, kind, *hints):
        return json.loads(read_text(path, kind, *hints))


def read_toml(path: Path, kind: str, *hints: str) -> dict[str, Any]:
    """The content of a TOML file. See `reading` for the parameters."""
    text = read_text(path, kind, *hints, limit=MAX_TOML)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}", *hints) from error


def read_model(path: Path, model: type[_Model], kind: str, *hints: str) -> tuple[_Model, dict[str, Any]]:
    """Read a JSON file and check it with a pydantic model. Returns the model, and the stored values.

    See `reading` for the other parameters. An error names the first wrong entry and the value found.
    """
    from pydantic import ValidationError

    data = read_json(path, kind, *hints)
    try:
        return model.model_validate(data), data
    except ValidationError as error:
        first = error.errors()[0]
        where = "".join(f"{part}: " for part in [".".join(map(str, first["loc"]))] if part)
        value = "nothing" if first["type"] == "missing" else repr(first["input"])[:80]
        message = first["msg"].removeprefix("Value error, ")
        raise InputError(f"{path}: {where}{message[:1].lower()}{message[1:]}, found {value}", *hints) from error


def read_arrays(path: Path, kind: str, *hints: str, limit: int | None = None) -> dict[str, np.ndarray]:
    """All arrays of an .npz file that needs at most `limit` bytes of memory.

    The array of an .npy file has the name "". See `reading` for the other parameters.
    """
    with reading(path, kind, *hints), open_regular(path, limit) as file:
        if file.peek(6).startswith(b"\x93NUMPY"):
            _check_array(file, os.fstat(file.fileno()).st_size)
            file.seek(0)
            return {"": np.asarray(np.lib.format.read_array(file))}
        return unpack_arrays(file, limit)


def unpack_arrays(file: IO[bytes], limit: int | None = None) -> dict[str, np.ndarray]:
    """All arrays of an open .npz file. Raises ValueError if the headers are wrong or need more than `limit` bytes."""
    with zipfile.ZipFile(file) as archive:
        members, most = archive.infolist(), MAX_FILE if limit is None else limit
        if (total := sum(member.file_size for member in members)) > most:
            raise ValueError(f"its arrays need {total} bytes, at most {most} are read")
        found = {}
        for member in members:
            with archive.open(member) as opened:
                _check_array(opened, member.file_size)
            with archive.open(member) as opened:
                found[member.filename.removesuffix(".npy")] = np.asarray(np.lib.format.read_array(opened))
        return found


def _check_array(file: IO[bytes], size: int) -> None:
    """Raise ValueError unless the array of a .npy file has no objects and fits into `size` bytes."""
    first = np.lib.format.read_magic(file) == (1, 0)
    shape, _, dtype = (np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0)(file)
    if dtype.hasobject:
        raise ValueError("it holds objects (pickle), which are not read")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"an array of shape {shape} and type {dtype} does not fit into {size} bytes")


def check_private(folder: Path) -> None:
    """Raise InputError if a folder belongs to another user, or can be written by others."""
    if not hasattr(os, "getuid") or not folder.exists():
        return
    status = folder.stat()
    if status.st_uid != os.getuid():
        raise InputError(f"cache {folder} belongs to another user", "choose a folder of your own: MSTFILTER_CACHE")
    if status.st_mode & 0o022:
        raise InputError(
            f"other users may write into the cache {folder}: its mode is {status.st_mode & 0o777:o}",
            f"chmod go-w {folder}",
        )
