"""Writes files and folders so that a killed process, a power failure or a second process leaves no damaged file.

>>> with atomic_path(folder / "metrics.csv") as path:
...     path.write_text(text, encoding="utf-8")
>>> with locked("runs/mine"), atomic_folder("runs/mine") as folder:
...     (folder / "run.json").write_text(text, encoding="utf-8")

A file or folder is written under a temporary name in the same folder, synced with the disk, and renamed when it is
complete. If the block raises an error, the temporary file is removed and an earlier file is left unchanged. The next
call of `locked` with the same name removes the temporary files of a killed process.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import hashlib
import math
import numbers
import os
import re
import shutil
import socket
import struct
import time
import tokenize
import uuid
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from mstfilter.base.errors import InputError, naming, reason

SUMS = "SHA256SUMS"  # in a folder: the hashes of its files
_TEMPORARY = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{8}\.(?P<kind>partial|replaced)", re.DOTALL)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to `path` at the end of the block. Missing folders are made."""
    target = Path(path)
    make_folders(target.parent)
    partial = _temporary(target, "partial")
    try:
        yield partial
        _sync(target, partial)
        os.replace(partial, target)
        _sync(target, target.parent)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path, existing: Literal["refuse", "replace", "keep"] = "refuse") -> Iterator[Path]:
    """An empty temporary folder beside `path`, which is renamed to `path` at the end of the block.

    `existing` determines what happens if a folder with content then exists at `path`. "refuse" raises InputError,
    "replace" removes the earlier folder, and "keep" removes the new folder. An empty folder is always replaced.
    """
    target = Path(os.path.realpath(path))
    make_folders(target.parent)
    partial = _temporary(target, "partial")
    partial.mkdir()
    mark = _lock(partial, os.O_RDONLY)  # `sweep` leaves the folder alone
    try:
        yield partial
        _sync(target, *partial.rglob("*"), partial)
        _place(partial, target, existing)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if mark is not None:
            os.close(mark)


def _place(partial: Path, target: Path, existing: str) -> None:
    """Rename the complete temporary folder to its final name."""
    earlier = _temporary(target, "replaced")
    if existing == "replace" and target.is_dir():
        target.rename(earlier)
    try:
        partial.rename(target)
    except OSError as error:
        if earlier.exists():
            earlier.rename(target)
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise
        if existing != "keep":
            raise InputError(f"cannot write {target}: it was made meanwhile", "choose another name") from error
    _sync(target, target.parent)
    shutil.rmtree(earlier, ignore_errors=True)


@contextmanager
def locked(path: str | Path) -> Iterator[None]:
    """Reserve a path, which need not exist, until the end of the block. Removes temporary files of killed processes.

    Raises InputError if another block or process has reserved `path`. The lock is a file ``.NAME.lock`` beside
    `path`. The system releases the lock when the process ends. On file systems without locks, paths are not reserved.
    """
    target = Path(os.path.realpath(path))
    if _is_temporary(target.absolute()):  # no other process knows the name
        yield
        return
    file = target.with_name(f".{target.name}.lock")
    with contextlib.ExitStack() as stack:
        with writing(f"{target} and a lock beside it", "choose another place"):
            stack.callback(_remove_empty, make_folders(target.parent))
            descriptor = _reserve(file, target)
            stack.callback(os.close, descriptor)
            stack.callback(file.unlink, missing_ok=True)
            now = time.strftime("%Y-%m-%d %H:%M:%S")
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f": process {os.getpid()} of {socket.gethostname()} since {now}".encode())
        sweep(target.parent, target.name)
        yield


def _remove_empty(folders: list[Path]) -> None:
    with contextlib.suppress(OSError):  # something was written there
        for folder in folders:
            folder.rmdir()


def _reserve(file: Path, target: Path) -> int:
    """Open and lock a lock file. If the file is locked, raise an InputError that names the other process."""
    while True:
        descriptor = _lock(file, os.O_RDWR | os.O_CREAT)
        with contextlib.suppress(FileNotFoundError):  # the process that had the lock has removed the file
            if descriptor is None:
                holder = file.read_text(encoding="utf-8", errors="replace")[:200]
                raise InputError(
                    f"{target} is being written by another process{holder if holder.isprintable() else ''}",
                    "wait until it has ended, or choose another name",
                )
            if os.path.samestat(file.stat(), os.fstat(descriptor)):
                return descriptor
        if descriptor is not None:
            os.close(descriptor)


def _lock(path: Path, flags: int) -> int | None:
    """Open and lock a file or folder; None if it is already locked. On systems without locks, only open the file."""
    descriptor = os.open(path, flags, 0o666)
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except (ImportError, OSError):
        pass
    return descriptor


def sweep(folder: Path, name: str | None = None, older_than_s: float = 0.0) -> None:
    """Remove the temporary files that ended processes left in a folder, for the file `name` or for all files.

    If a process was killed while it replaced a folder, the earlier folder gets its name back. Set a minimum age
    `older_than_s` unless `name` is locked, because another process may be writing the files.
    """
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _TEMPORARY.fullmatch(path.name)
        if match is None or name not in (None, match["name"]) or not _is_abandoned(path, older_than_s):
            continue
        if match["kind"] == "replaced" and not (folder / match["name"]).exists():
            path.rename(folder / match["name"])
        else:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def other_files(folder: Path, own: re.Pattern[str]) -> list[str]:
    """Files below a folder whose relative paths do not match `own`, except temporary files and locks."""
    paths = [path.relative_to(folder) for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()]
    own = re.compile(rf"{own.pattern}|(.+/)?\.[^/]+\.lock")
    return sorted(p.as_posix() for p in paths if not own.fullmatch(p.as_posix()) and not _is_temporary(p))


def _is_abandoned(path: Path, older_than_s: float) -> bool:
    with contextlib.suppress(OSError):  # another process may remove it
        # A date in the future is of another clock, and not recent.
        if abs(time.time() - path.lstat().st_mtime) >= older_than_s and (descriptor := _lock(path, os.O_RDONLY)):
            os.close(descriptor)
            return True
    return False


def _temporary(target: Path, kind: str) -> Path:
    return target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.{kind}")


def _is_temporary(path: Path) -> bool:
    """Whether a path is a temporary file, or inside a temporary folder."""
    return any(map(_TEMPORARY.fullmatch, path.parts))


def make_folders(folder: Path, mode: int = 0o777) -> list[Path]:
    """Make a folder and its parents. Returns the folders that were missing, the deepest folder first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    for path in (*reversed(missing[1:]), folder):
        path.mkdir(mode, exist_ok=True)
    _sync(folder, *(path.parent for path in missing))
    return missing


def cache_folder() -> Path:
    """Folder of cached files: the variable MSTFILTER_CACHE, or else `mstfilter` in the user's cache folder."""
    if folder := os.environ.get("MSTFILTER_CACHE"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mstfilter"


def _sync(target: Path, *paths: Path) -> None:
    """Wait until the contents of files and folders are stored on the disk.

    Returns immediately if `target`, the final path, is in a temporary folder, which is synced when it is complete.
    """
    if os.name != "posix" or _is_temporary(target.absolute()):
        return
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        except OSError as error:
            if error.errno != errno.EINVAL:  # the file system has no such operation
                raise
        finally:
            os.close(descriptor)


def write_sums(folder: Path, names: Iterable[str] = ()) -> None:
    """Write SHA256SUMS for ``sha256sum -c``: the hashes of the named files, or of all files below the folder."""
    files = [folder / name for name in names] or sorted(path for path in folder.rglob("*") if path.is_file())
    write_text(folder / SUMS, "".join(f"{_digest(file)}  {file.relative_to(folder).as_posix()}\n" for file in files))


def damaged_files(folder: Path) -> list[str]:
    """Differences of files from SHA256SUMS, such as ``state.npz has changed`` or ``rgb.png is missing``."""
    if not (folder / SUMS).is_file():
        return [f"{SUMS} is missing"]
    if (folder / SUMS).stat().st_size > 2**25:  # bytes; a line has about 100
        return [f"{SUMS} has changed"]
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
    """Convert errors in a block that reads a file to InputError. `kind` names the data, such as "a run folder"."""
    try:
        with naming(str(path)):
            yield
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"not {kind}: {path} is missing", *hints) from None
    except _UNREADABLE as error:
        raise InputError(f"{path} cannot be read: {reason(error)}", *hints) from error


# CPython 3.11 raises SystemError if two threads parse the headers of arrays at once (python/cpython#106905).
_UNREADABLE = (
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError),
    *(MemoryError, SystemError, SyntaxError, tokenize.TokenError, struct.error, zlib.error, zipfile.BadZipFile),
)


@contextmanager
def writing(what: str, *hints: str) -> Iterator[None]:
    """Convert disk errors in a block that writes `what` to InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write {what}: {error.strerror}", *hints) from error


def check_output(path: Path, folder: bool = False, empty: bool = True) -> None:
    """Raise InputError if a file, or with `folder` a folder, cannot be written at `path`.

    An existing folder must be empty, unless `empty` is false. A file is made and removed beside `path`, because
    permissions do not reveal read-only file systems or a full disk.
    """
    if os.path.isdir(path):
        if not folder:
            raise InputError(f"{path} is a folder, expected the name of a file to write")
        if os.path.ismount(path) or Path.cwd().is_relative_to(path.resolve()):
            fact = f"cannot write {path}: it is a mount point or the working folder"
            raise InputError(fact, "name a folder below it")
        if empty and any(path.iterdir()):
            fact = f"cannot write {path}: it exists and is not an empty folder"
            raise InputError(fact, "choose another name, or remove it")
    elif folder and os.path.isfile(path):
        raise InputError(f"cannot write {path}: it is a file, expected a folder", "choose another name")
    place = path.absolute()
    existing = next(parent for parent in place.parents if os.path.exists(parent))
    if os.path.isfile(existing):
        raise InputError(f"cannot write {path}: {existing} is a file", "choose another place")
    try:
        for name in place.relative_to(existing).parts:  # a part may be too long
            with contextlib.suppress(FileNotFoundError):
                _temporary(existing / name, "partial").lstat()
        _try_to_write(existing)
    except OSError as error:
        problem = "no permission to write" if error.errno in (errno.EACCES, errno.EPERM) else error.strerror
        raise InputError(f"cannot write {path}: {problem} in {existing}", "choose another place") from error


def _try_to_write(folder: Path) -> None:
    """Make a file in a folder and remove it. If possible the file has no name, so a killed process leaves no file."""
    try:
        os.close(os.open(folder, os.O_WRONLY | os.O_TMPFILE))
    except (AttributeError, OSError) as error:
        if getattr(error, "errno", None) not in (None, errno.EOPNOTSUPP, errno.EISDIR, errno.EINVAL, errno.ENOENT):
            raise
        temporary = _temporary(folder / "trial", "partial")
        temporary.touch()
        temporary.unlink()


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8) atomically."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="")


def write_csv(
    path: str | Path,
    rows: Iterable[Mapping[str, Any]],
    columns: Iterable[str] | None = None,
    float_format: str = "",
) -> None:
    """Write rows as CSV atomically. None and NaN are written as empty cells.

    `columns` are written in the given order. The default is all columns in the order of first appearance. An example
    of `float_format` is ``.6g``. The default format writes all digits.
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


def _digest(path: str | Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
