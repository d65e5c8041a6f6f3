"""Shared work on disk, beneath the store of `memo`: for other processes, and for tomorrow.

>>> layer = DiskMemo(folder, limit_bytes=10**9, kinds={"clip tracks": Kind(ClipTracks, version)})
>>> with beneath(layer):
...     run()                                    # what is computed under these names is kept, and found again

Only entries that cost much more to compute than to read are worth a kind. An entry is one .npz file, named by the
content of its key and by the version of the code that makes it. Several processes may read and write the same folder:
files are renamed into place whole, carry a checksum, and one that cannot be read counts as missing.
"""

from __future__ import annotations

import contextlib
import math
import os
import uuid
import zipfile
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.scene.arrays import content_key
from mstfilter.scene.cache import Layer

__all__ = ["DiskMemo", "Kind"]


@dataclass(frozen=True)
class Kind:
    """What entries of one name are.

    Parameters
    ----------
    of : type or tuple of types
        An array, a dataclass whose fields are arrays, texts or None, or a tuple of these.
    version : str
        Of the code that computes them: entries of another version are not found.
    """

    of: Any
    version: str


@dataclass
class DiskMemo(Layer):
    """Entries in a folder.

    Parameters
    ----------
    folder : Path
    limit_bytes : int
        Beyond it, what was used longest ago is removed. Each object looks when it writes first and after every
        twentieth of the limit that it has written, so the folder may exceed the limit by that much an object.
    kinds : mapping
        Name -> what its entries are. Other names are not kept.
    """

    folder: Path
    limit_bytes: int
    kinds: Mapping[str, Kind]
    hits: dict[str, int] = field(default_factory=dict, init=False)
    _written: float = field(default=math.inf, init=False)  # since it looked; it has not yet

    def find(self, name: str, key: Hashable) -> Any:
        """The entry; None where there is none that can be read."""
        kind = self.kinds.get(name)
        if kind is None:
            return None
        path = self._path(name, kind, key)
        try:
            with np.load(path, allow_pickle=False) as data:
                value = _unpacked(kind.of, {k: data[k] for k in data.files}, "")
            os.utime(path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            _remove(path)
            return None
        self.hits[name] = self.hits.get(name, 0) + 1
        return value

    def keep(self, name: str, key: Hashable, value: Any) -> None:
        """Write an entry. A disk that is full keeps nothing, and nobody is troubled."""
        kind = self.kinds.get(name)
        if kind is None:
            return
        path = self._path(name, kind, key)
        partial = path.with_name(f".{uuid.uuid4().hex}.partial")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                arrays: dict[str, Any] = _packed(value, "")
                np.savez(file, **arrays)
            size = partial.stat().st_size
            os.replace(partial, path)
        except OSError:
            _remove(partial)
            return
        self._written += size
        if self._written > self.limit_bytes / 20:
            self._written = 0
            self.trim()

    def trim(self) -> int:
        """Remove what was used longest ago until the folder is within 9/10 of its limit; bytes left."""
        entries = []
        for path in self.folder.rglob("*"):
            try:
                found = path.stat()
            except OSError:  # somebody else removed it
                continue
            if path.is_file():
                entries.append((found.st_mtime, found.st_size, path))
        used = sum(size for _, size, _ in entries)
        if used > self.limit_bytes:
            for _, size, path in sorted(entries, key=lambda e: e[0]):
                if used <= 0.9 * self.limit_bytes:
                    break
                _remove(path)
                used -= size
        return used

    def _path(self, name: str, kind: Kind, key: Hashable) -> Path:
        digest = content_key(name, kind.version, key).hex()
        return self.folder / name.replace(" ", "_") / digest[:2] / f"{digest[2:]}.npz"


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


def _packed(value: Any, at: str) -> dict[str, np.ndarray]:
    """Arrays of a value, named by their place in it."""
    if isinstance(value, np.ndarray):
        return {at or "value": value}
    if isinstance(value, str):
        return {at: np.array(value, np.str_)}
    if value is None:
        return {}
    parts: Iterator[tuple[str, Any]]
    if isinstance(value, tuple):
        parts = ((str(k), part) for k, part in enumerate(value))
    else:
        parts = ((f.name, getattr(value, f.name)) for f in fields(value))
    return {k: v for name, part in parts for k, v in _packed(part, f"{at}.{name}" if at else name).items()}


def _unpacked(of: Any, arrays: Mapping[str, np.ndarray], at: str) -> Any:
    """The value of `_packed`, its arrays read-only."""
    if isinstance(of, tuple):
        return tuple(_unpacked(part, arrays, f"{at}.{k}" if at else str(k)) for k, part in enumerate(of))
    if is_dataclass(of):
        named = {f.name: _plain(arrays, f"{at}.{f.name}" if at else f.name) for f in fields(of)}
        assert isinstance(of, type)
        return of(**named)
    value = _plain(arrays, at or "value")
    if value is None:
        raise KeyError(at)
    return value


def _plain(arrays: Mapping[str, np.ndarray], at: str) -> Any:
    value = arrays.get(at)
    if value is None:
        return None
    if value.dtype.kind == "U":
        return str(value)
    value.flags.writeable = False
    return value
