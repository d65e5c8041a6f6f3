"""A disk that stops at a chosen operation, as after a kill or a power failure.

>>> with Disk(folder, stop_at=17) as disk, contextlib.suppress(Stop):
...     command()
>>> disk.lose("unsynced")

Operations are those that change files below a folder: open for writing, write, sync, rename, remove, make a folder.
Operation number `stop_at` is not executed and raises `Stop` (a write stops after half of its bytes). Later operations
have no effect, so that cleaning up in ``finally`` cannot hide what a killed process leaves. `lose` then removes what
a power failure loses:

- ``"unsynced"``: Everything that is not synced is lost. A name is durable if its folder is synced, the contents of a
  file if the file is synced.
- ``"contents"``: The contents of files that are not synced are lost; names remain, as in journaling file systems.

The functions of `os` and `open` of Python are replaced inside the block. Memory maps and files that other languages
write are not seen.
"""

from __future__ import annotations

import builtins
import contextlib
import io
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

LOSSES = ("nothing", "unsynced", "contents")
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


class Stop(BaseException):
    """Raised at the operation at which the process ends."""


class Disk:
    """Counts operations below `root`, and stops at one of them."""

    def __init__(self, root: Path, stop_at: int | None = None) -> None:
        self.root, self._stop_at = Path(os.path.realpath(root)), stop_at
        self.count, self.stopped = 0, False
        self._names: dict[int, dict[str, int]] = {}  # inode of a folder -> its durable names
        self._contents: dict[int, bytes] = {}  # inode of a file -> its durable content
        self._kept: list[int] = []  # open descriptors of removed files, so that no inode is used again
        self._remember(self.root)

    def _remember(self, path: Path) -> None:
        """Mark everything that exists at the start as durable."""
        if path.is_dir():
            self._sync(path)
            for child in path.iterdir():
                self._remember(child)
        else:
            self._sync(path)

    def __enter__(self) -> Disk:
        self._stack = contextlib.ExitStack()
        for name in (
            "mkdir",
            "rmdir",
            "unlink",
            "remove",
            "rename",
            "replace",
            "open",
            "fsync",
            "ftruncate",
            "write",
        ):
            self._stack.enter_context(mock.patch.object(os, name, self._replacing(name, getattr(os, name))))
        opened = self._replacing_open(io.open)
        self._stack.enter_context(mock.patch.object(io, "open", opened))
        self._stack.enter_context(mock.patch.object(builtins, "open", opened))
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.close()

    def operation(self, half: Callable[[], None] = lambda: None) -> bool:
        """Count an operation and return whether it is executed. At `stop_at`, call `half` and raise `Stop`."""
        if self.stopped:
            return False
        self.count += 1
        if self.count == self._stop_at:
            half()
            self.stopped = True
            raise Stop
        return True

    def _replacing(self, name: str, original: Any) -> Any:
        def replaced(first: Any, *arguments: Any, **named: Any) -> Any:
            path = self._path(first, named.get("dir_fd"))
            reads = name == "open" and not arguments[0] & _WRITES
            if path is None or reads:
                return original(first, *arguments, **named)
            if not self.operation():
                if name == "open":
                    raise Stop
                return None
            if name in ("unlink", "remove", "rmdir"):
                self._keep(path)
            if name in ("rename", "replace") and Path(arguments[0]).exists():
                self._keep(Path(arguments[0]))
            result = original(first, *arguments, **named)
            if name == "fsync":
                self._sync(path)
            if name == "mkdir":
                self._names[path.stat().st_ino] = {}
            return result

        return replaced

    def _replacing_open(self, original: Any) -> Any:
        def replaced(file: Any, mode: str = "r", buffering: int = -1, *arguments: Any, **named: Any) -> Any:
            if self._path(file) is None or not set(mode) & set("wax+"):
                return original(file, mode, buffering, *arguments, **named)
            if not self.operation():
                raise Stop
            raw = _File(self, file, mode.replace("b", "").replace("t", ""))
            binary: Any = (io.BufferedRandom if "+" in mode else io.BufferedWriter)(raw)
            return binary if "b" in mode else io.TextIOWrapper(binary, *arguments, **named)

        return replaced

    def _path(self, file: Any, folder: int | None = None) -> Path | None:
        """The path of a name or descriptor if it is below the root."""
        if isinstance(file, int):
            found = Path(os.readlink(f"/proc/self/fd/{file}"))
        else:
            base = Path.cwd() if folder is None else Path(os.readlink(f"/proc/self/fd/{folder}"))
            path = base / os.fspath(file)
            found = Path(os.path.realpath(path.parent), path.name)
        return found if found.is_relative_to(self.root) else None

    def _keep(self, path: Path) -> None:
        if path.exists():
            self._kept.append(os.open(path, os.O_RDONLY))

    def _sync(self, path: Path) -> None:
        inode = path.stat().st_ino
        if path.is_dir():
            self._names[inode] = {child.name: child.stat().st_ino for child in path.iterdir()}
            for child in path.iterdir():
                if child.is_dir():
                    self._names.setdefault(child.stat().st_ino, {})
        else:
            self._contents[inode] = path.read_bytes()

    def lose(self, what: str) -> None:
        """Remove what a power failure loses, "unsynced" or "contents" (see the module)."""
        if what == "contents":
            for path in self.root.rglob("*"):
                if path.is_file():
                    path.write_bytes(self._contents.get(path.stat().st_ino, b""))
        if what == "unsynced":
            inode = self.root.stat().st_ino
            for path in self.root.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            for path, content in list(self._durable(self.root, inode)):
                path.mkdir() if content is None else path.write_bytes(content)
        for descriptor in self._kept:
            os.close(descriptor)
        self._kept.clear()

    def _durable(self, path: Path, inode: int) -> Iterator[tuple[Path, bytes | None]]:
        """Durable paths below a folder with their contents; None is a folder."""
        for name, child in self._names[inode].items():
            if child in self._names:
                yield path / name, None
                yield from self._durable(path / name, child)
            else:
                yield path / name, self._contents.get(child, b"")


class _File(io.FileIO):
    """A file whose writes are operations."""

    def __init__(self, disk: Disk, file: Any, mode: str) -> None:
        super().__init__(file, mode)
        self._disk = disk

    def write(self, data: Any) -> int:
        half = memoryview(data)[: len(data) // 2]
        happens = self._disk.operation(lambda: super(_File, self).write(half) and None)
        return super().write(data) if happens else len(data)


def content(root: Path, skip: Callable[[str], bool] = lambda name: False) -> dict[str, bytes]:
    """Bytes of all files by path below a folder; skipped files have empty bytes."""
    files = (path for path in sorted(root.rglob("*")) if path.is_file())
    return {(name := path.relative_to(root).as_posix()): b"" if skip(name) else path.read_bytes() for path in files}
