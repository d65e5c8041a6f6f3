"""Every module of `mstfilter.smc` opens with an example that runs as it stands."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import mstfilter.smc

MODULES = [
    "mstfilter.smc",
    *(module.name for module in pkgutil.walk_packages(mstfilter.smc.__path__, "mstfilter.smc.")),
]


@pytest.mark.parametrize("name", MODULES)
def test_the_example_of_a_module_runs(name, tmp_path, monkeypatch):
    """In an empty namespace, as a reader would paste it."""
    monkeypatch.chdir(tmp_path)  # one of them stores a state
    module = importlib.import_module(name)
    test = doctest.DocTestParser().get_doctest(module.__doc__ or "", {}, name, module.__file__, 0)
    assert test.examples, "the module has no example"
    assert all(doctest.SKIP not in example.options for example in test.examples[:-1]), "the example cannot be run"
    said: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE).run(test, out=said.append)
    assert not said, "".join(said)
