"""The store of shared work."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.scene import cache as module
from mstfilter.scene.arrays import content_key


@pytest.fixture(autouse=True)
def _clean():
    module.clear()
    yield
    module.clear()


def test_computed_once_a_key():
    calls = []
    for key in (1, 1, 2, 1):
        module.memo("x", key, lambda key=key: calls.append(key))
    assert calls == [1, 2]
    module.memo("y", 1, lambda: calls.append("y"))
    assert calls[-1] == "y"


def test_the_store_is_bounded_and_drops_the_oldest(monkeypatch):
    monkeypatch.setattr(module, "LIMIT_BYTES", 10_000)
    calls = []

    def make(key):
        return lambda: calls.append(key) or np.zeros(500)

    for key in (1, 2, 1, 3, 1, 2):
        module.memo("x", key, make(key))
    assert calls == [1, 2, 3, 2]  # 2 was used longest ago when 3 came
    module.memo("x", "huge", lambda: np.zeros(10_000))
    module.memo("x", 2, make(2))
    assert calls == [1, 2, 3, 2]


def test_keys_tell_content_apart():
    a = np.arange(6)
    assert content_key(a) == content_key(a.copy())
    different = {content_key(a), content_key(a.reshape(2, 3)), content_key(a.astype(np.int32)), content_key(a, 1)}
    different |= {
        content_key("ab", "c"),
        content_key("a", "bc"),
        content_key(b"ab"),
        content_key(1, 2),
        content_key(12),
    }
    assert len(different) == 9
