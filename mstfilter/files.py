"""Writing files so that a reader never sees half of one.

>>> with atomic_path(folder / "metrics.csv") as path:
...     path.write_text(text, encoding="utf-8")

The file is written under a temporary name in the same folder and renamed when it is complete. If the block raises,
the temporary file is removed and an earlier file is left as it was.
"""

from __future__ import annotations

import csv
import functools
import hashlib
import json
import math
import numbers
import os
import re
import shutil
import struct
import tokenize
import uuid
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError, naming, reason

SUMS = "SHA256SUMS"  # in a folder: the hashes of its files


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


def write_sums(folder: Path, names: Iterable[str] = ()) -> None:
    """Write SHA256SUMS, which ``sha256sum -c`` reads: the hashes of the named files, or of all below the folder."""
    files = [folder / name for name in names] or sorted(path for path in folder.rglob("*") if path.is_file())
    write_text(folder / SUMS, "".join(f"{_digest(file)}  {file.relative_to(folder).as_posix()}\n" for file in files))


def damaged_files(folder: Path) -> list[str]:
    """What differs from the SHA256SUMS of a folder: ``state.npz has changed``, ``rgb.png is missing``."""
    if not (folder / SUMS).is_file():
        return [f"{SUMS} is missing"]
    lines = (folder / SUMS).read_text(encoding="utf-8", errors="replace").splitlines()
    listed = [re.fullmatch(r"([0-9a-f]{64})  (.+)", line) for line in lines if line.isprintable()]
    if not lines or len(listed) < len(lines) or not all(listed):
        return [f"{SUMS} has changed"]
    return [f"{match[2]} {fault}" for match in listed if match and (fault := _fault(folder / match[2], match[1]))]


def _fault(file: Path, digest: str) -> str:
    if not file.is_file():
        return "is missing"
    return "" if _digest(file) == digest else "has changed"


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
    except json.JSONDecodeError as error:
        raise InputError(f"{path} is not valid JSON: {error}", *hints) from error
    except RecursionError as error:
        raise InputError(f"{path} cannot be read: its values are nested too deep", *hints) from error
    except MemoryError as error:
        raise InputError(f"{path} cannot be read: memory ran out", *hints) from error
    except _UNREADABLE as error:
        raise InputError(f"{path} cannot be read: {reason(error)}", *hints) from error


# CPython 3.11 raises SystemError if two threads parse the headers of arrays at once (python/cpython#106905).
_UNREADABLE = (
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError),
    *(SystemError, SyntaxError, tokenize.TokenError, struct.error, zlib.error, zipfile.BadZipFile),
)


def check_output(path: Path, folder: bool = False) -> None:
    """Raise InputError if a file, or with `folder` a folder, cannot be written at `path`."""
    if path.is_dir() and not folder:
        raise InputError(f"{path} is a folder, expected the name of a file to write")
    existing = next(parent for parent in (path.absolute(), *path.absolute().parents) if parent.exists())
    if existing.is_file() and (folder or existing != path.absolute()):
        raise InputError(f"cannot write {path}: {existing} is a file", "choose another place")
    if not os.access(existing, os.W_OK):
        raise InputError(f"cannot write {path}: no permission to write in {existing}", "choose another place")


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
    return _digest(path)


def _digest(path: str | Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
