"""The cache in memory: same values, bounded size; keys of content and of components."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest

from mstfilter.mst.completion import Extrude
from mstfilter.scene import Cache
from mstfilter.scene.arrays import component_key, content_key


def test_a_value_is_computed_once_per_name_and_key():
    cache, calls = Cache(), []

    def found(name, key):
        cache.get(name, key, lambda: calls.append((name, key)))
        return len(calls)

    assert [found(*entry) for entry in (("x", 1), ("x", 1), ("x", 2), ("x", 1), ("y", 1))] == [1, 1, 2, 2, 3]
    assert cache.hits == {"x": 2}
    cache.clear()
    assert found("x", 1) == 4


def test_threads_share_the_values_that_one_of_them_computes():
    cache, calls, begun, go_on = Cache(), [], threading.Event(), threading.Event()

    def compute(indices):
        calls.append(tuple(indices))
        begun.set()
        if not go_on.wait(60):
            raise AssertionError("the other thread does not wait for this value")
        return [str(k) for k in indices]

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(cache.get_many, "x", ["a", "b"], compute)
        assert begun.wait(60)
        second = pool.submit(
            cache.get_many, "x", ["b", "c"], lambda k: calls.append(tuple(k)) or go_on.set() or ["c"]
        )
        assert first.result(60) == ["0", "1"]
        assert second.result(60) == ["1", "c"]
    assert calls == [(0, 1), (1,)]


def test_a_value_whose_computation_fails_is_computed_by_the_thread_that_waits():
    cache, begun, failed = Cache(), threading.Event(), threading.Event()

    def fails():
        begun.set()
        assert failed.wait(60)
        raise ValueError("no value")

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(cache.get, "x", 1, fails)
        assert begun.wait(60)
        second = pool.submit(cache.get, "x", 1, lambda: 9)
        failed.set()
        with pytest.raises(ValueError, match="no value"):
            first.result(60)
        assert second.result(60) == 9


def test_memory_is_bounded_and_drops_the_least_recently_used():
    cache, calls = Cache(limit_bytes=10_000), []
    for key in (1, 2, 1, 3, 1, 2, "huge", 2):
        size = 10_000 if key == "huge" else 500
        cache.get("x", key, lambda key=key, size=size: calls.append(key) or np.zeros(size))
    # 3 displaced 2, which was used before 1; a value above the limit displaces no other.
    assert calls == [1, 2, 3, 2, "huge"]


def test_content_keys_differ_if_content_differs():
    a = np.arange(6)
    assert content_key(a) == content_key(a.copy())
    arrays = [(a,), (a.reshape(2, 3),), (a.astype(np.int32),), (a, 1)]
    different = [*arrays, ("ab", "c"), ("a", "bc"), (b"ab",), (1, 2), (12,)]
    assert len({content_key(*parts) for parts in different}) == len(different)


CLASS = """
from dataclasses import dataclass
from mstfilter.mst.completion import Extrude

@dataclass(frozen=True)
class Mine(Extrude):
    def fill(self, rng, seen):
        return seen.surface
"""


def test_a_class_that_is_defined_again_is_another_class():
    """As in a notebook, under the same name. Instances of one class are known by their fields."""

    def define():
        given = {"__name__": "__main__"}
        exec(compile(CLASS, "a cell", "exec"), given)
        return given["Mine"]

    first, again = define(), define()
    assert component_key(first()) == component_key(first()) != component_key(again())
    assert component_key(first(below=0.5)) != component_key(first())
    values = [content_key(value) for value in astuple(Extrude())]
    assert component_key(Extrude()) == content_key("mstfilter.mst.completion.extrude", "Extrude", "", b"", *values)


def made(k):
    @dataclass(frozen=True)
    class Mine:
        def more(self):
            return k

    return Mine()


def test_classes_that_a_function_makes_differ():
    one = made(1)
    assert component_key(one) == component_key(one) != component_key(made(2))


@dataclass(frozen=True)
class Holder:
    net: Any


class Model:
    """An object of a library, such as a fitted model."""

    def __init__(self, weights):
        self.weights = weights


def scaled(x, by=1):
    return by * x


@pytest.mark.parametrize(
    ("a", "equal", "other"),
    [
        (Model(np.ones(3)), Model(np.ones(3)), Model(np.zeros(3))),
        (partial(scaled, by=2), partial(scaled, by=2), partial(scaled, by=3)),
        (scaled, scaled, made),
        (np.exp, np.exp, np.log),
        (int, int, float),
        (None, None, 0),
        ({"a": [1, 2]}, {"a": [1, 2]}, {"a": [2, 1]}),
        (Model([1]).__init__, Model([1]).__init__, Model([2]).__init__),
    ],
)
def test_fields_of_any_kind_are_known_by_their_content(a, equal, other):
    keys = [component_key(Holder(value)) for value in (a, equal, other)]
    assert keys[0] == keys[1] != keys[2]


def test_lambdas_and_what_refers_to_itself_have_a_key():
    itself = Model(None)
    itself.weights = itself
    keys = {component_key(Holder(value)) for value in (lambda x: x, lambda x: -x, itself, iter(range(2)))}
    assert len(keys) == 4


def test_torch_modules_are_known_by_their_weights():
    torch = pytest.importorskip("torch")
    a, b = torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)
    copy = torch.nn.Linear(2, 1)
    copy.load_state_dict(a.state_dict())
    keys = [component_key(Holder(net)) for net in (a, b, copy)]
    assert keys[0] != keys[1] and keys[0] == keys[2]


def test_forget_keeps_what_the_last_two_steps_used():
    cache = Cache()
    for step in range(4):
        cache.get("first", 0, lambda: np.zeros(10))
        for used in (step, step - 1):  # the frames of this pause and of the one before
            cache.get("frame", used, lambda: np.zeros(1000))
        cache.forget()
    assert cache.n_bytes == 3 * (8000 + 128) + 80 + 128  # frames 1, 2 and 3 of the last two steps
    cache.forget()
    cache.forget()
    assert cache.n_bytes == 0
    cache.get("frame", 1, lambda: np.zeros(10))
    assert cache.hits["frame"] == 3


def test_a_worker_keeps_what_runs_share_until_the_limit_is_reached():
    cache = Cache(limit_bytes=40_000)
    cache.keeps_shared = True
    for step in range(10):
        cache.get("flow", step, lambda: np.zeros(100), shared=True)
        cache.get("geometry", step, lambda: np.zeros(1000))
        cache.forget()
        assert cache.n_bytes <= 40_000

    def never():
        raise AssertionError("computed again")

    for step in range(10):  # the next run
        cache.get("flow", step, never, shared=True)
    assert cache.n_bytes < 10 * (800 + 128) + 3 * (8000 + 128)
    cache.limit_bytes = 5_000
    cache.get("flow", 10, lambda: np.zeros(100), shared=True)
    assert cache.n_bytes <= 5_000
    cache.keeps_shared = False
    for _ in range(3):
        cache.forget()
    assert cache.n_bytes == 0
