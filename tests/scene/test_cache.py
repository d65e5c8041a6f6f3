"""The cache in memory and on disk: same values, bounded size, unreadable entries count as missing, no pickle."""

from __future__ import annotations

import io
import multiprocessing
import os
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass
from typing import Any

import diskcache
import numpy as np
import pytest

from mstfilter.mst.completion import Extrude
from mstfilter.scene import Cache, DiskCache
from mstfilter.scene.arrays import component_key, content_key


@dataclass(frozen=True)
class Thing:
    array: np.ndarray
    text: str = ""
    maybe: np.ndarray | None = None


TYPES = {"thing": Thing, "pair": (Thing, np.ndarray), "array": np.ndarray}


def get(folder, name, key, compute, limit_bytes=10**6, version="1"):
    """The value of a new cache in memory above the folder, as another process would get it."""
    cache = Cache()
    with cache.on_disk(folder, limit_bytes, version):
        return cache.get(name, key, compute, stored_as=TYPES.get(name))


def fail():
    raise AssertionError("computed again")


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


def leaves(value):
    parts = value if isinstance(value, tuple) else (value,)
    return [leaf for part in parts for leaf in ([part] if isinstance(part, np.ndarray) else vars(part).values())]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("thing", Thing(np.arange(6, dtype=np.int16).reshape(2, 3), "word", np.zeros(0, bool))),
        ("thing", Thing(np.array([np.nan, -0.0], np.float32))),
        ("pair", (Thing(np.ones((0, 3, 2)), "x"), np.array([1.5]))),
        ("array", np.asfortranarray(np.arange(6.0).reshape(2, 3))),
        ("array", np.random.default_rng(0).random(20_000)),  # large enough for a file
    ],
)
def test_values_on_disk_are_found_bit_for_bit(tmp_path, name, value):
    key = (b"key", 1, 2.5, ("a", None))
    get(tmp_path, name, key, lambda: value)
    found = get(tmp_path, name, key, fail)
    for x, y in zip(leaves(value), leaves(found), strict=True):
        if isinstance(x, np.ndarray):
            assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())
            assert not y.flags.writeable
        else:
            assert x == y


def test_key_version_and_type_separate_entries(tmp_path):
    get(tmp_path, "array", (1,), lambda: np.zeros(1))
    cache = Cache()
    with cache.on_disk(tmp_path, 10**6, "1"):
        for _ in range(3):
            cache.get("array", (1,), fail, stored_as=np.ndarray)
    assert cache.hits == {"array": 3}  # on disk and in memory
    assert get(tmp_path, "array", (2,), lambda: np.ones(1))[0] == 1
    assert get(tmp_path, "array", (1,), lambda: np.full(1, 5.0), version="2")[0] == 5
    assert get(tmp_path, "array", (1,), fail)[0] == 0
    get(tmp_path, "something else", (1,), lambda: 3)  # without `stored_as`: not written
    with pytest.raises(AssertionError, match="again"):
        get(tmp_path, "something else", (1,), fail)


def packed(**arrays):
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


DAMAGE = {
    "truncated": lambda data: data[: len(data) // 2],
    "flipped": lambda data: data[:40_000] + bytes([data[40_000] ^ 1]) + data[40_001:],
    "empty": lambda data: b"",
    "other": lambda data: packed(unexpected=np.zeros(1)),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_an_unreadable_entry_counts_as_missing(tmp_path, damage):
    get(tmp_path, "array", 1, lambda: np.arange(10_000.0))
    (path,) = tmp_path.rglob("*.val")
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    assert get(tmp_path, "array", 1, lambda: np.full(3, 7.0)).tolist() == [7, 7, 7]
    assert get(tmp_path, "array", 1, fail).tolist() == [7, 7, 7]


def test_a_damaged_database_counts_as_empty(tmp_path):
    get(tmp_path, "array", 1, lambda: np.zeros(1))
    (tmp_path / "cache.db").write_bytes(b"not a database" * 1000)
    assert get(tmp_path, "array", 1, lambda: np.ones(1)).tolist() == [1]


class Executed:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("pack", [lambda found: found, lambda found: packed(value=np.array([found], dtype=object))])
def test_a_pickle_in_the_folder_is_not_executed(tmp_path, pack):
    folder, mark = tmp_path / "work", tmp_path / "executed"
    key = DiskCache(folder, 10**6, "1")._key("array", 1)
    with diskcache.Cache(str(folder)) as foreign:
        foreign.set(key, pack(Executed(mark)))  # diskcache pickles all but bytes
        assert len(foreign) == 1
    assert get(folder, "array", 1, lambda: np.ones(2)).tolist() == [1, 1]
    assert not mark.exists()
    assert get(folder, "array", 1, fail).tolist() == [1, 1]
    pickle.loads(pickle.dumps(Executed(mark)))  # the pickle does what the test assumes
    assert mark.exists()


def test_the_folder_is_bounded_and_the_least_recently_used_entry_goes(tmp_path):
    limit, size = 600_000, 50_000
    disk = DiskCache(tmp_path, limit, "1")
    for k in range(30):
        disk.store("array", k, np.zeros(size // 8))
        assert disk.find("array", 0, np.ndarray) is not None
        files = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
        assert files <= limit + 2 * size
    assert disk.find("array", 29, np.ndarray) is not None
    assert disk.find("array", 1, np.ndarray) is None
    disk.store("array", "huge", np.zeros(limit // 8))
    assert disk.find("array", "huge", np.ndarray) is None
    assert disk.find("array", 29, np.ndarray) is not None  # a value above the limit displaces no other


def read_and_write(folder, seed):
    """Number of wrong values among the entries of a small folder that other workers use at the same time."""
    disk, value, rng, wrong = DiskCache(folder, 150_000, "1"), np.arange(4000.0), np.random.default_rng(seed), 0
    for k in rng.integers(6, size=40).tolist():
        found = disk.find("array", k, np.ndarray)
        if found is None:
            disk.store("array", k, value + k)
        else:
            wrong += not np.array_equal(found, value + k)
    return wrong


def test_threads_and_processes_use_one_folder(tmp_path):
    with multiprocessing.get_context("spawn").Pool(2) as pool, ThreadPoolExecutor(4) as threads:
        wrong = pool.starmap_async(read_and_write, [(tmp_path, 10), (tmp_path, 11)])
        assert [*threads.map(lambda seed: read_and_write(tmp_path, seed), range(4)), *wrong.get()] == [0] * 6
    assert get(tmp_path, "array", "last", lambda: np.zeros(4000), 150_000).sum() == 0
    get(tmp_path, "array", "last", fail, 150_000)


def test_a_folder_that_cannot_be_written_and_a_full_disk_store_nothing(tmp_path, monkeypatch):
    def full(*args, **options):
        raise OSError(28, "No space left on device")

    (tmp_path / "file").write_text("")
    assert get(tmp_path / "file" / "below", "array", 1, lambda: np.ones(2)).tolist() == [1, 1]
    with monkeypatch.context() as patch:
        patch.setattr(diskcache.Cache, "set", full)
        assert get(tmp_path, "array", 1, lambda: np.ones(2)).tolist() == [1, 1]
    assert get(tmp_path, "array", 1, lambda: np.zeros(2)).tolist() == [0, 0]


CLASS = """
from dataclasses import dataclass
from functools import cached_property
from mstfilter.mst.completion import Extrude

@dataclass(frozen=True)
class Mine(Extrude):
    def fill(self, rng, seen):
        return [FACTOR * v for v in seen.surface if v in {"a", "b"}]

    @cached_property
    def other(self):
        return [2 * k for k in range(3)]
"""


def test_a_class_of_the_user_is_known_by_its_code():
    """As in a notebook, where a class is defined again under the same name; its place in a file does not count."""

    def key(text):
        given = {"__name__": "__main__"}
        exec(compile(text, "a cell", "exec"), given)
        return component_key(given["Mine"]())

    first = key(CLASS.replace("FACTOR", "1.0"))
    assert first == key("\n\n" + CLASS.replace("FACTOR", "1.0"))
    assert len({first, key(CLASS.replace("FACTOR", "0.7")), key(CLASS.replace("2 * k", "3 * k"))}) == 3
    named = CLASS.replace("FACTOR * v", "FACTOR * scaled(v)")
    texts = [f"FACTOR = {a}\ndef scaled(v):\n    return {b} * v\n{named}" for a, b in ((1, 1), (1, 2), (2, 1))]
    assert len({key(text) for text in texts}) == 3
    more = "    def more(self): return GIVEN\nfrom functools import partial\nimport numpy\n"
    for template, a, b in (
        ("    padding = {}\n", "1", "2"),
        ("    padding = {}\n", "1, 11", "11, 1"),
        ("    def more(self, k={}): pass\n", "1", "2"),
        ("    def more(self, *, k={}): pass\n", "1", "2"),
        ("    def more(self): return A + B\nA, B = {}\n", "1, 11", "11, 1"),
        (more + "class GIVEN: r = {}\n", "1", "2"),
        (more + "GIVEN = [{}]\nGIVEN.append(GIVEN)\n", "1", "2"),
        (more + "GIVEN = {}\n", "list(range(5000))", "[9] * 5000"),
        (more + "GIVEN = partial(max, {})\n", "1", "2"),
        (more + "GIVEN = numpy.array([{}], 'M8[s]')\n", "1", "2"),
    ):
        first, again, other = (key(CLASS + template.format(value)) for value in (a, a, b))
        assert first == again != other, template
    values = [content_key(value) for value in astuple(Extrude())]
    assert component_key(Extrude()) == content_key("mstfilter.mst.completion.extrude", "Extrude", "", b"", *values)


def made(k):
    @dataclass(frozen=True)
    class Mine:
        def more(self):
            return k

    return Mine()


def test_classes_that_a_function_makes_are_known_by_its_arguments():
    assert component_key(made(1)) != component_key(made(2)) == component_key(made(2))


@dataclass(frozen=True)
class Holder:
    net: Any


def test_fields_without_a_text_of_their_own_are_known_by_their_content():
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
