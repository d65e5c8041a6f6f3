"""The import of open3d: what a missing package or system library reports."""

from __future__ import annotations

import sys

import pytest

from mstfilter.base.errors import MissingLibraryError
from mstfilter.base.lazy import import_open3d


def test_a_missing_package_is_reported_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingLibraryError, match="needs open3d, which cannot be imported") as caught:
        import_open3d()
    assert caught.value.hints == ("pip install open3d",)


@pytest.mark.parametrize("kind", [ImportError, OSError])
def test_a_missing_system_library_is_reported_with_the_packages_that_hold_it(monkeypatch, kind):
    def fail(name):
        raise kind("libGL.so.1: cannot open shared object file: No such file or directory")

    monkeypatch.setattr("mstfilter.base.lazy.import_module", fail)
    with pytest.raises(MissingLibraryError, match="libGL.so.1") as caught:
        import_open3d()
    assert "\n" not in caught.value.message
    assert "libusb-1.0-0 libgl1 libegl1 libgomp1" in caught.value.hints[0]


def test_it_runs_on_one_thread():
    try:
        open3d = import_open3d()
    except MissingLibraryError as error:
        pytest.skip(error.message)
    assert open3d.utility.get_max_threads() == 1
