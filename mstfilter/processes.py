"""Processes and threads that this package starts, and the machine on which they run.

>>> with environment(OMP_NUM_THREADS="1"):
...     pool = ProcessPoolExecutor(2)

A new Python interpreter searches modules in the working folder first. So an unknown file ``multiprocessing.py`` there
would be executed. Processes started in a block `environment` do not search this folder first. New processes find the
caller's modules, because `multiprocessing` and joblib pass on the search path.
"""

from __future__ import annotations

import ast
import functools
import logging
import os
import platform
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import numpy as np

from mstfilter.errors import InputError

_A = TypeVar("_A")
_B = TypeVar("_B")


@contextmanager
def environment(**variables: str) -> Iterator[None]:
    """Set environment variables in the block, and PYTHONSAFEPATH for the processes that the block starts."""
    variables = {"PYTHONSAFEPATH": "1", **variables}
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def log_lines(level: int = logging.INFO) -> Iterator[None]:
    """Write messages of the logger "mstfilter" to standard error in the block, one line per message."""
    logger, handler = logging.getLogger("mstfilter"), logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s  %(message)s", "%H:%M:%S"))
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def check_main_guard(what: str) -> None:
    """Raise InputError if each new process would run the caller's script again, including its call of `what`.

    `multiprocessing` imports the script in each new process, except the code below ``if __name__ == "__main__":``.
    """
    main = sys.modules["__main__"]
    path, spec = getattr(main, "__file__", None), getattr(main, "__spec__", None)
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and (frame.f_code.co_name != "<module>" or frame.f_globals is not vars(main)):
        frame = frame.f_back
    if frame is None or path is None or (spec is not None and spec.name.endswith("__main__")):
        return  # called in another thread, in a notebook, or by `python -m PACKAGE`
    with suppress(OSError, SyntaxError):
        for statement in ast.parse(Path(path).read_text(encoding="utf-8")).body:
            here = statement.lineno <= frame.f_lineno <= (statement.end_lineno or statement.lineno)
            if here and not (isinstance(statement, ast.If) and "__name__" in ast.unparse(statement.test)):
                raise InputError(
                    f"{path}, line {frame.f_lineno}: {what} starts processes, and each of them runs the script again",
                    'put the call below `if __name__ == "__main__":`',
                )


@functools.cache
def machine() -> dict[str, Any]:
    """Properties of the machine that affect the last bits of results, such as CPU model and BLAS library of numpy."""
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    return {"cpu": _cpu(), "system": platform.system(), "blas": f"{blas.get('name')} {blas.get('version')}"}


def threads() -> int:
    """Number of threads that libraries may use: OMP_NUM_THREADS, or else the number of available cores."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    return int(given) if given.isdecimal() else available_cores()


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_pools: list[ThreadPoolExecutor] = []  # of the blocks `parallel`, innermost last


@contextmanager
def parallel(n_threads: int) -> Iterator[None]:
    """In the block, `together` uses up to `n_threads` threads. The number of threads does not change results."""
    if n_threads < 2:
        yield
        return
    with ThreadPoolExecutor(n_threads - 1, "mstfilter") as pool:
        _pools.append(pool)
        try:
            yield
        finally:
            _pools.remove(pool)


def together(first: Callable[[], _A], second: Callable[[], _B]) -> tuple[_A, _B]:
    """The results of two independent functions, computed at the same time in a block `parallel`."""
    if not _pools:
        return first(), second()
    other = _pools[-1].submit(second)
    try:
        found = first()
    except BaseException:
        if not other.cancel():
            other.exception()  # wait, so that nothing continues after the error
        raise
    # A call that has not begun is made here. So nested calls cannot wait for each other.
    return found, second() if other.cancel() else other.result()


def each(function: Callable[[_A], _B], items: Iterable[_A]) -> list[_B]:
    """The results of a function for several items, computed two at a time in a block `parallel`.

    The calls must be independent and free of side effects.
    """
    given = list(items)
    found: dict[int, _B] = {}
    waiting = iter(range(len(given)))  # `next` of an iterator over a range is atomic

    def work() -> None:
        for k in waiting:
            found[k] = function(given[k])

    together(work, work)
    return [found[k] for k in range(len(given))]


def _cpu() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
