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
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar, copy_context
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import numpy as np

from mstfilter.base.errors import InputError

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


_MOST_THREADS = 1024  # of the pool, which starts a thread only if all others are busy
#: How many calls the current block `parallel` may still start in the pool. A call in the pool is in the block that
#: started it, and blocks of several threads do not affect each other.
_free_threads: ContextVar[threading.Semaphore] = ContextVar("free_threads")
_NO_THREADS = threading.Semaphore(0)  # outside of all blocks


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """The pool of all blocks `parallel` of a process; a forked child has its own, since threads are not copied."""
    return ThreadPoolExecutor(_MOST_THREADS, "mstfilter")


@contextmanager
def parallel(n_threads: int) -> Iterator[None]:
    """In the block, `together` and `each` use up to `n_threads` threads, which does not change results.

    Blocks in several threads are independent: each has its own number. A block in another block replaces its number.
    """
    token = _free_threads.set(threading.Semaphore(max(n_threads - 1, 0)))
    try:
        yield
    finally:
        _free_threads.reset(token)


def together(first: Callable[[], _A], second: Callable[[], _B]) -> tuple[_A, _B]:
    """The results of two independent functions, computed at the same time in a block `parallel`."""
    calls: tuple[Callable[[], Any], ...] = (first, second)
    found = each(lambda call: call(), calls)
    return found[0], found[1]


def each(function: Callable[[_A], _B], items: Iterable[_A]) -> list[_B]:
    """The results of a function for several items, computed at the same time in a block `parallel`.

    The calls must be independent and free of side effects. They begin in the order of the items. After an error no
    further call begins, and the error of the first item with one is raised, as in a loop.
    """
    given = list(items)
    found: dict[int, _B] = {}
    failed: dict[int, BaseException] = {}
    waiting = iter(range(len(given)))  # `next` of an iterator over a range is atomic

    def work() -> None:
        for k in waiting:
            try:
                found[k] = function(given[k])
            except BaseException as error:
                failed[k] = error
                deque(waiting, maxlen=0)

    with _helped(work, len(given) - 1):
        try:
            work()
        finally:
            deque(waiting, maxlen=0)  # also after Ctrl-C between two calls
    if failed:
        raise failed[min(failed, key=lambda k: (isinstance(failed[k], Exception), k))]  # Ctrl-C before all others
    return [found[k] for k in range(len(given))]


@contextmanager
def _helped(work: Callable[[], None], most: int) -> Iterator[None]:
    """In the block, free threads of the block `parallel` call a function too, at most `most`. Waits for them."""
    free, helpers = _free_threads.get(_NO_THREADS), list[Future[None]]()

    def help_once() -> None:
        try:
            work()
        finally:
            free.release()

    try:
        while len(helpers) < most and free.acquire(blocking=False):
            helpers.append(_pool(os.getpid()).submit(copy_context().run, help_once))
        yield
    finally:
        # A call that has not begun is not needed. So nested calls never wait for a thread.
        for helper in helpers:
            if helper.cancel():
                free.release()
            else:
                helper.result()


def _cpu() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
