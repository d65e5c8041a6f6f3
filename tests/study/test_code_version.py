"""Which code a result depends on: what its components import, late imports too; not what they say of themselves."""

from __future__ import annotations

import importlib
import os
import sys

import pytest

from mstfilter.errors import InputError
from mstfilter.study import code_version as version_module, jobs
from mstfilter.study.code_version import code_version, files_version, reached

PACKAGE = "mstfilter_of_a_test"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of three modules: a imports b, and c inside a function; d stands alone."""
    folder = tmp_path / PACKAGE
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "a.py").write_text(f'"""Says."""\nfrom {PACKAGE} import b\ndef f():\n    from {PACKAGE}.c import g\n')
    (folder / "b.py").write_text("X = 1  # a comment\n")
    (folder / "c.py").write_text('def g():\n    """Does."""\n    return 1\n')
    (folder / "d.py").write_text("import math\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("mstfilter.study.code_version._PACKAGE", PACKAGE)
    importlib.invalidate_caches()
    sys.modules.pop(PACKAGE, None)
    version_module._path.cache_clear()
    yield folder
    sys.modules.pop(PACKAGE, None)
    version_module._path.cache_clear()


def change(path, text):
    path.write_text(text)
    os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns + 10**9))


def test_imports_are_followed(package):
    assert reached([f"{PACKAGE}.a"]) == {f"{PACKAGE}.{m}" for m in "abc"}
    assert reached([f"{PACKAGE}.d", "numpy"]) == {f"{PACKAGE}.d"}


def test_code_counts_and_words_do_not(package):
    first, alone = code_version([f"{PACKAGE}.a"]), code_version([f"{PACKAGE}.d"])
    change(package / "c.py", 'def g():\n\n    """Does it better."""\n    return 1  # and says so\n')
    change(package / "d.py", "import math, os\n")
    assert code_version([f"{PACKAGE}.a"]) == first
    assert code_version([f"{PACKAGE}.d"]) != alone
    change(package / "c.py", "def g():\n    return 2\n")
    assert code_version([f"{PACKAGE}.a"]) != first


def test_what_the_presets_reach():
    modules = reached(["mstfilter.fusion.update"])
    assert "mstfilter.fusion.crossover" in modules and "mstfilter.scene.voxels" in modules
    assert not {m for m in modules if m.startswith(("mstfilter.tracking", "mstfilter.study", "mstfilter.simulation"))}


def test_a_worker_with_other_code_refuses():
    job = {"code": "another", "modules": ["mstfilter.fusion.update"]}
    with pytest.raises(InputError, match="code has changed since the study began"):
        jobs._verify(job)
    jobs._verify({**job, "code": files_version(job["modules"])})
    assert files_version(["mstfilter.fusion.update"]) != files_version(["mstfilter.fusion.crossover"])
