"""Cached values on disk, for other processes and later runs.

>>> with scene_cache.on_disk(folder, limit_bytes=10**9, version="1"):  # doctest: +SKIP
...     run()                                    # values with `stored_as` are stored, and found again

Only values for which `memo` gets `stored_as` are stored on disk. The library diskcache stores the entries and
removes the least recently used entries beyond the limit. Entries are .npz files without pickled objects.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import sqlite3
import warnings
import zipfile
from collections.abc import Hashable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

import diskcache
import numpy as np

from mstfilter.base.errors import InputWarning
from mstfilter.base.files import make_folders
from mstfilter.base.reading import check_private, read_bytes, unpack_arrays
from mstfilter.scene.arrays import content_key

# CPython 3.11 raises SystemError if two threads parse the headers of arrays at once (python/cpython#106905).
_UNREADABLE = (OSError, ValueError, TypeError, KeyError, EOFError, SystemError, zipfile.BadZipFile, sqlite3.Error)


_LOCK_S = 5  # for which a process waits for another one that writes
_FILE = re.compile(r"[0-9a-f]{2}/[0-9a-f]{2}/[0-9a-f]{28}\.val".replace("/", re.escape(os.sep)))


class _BytesDisk(diskcache.Disk):
    """Stores keys and values as bytes. The base class `diskcache.Disk` would unpickle values, which can run code."""

    def put(self, key: bytes) -> tuple[Any, bool]:
        return sqlite3.Binary(key), True

    def get(self, key: Any, raw: bool) -> bytes:
        return bytes(key)

    def fetch(self, mode: int, filename: Any, value: Any, read: bool) -> Any:
        if mode not in (diskcache.core.MODE_RAW, diskcache.core.MODE_BINARY):
            raise ValueError(f"entry has mode {mode}, expected bytes")
        if mode == diskcache.core.MODE_RAW:
            return bytes(value)
        self._check_file(filename)
        return read_bytes(Path(self._directory, filename), "an entry")

    def remove(self, file_path: Any) -> None:
        with contextlib.suppress(ValueError):
            self._check_file(file_path)
            super().remove(file_path)

    def _check_file(self, name: Any) -> None:
        """Raise ValueError if a file name in the database is not in diskcache's format or leads out of the folder."""
        inside = Path(self._directory).resolve() / str(name)
        if not _FILE.fullmatch(str(name)) or inside.parent.resolve() != inside.parent:
            raise ValueError(f"entry has the file {name!r}")


class DiskCache:
    """Values in a folder, which is created if necessary. `version` is part of the key of every entry.

    Several processes may use the folder at the same time. An entry that cannot be read is treated as missing. Nothing
    is stored, and no error is raised, if the folder cannot be written, the disk is full, or another process locks the
    folder. A locked folder is reported by an InputWarning.

    Only the current user can access a new folder. InputError is raised if the folder belongs to another user or if
    other users can write to the folder.
    """

    def __init__(self, folder: str | Path, limit_bytes: int, version: str) -> None:
        self.version, self.limit_bytes = version, limit_bytes
        self._entries: diskcache.Cache | None = None
        self.folder = Path(folder)
        check_private(self.folder)
        try:
            make_folders(self.folder, 0o700)
            if not self._can_lock():
                return
            self._entries = diskcache.Cache(
                str(folder),
                timeout=_LOCK_S,
                disk=_BytesDisk,
                size_limit=limit_bytes,
                cull_limit=3,  # entries removed per entry that is written beyond the limit
                eviction_policy="least-recently-used",
                # A folder may be on a network file system, which has no memory shared between machines.
                sqlite_journal_mode="delete",
                sqlite_mmap_size=0,
                sqlite_synchronous=0,  # entries carry checksums, so a lost write is only a missing entry
            )
        except Exception:  # the settings in the data base become attributes of the cache: any error
            self._entries = None

    def _can_lock(self) -> bool:
        """Whether the database can be written now. Without this test, diskcache would wait a minute for a lock."""
        with contextlib.closing(sqlite3.connect(self.folder / "cache.db", timeout=_LOCK_S)) as probe:
            try:
                probe.execute("BEGIN IMMEDIATE")
            except sqlite3.OperationalError as error:
                if "locked" not in str(error):
                    raise
                self._give_up()
                return False
            probe.rollback()
        return True

    def _give_up(self) -> None:
        """Stop using the locked folder, because every further access would wait for the lock."""
        self._entries = None
        message = f"the cache {self.folder} is locked by another process for more than {_LOCK_S} s"
        warnings.warn(InputWarning(message, "this process continues without it"), stacklevel=4)

    def find(self, name: str, key: Hashable, stored_as: Any) -> Any:
        """The value of an entry, or None if no readable entry exists. Arrays in the value are read-only."""
        if self._entries is None:
            return None
        try:
            data = self._entries.get(self._key(name, key))
            if data is None:
                return None
            return _unpack(stored_as, unpack_arrays(io.BytesIO(data)), "")
        except diskcache.Timeout:
            self._give_up()
            return None
        except _UNREADABLE as error:
            if isinstance(error, sqlite3.OperationalError) and "locked" in str(error):
                self._give_up()
            return None

    def store(self, name: str, key: Hashable, value: Any) -> None:
        """Write an entry. An entry that cannot be written causes no error."""
        if self._entries is None:
            return
        data = io.BytesIO()
        arrays: dict[str, Any] = _pack(value, "")
        np.savez(data, **arrays)
        if data.tell() <= self.limit_bytes:
            try:
                self._entries.set(self._key(name, key), data.getvalue(), tag=name)
            except diskcache.Timeout:
                self._give_up()
            except (OSError, sqlite3.Error):
                return

    def close(self) -> None:
        """Close the files that this thread has opened."""
        if self._entries is not None:
            self._entries.close()

    def _key(self, name: str, key: Hashable) -> bytes:
        return content_key(name, self.version, key)


def _pack(value: Any, path: str) -> dict[str, np.ndarray]:
    """The arrays in a value, by their paths. The path ``0.labels`` means the field `labels` of item 0 of a tuple."""
    if value is None:
        return {}
    if isinstance(value, np.ndarray):
        return {path or "value": value}
    if isinstance(value, str):
        return {path: np.array(value, np.str_)}
    if isinstance(value, tuple):
        parts = {str(k): part for k, part in enumerate(value)}
    else:
        parts = {f.name: getattr(value, f.name) for f in fields(value)}
    return {k: v for name, part in parts.items() for k, v in _pack(part, _joined(path, name)).items()}


def _unpack(of: Any, arrays: Mapping[str, np.ndarray], path: str) -> Any:
    """The value of type `of`, rebuilt from the arrays of `_pack`."""
    if isinstance(of, tuple):
        return tuple(_unpack(part, arrays, _joined(path, str(k))) for k, part in enumerate(of))
    if is_dataclass(of):
        assert isinstance(of, type)
        stored = {f: arrays.get(_joined(path, f.name)) for f in fields(of)}
        given = {f.name: _leaf(a) for f, a in stored.items() if a is not None or f.default is MISSING}
        return of(**given)
    return _leaf(arrays[path or "value"])


def _leaf(array: np.ndarray | None) -> np.ndarray | str | None:
    if array is None:
        return None
    if array.dtype.kind == "U":
        return str(array)
    array.flags.writeable = False
    return array


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
