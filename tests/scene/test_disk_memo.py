"""Shared work on disk: the same values, whoever writes, whatever is broken, never more than the bound."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import pytest

from mstfilter.scene import cache as module
from mstfilter.scene.disk_memo import DiskMemo, Kind


@dataclass(frozen=True)
class Thing:
    array: np.ndarray
    text: str = ""
    maybe: np.ndarray | None = None


KINDS = {"thing": Kind(Thing, "1"), "pair": Kind((Thing, np.ndarray), "1"), "array": Kind(np.ndarray, "1")}


@pytest.fixture
def layer(tmp_path):
    module.clear()
    yield DiskMemo(tmp_path / "work", 10**6, KINDS)
    module.clear()


def ask(layer, name, key, compute):
    module.clear()  # as another process would
    with module.beneath(layer):
        return module.memo(name, key, compute)


def fail():
    raise AssertionError("computed again")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("thing", Thing(np.arange(6, dtype=np.int16).reshape(2, 3), "word", np.zeros(0, bool))),
        ("thing", Thing(np.array([np.nan, -0.0], np.float32))),
        ("pair", (Thing(np.ones((0, 3, 2)), "x"), np.array([1.5]))),
        ("array", np.asfortranarray(np.arange(6.0).reshape(2, 3))),
    ],
)
def test_found_again_bit_for_bit(layer, name, value):
    key = (b"key", 1, 2.5, ("a", None))
    ask(layer, name, key, lambda: value)
    found = ask(layer, name, key, fail)
    parts = [(value, found)] if name != "pair" else list(zip(value, found, strict=True))
    for a, b in parts:
        for x, y in [(a, b)] if isinstance(a, np.ndarray) else [(a.array, b.array), (a.maybe, b.maybe)]:
            if x is None:
                assert y is None
                continue
            assert x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes()
            assert not y.flags.writeable
        if isinstance(a, Thing):
            assert a.text == b.text
    assert layer.hits[name] == 1


def test_key_version_and_name_tell_apart(layer, tmp_path):
    ask(layer, "array", (1,), lambda: np.zeros(1))
    assert ask(layer, "array", (2,), lambda: np.ones(1))[0] == 1
    newer = DiskMemo(layer.folder, 10**6, {"array": Kind(np.ndarray, "2")})
    assert ask(newer, "array", (1,), lambda: np.full(1, 5.0))[0] == 5
    assert ask(layer, "array", (1,), fail)[0] == 0
    ask(layer, "something else", (1,), lambda: 3)  # not a kind: computed, not kept
    with pytest.raises(AssertionError, match="again"):
        ask(layer, "something else", (1,), fail)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "other"])
def test_a_broken_file_counts_as_missing(layer, damage):
    ask(layer, "array", 1, lambda: np.arange(1000.0))
    (path,) = [p for p in layer.folder.rglob("*.npz")]
    data = bytearray(path.read_bytes())
    if damage == "truncated":
        data = data[: len(data) // 2]
    elif damage == "flipped":
        data[len(data) // 2] ^= 1
    elif damage == "empty":
        data = bytearray()
    else:
        np.savez(path, unexpected=np.zeros(1))
        data = bytearray(path.read_bytes())
    path.write_bytes(data)
    assert ask(layer, "array", 1, lambda: np.full(3, 7.0)).tolist() == [7, 7, 7]
    assert ask(layer, "array", 1, fail).tolist() == [7, 7, 7]


def test_the_bound_holds_and_the_oldest_goes(tmp_path):
    import os

    layer = DiskMemo(tmp_path, 50_000, KINDS)
    for k in range(12):
        layer.keep("array", k, np.zeros(1000))
        path = layer._path("array", KINDS["array"], k)
        if path.exists():
            os.utime(path, (1000.0 + k, 1000.0 + k))
        if k == 3:
            assert layer.find("array", 0) is not None  # used: now the youngest
    used = sum(p.stat().st_size for p in tmp_path.rglob("*.npz"))
    assert used <= 50_000 * 1.05 + 9000
    assert layer.find("array", 11) is not None
    assert layer.find("array", 0) is not None
    assert layer.find("array", 1) is None


def test_the_bound_holds_over_many_short_lives(tmp_path):
    """Processes that each write less than they would count still keep the folder bounded."""
    for k in range(40):
        DiskMemo(tmp_path, 50_000, KINDS).keep("array", k, np.zeros(1000))
        assert sum(p.stat().st_size for p in tmp_path.rglob("*.npz")) <= 50_000
    assert DiskMemo(tmp_path, 50_000, KINDS).find("array", 39) is not None


def test_runs_of_a_process_share_one_layer(tmp_path):
    from mstfilter.scene import cache as store
    from mstfilter.study import kind_versions
    from mstfilter.study.shared_work import shared_work

    where = {"folder": str(tmp_path), "gb": 0.5, "versions": kind_versions()}
    seen = []
    for _ in range(2):
        with shared_work(where):
            seen.append(store._layer)
    assert seen[0] is seen[1] is not None


def test_writers_at_the_same_time(tmp_path):
    """Eight threads write and read the same few entries under a bound that keeps removing them."""
    value, wrong = np.arange(2000.0), []

    def work(seed):
        layer, rng = DiskMemo(tmp_path, 60_000, KINDS), np.random.default_rng(seed)
        for _ in range(60):
            k = int(rng.integers(6))
            found = layer.find("array", k)
            if found is None:
                layer.keep("array", k, value + k)
            elif not np.array_equal(found, value + k):
                wrong.append(k)

    threads = [threading.Thread(target=work, args=(s,)) for s in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert not list(tmp_path.rglob("*.partial"))


def test_a_folder_that_cannot_be_written_troubles_nobody(tmp_path):
    (tmp_path / "file").write_text("")
    layer = DiskMemo(tmp_path / "file" / "below", 10**6, KINDS)
    assert ask(layer, "array", 1, lambda: np.ones(2)).tolist() == [1, 1]
