"""The figures of the paper's kinds are made from end to end in their small form; their parts are checked."""

from __future__ import annotations

import importlib
from functools import cache

import pytest

from tests.experiments.scripts import EXPERIMENTS, own_modules, run_script

FOLDER = EXPERIMENTS / "paper_figures"
SIMULATED = ("teaser.png", "sampled_cuts.png")
REAL = ("merging.png",)


def make(tmp_path, *arguments, **more):
    return run_script("paper_figures/make.py", "--smoke", "--out", tmp_path / "out", *arguments, **more)


@cache
def script(name):
    """A module of the folder, as the command imports it."""
    with own_modules(FOLDER):
        return importlib.import_module(name)


@pytest.mark.nightly
def test_simulated_figures(tmp_path):
    make(tmp_path, "teaser", "sampled_cuts")
    assert all((tmp_path / "out" / name).stat().st_size > 2000 for name in SIMULATED)


@pytest.mark.nightly
def test_real_figures(tmp_path, shared_data):
    shared_data("r1")
    make(tmp_path, "merging")
    assert all((tmp_path / "out" / name).stat().st_size > 300 for name in REAL)


def test_missing_data_are_reported(tmp_path):
    assert "left out" in make(tmp_path, "merging", MSTFILTER_SHARED=tmp_path)
    assert not (tmp_path / "out").exists()
    assert "no figure is called 'mergin'" in make(tmp_path, "mergin", expected_exit=2)


def test_figures_use_tuning_seeds():
    assert all(script(name).SEED < 100 for name in ("teaser", "sampled_cuts"))
