"""Writing files so that a reader never sees half of one.

>>> with atomic_path(folder / "metrics.csv") as path:
...     path.write_text(text)

The file is written under a temporary name in the same folder and renamed when it is complete. If the block raises,
the temporary file is removed and an earlier file is left as it was.
"""

from __future__ import annotations

import csv
import errno
import functools
import hashlib
import json
import math
import numbers
import os
import re
import shutil
import uuid
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mstfilter.errors import InputError, naming, reason

if TYPE_CHECKING:
    import numpy as np


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it at the end of the block; missing folders are made."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        yield partial
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`, for a folder that the block makes and that replaces `path` at its end."""
    target = Path(path)
    partial = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        yield partial
        if target.exists():
            shutil.rmtree(target)
        os.replace(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def reading(path: Path, kind: str, *hints: str) -> Iterator[None]:
    """Turn errors in a block that reads a file into InputError; `kind` is what is missing without the file."""
    try:
        with naming(str(path)):
            yield
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"not {kind}: {path} is missing", *hints) from None
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON: {error}", *hints) from error
    except (OSError, EOFError, zipfile.BadZipFile, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} cannot be read: {reason(error)}", *hints) from error


def read_arrays(path: Path, what: str, *hints: str) -> dict[str, np.ndarray]:
    """All arrays of an .npz file. InputError that names the file if it is missing, damaged or of another kind.

    `what` names the content for the message. numpy and zipfile raise errors of many types for damaged files, and a
    checksum is compared only when an array is read; therefore all arrays are read here.
    """
    import numpy as np

    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except FileNotFoundError:
        raise InputError(f"{what} is missing: {path}") from None
    except Exception as error:
        problem = reason(error) or type(error).__name__
        raise InputError(f"{what} cannot be read: {path} ({problem})", *hints) from error


def folder_name(name: str) -> str:
    """A name of a folder for any text, different for different texts on every file system.

    Lower-case letters, digits, ``_`` and ``-`` stay. Other texts, long ones and names that Windows reserves become
    such letters, ``~`` and a hash.
    """
    plain = re.sub(r"[^a-z0-9_-]+", "_", name.lower())[:60]
    if plain == name and name and not re.fullmatch(r"con|prn|aux|nul|(com|lpt)[0-9]", name):
        return name
    return f"{plain}~{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:12]}"


def check_output(path: Path, folder: bool = False) -> None:
    """Raise InputError if a file, or with `folder` a folder, cannot be written at `path`.

    For each name that does not exist a file with that name between other characters, as `atomic_path` has it, is
    made and removed: permissions do not tell of read-only file systems, long names, or a full disk.
    """
    if os.path.isdir(path) and not folder:
        raise InputError(f"{path} is a folder, expected the name of a file to write")
    target = path.absolute()
    places = [target, *target.parents]
    existing = next(place for place in places if os.path.exists(place))
    if existing.is_file() and (folder or existing != target):
        raise InputError(f"cannot write {path}: {existing} is a file", "choose another place")
    made_in = existing.parent if existing.is_file() else existing
    names = [place.name for place in places[: places.index(existing)]]
    for name in names or [existing.name]:
        probe = made_in / f".{name}.{uuid.uuid4().hex[:8]}.partial"
        try:
            probe.touch()
            probe.unlink()
        except OSError as error:
            problem = "no permission to write" if error.errno in (errno.EACCES, errno.EPERM) else error.strerror
            raise InputError(f"cannot write {path}: {problem} in {made_in}", "choose another place") from error


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8) in one step."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="")


def write_csv(
    path: str | Path,
    rows: Iterable[Mapping[str, Any]],
    columns: Iterable[str] | None = None,
    float_format: str = "",
) -> None:
    """Write rows as CSV in one step; None and NaN are written as an empty cell.

    `columns` are written in this order; by default all in the order of first appearance. `float_format` is for
    example ``.6g``; the default writes all digits.
    """
    rows = [{name: _cell(value, float_format) for name, value in row.items()} for row in rows]
    names = list(columns) if columns is not None else list(dict.fromkeys(name for row in rows for name in row))
    with atomic_path(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _cell(value: Any, float_format: str) -> Any:
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        return "" if math.isnan(value) else format(float(value), float_format)
    return value


def read_csv(path: str | Path) -> list[dict[str, str]]:
    """Rows of a CSV file with a header: column name -> text."""
    with Path(path).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def weights_file(given: str, name: str, where: str, sha256: str = "") -> tuple[str, str]:
    """Absolute path and SHA-256 of a file of weights that the user supplies for a network `name`.

    Raises InputError if it is not given, does not exist, or has another hash than `sha256`; `where` is an address for
    the hint. The hash of an unchanged file is computed once.
    """
    path = Path(given)
    if not given or not path.is_file():
        problem = f"do not exist: {path}" if given else "are not given"
        raise InputError(f"the weights of {name} {problem}", f"set the field to the path of a file, see {where}")
    status = path.stat()
    digest = _sha256(str(path.resolve()), status.st_mtime_ns, status.st_size)
    if sha256 and digest != sha256.lower():
        raise InputError(f"weights {path} have the hash {digest}, expected {sha256}", "download the file again")
    return str(path.resolve()), digest


@functools.lru_cache(maxsize=8)
def _sha256(path: str, modified: int, size: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
