"""Functions that are computed at the same time."""

from __future__ import annotations

import threading

import pytest

from mstfilter.processes import parallel, together


def test_two_functions_run_at_the_same_time_and_nested_calls_do_not_wait_for_each_other():
    barrier = threading.Barrier(2, timeout=10)

    def nested(k):
        barrier.wait()
        return together(lambda: together(lambda: k, lambda: k + 1), lambda: k + 2)

    with parallel(2):
        assert together(lambda: nested(0), lambda: nested(10)) == (((0, 1), 2), ((10, 11), 12))
    assert together(lambda: 1, lambda: 2) == (1, 2)


@pytest.mark.parametrize("n", [1, 2])
def test_an_error_of_either_function_is_raised(n):
    def fail():
        raise ValueError("it fails")

    with parallel(n):
        for pair in ((fail, int), (int, fail)):
            with pytest.raises(ValueError, match="it fails"):
                together(*pair)
