"""Functions that are computed at the same time, in any thread and in forked processes."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from mstfilter.base.processes import each, parallel, together
from tests.conftest import REPOSITORY

PATIENCE_S = 120  # a thread that waits longer waits for ever


def test_two_functions_run_at_the_same_time_and_nested_calls_do_not_wait_for_each_other():
    barrier = threading.Barrier(2, timeout=PATIENCE_S)

    def nested(k):
        barrier.wait()
        return together(lambda: together(lambda: k, lambda: k + 1), lambda: k + 2)

    with parallel(2):
        assert together(lambda: nested(0), lambda: nested(10)) == (((0, 1), 2), ((10, 11), 12))
    assert together(lambda: 1, lambda: 2) == (1, 2)


@pytest.mark.parametrize("n", [1, 2, 4, 8])
def test_all_threads_of_a_block_are_used_and_no_more(n):
    barrier, lock = threading.Barrier(n, timeout=PATIENCE_S), threading.Lock()
    running = most = 0

    def count(k):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        barrier.wait()  # passes only if n calls run at the same time
        with lock:
            running -= 1
        return k

    with parallel(n):
        assert each(count, range(3 * n)) == list(range(3 * n))
    assert most <= n


def test_nested_calls_share_the_threads_of_the_block():
    barrier = threading.Barrier(4, timeout=PATIENCE_S)

    def inner(k):
        barrier.wait()
        return k

    with parallel(4):
        found = each(lambda k: each(lambda m: inner(10 * k + m), range(2)), range(2))
    assert found == [[0, 1], [10, 11]]


def test_blocks_in_several_threads_do_not_affect_each_other():
    """Each block has its own threads from its begin to its end, also while others begin and end."""
    together_in_all = threading.Barrier(6, timeout=PATIENCE_S)

    def user(k):
        for _ in range(50):
            with parallel(2):
                assert each(lambda m: 100 * k + m, range(8)) == [100 * k + m for m in range(8)]
        with parallel(2):  # two threads of each of the three users at the same time
            return together(together_in_all.wait, together_in_all.wait)

    with ThreadPoolExecutor(3) as users:
        assert sorted(sum(users.map(user, range(3)), ())) == list(range(6))


def test_a_block_in_a_block_has_its_own_number():
    with parallel(4), parallel(1):
        names = each(lambda _: threading.current_thread().name, range(4))
    assert set(names) == {threading.current_thread().name}


@pytest.mark.parametrize("n", [1, 2])
def test_an_error_of_either_function_is_raised(n):
    def fail():
        raise ValueError("it fails")

    with parallel(n):
        for pair in ((fail, int), (int, fail)):
            with pytest.raises(ValueError, match="it fails"):
                together(*pair)


@pytest.mark.parametrize("n", [1, 2, 4, 8])
def test_the_first_of_several_errors_is_raised_and_ends_the_calls(n):
    begun = []

    def fail(k):
        begun.append(k)
        if k >= 5:
            raise ValueError(f"call {k} fails")

    with parallel(n), pytest.raises(ValueError, match="call 5 fails"):
        each(fail, range(1000))
    assert len(begun) < 5 + 1 + n


def forked(parent: str, child: str, after: str = "") -> str:
    """What a script prints that runs `parent`, prints `child` in a forked process, and then runs `after`."""
    script = f"""
import multiprocessing, sys
import numpy as np
import mstfilter

def use_opencv():
    import cv2
    cv2.setNumThreads(4)
    image = np.random.default_rng(0).integers(0, 255, (1000, 1000, 3)).astype(np.uint8)
    cv2.resize(cv2.GaussianBlur(image, (31, 31), 0), (3000, 3000), interpolation=cv2.INTER_CUBIC)
    return cv2.getNumThreads()

def use_pool():
    from mstfilter.base.processes import each, parallel
    with parallel(4):
        return sum(each(len, ["a", "b", "c", "d"]))

def step():
    from mstfilter.scene import scene_cache
    from tests.runs.live.test_stream import CAMERA, DEPTH, RGB, TIMES
    scene_cache.clear()
    with mstfilter.base.processes.parallel(2):
        recording = mstfilter.Recording.from_arrays(RGB, DEPTH, CAMERA.K, times=TIMES, pauses=(2, 13))
        state, _ = mstfilter.preset("mst_rules", "n=1", "n_proposed=2").run(recording.clips(), seed=0)
    return state.t

{parent}
process = multiprocessing.get_context("fork").Process(target=lambda: print({child}, flush=True))
process.start()
process.join({PATIENCE_S})
if process.is_alive():
    process.kill()
    print("the child hangs")
{after}
"""
    given = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script], env=given, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked on this system")
@pytest.mark.parametrize("parent", ["use_opencv()", "use_pool(); step(); use_opencv()"])
def test_a_filter_runs_in_a_forked_process(parent):
    assert forked(parent, "step()") == "2\n"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked on this system")
def test_the_pool_is_used_in_a_forked_process():
    assert forked("use_pool()", "use_pool()") == "4\n"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked on this system")
def test_a_fork_keeps_the_threads_of_opencv_in_the_parent():
    assert forked("use_opencv()", "0", "import cv2; print(cv2.getNumThreads())") == "0\n4\n"
