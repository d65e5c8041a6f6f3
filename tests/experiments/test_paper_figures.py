"""The figures of the paper's kinds are made from end to end in their small form; their parts are checked."""

from __future__ import annotations

import importlib
from functools import cache
from xml.etree import ElementTree

from tests.app.report.test_study_report import make_study
from tests.experiments.scripts import EXPERIMENTS, own_modules, run_script

FOLDER = EXPERIMENTS / "paper_figures"
SIMULATED = ("teaser.png", "sampled_cuts.png")
REAL = ("merging.png", "merge_forms.csv")


def make(tmp_path, *arguments, **more):
    return run_script("paper_figures/make.py", "--smoke", "--out", tmp_path / "out", *arguments, **more)


@cache
def script(name):
    """A module of the folder, as the command imports it."""
    with own_modules(FOLDER):
        return importlib.import_module(name)


def test_simulated_figures(tmp_path):
    make(tmp_path, "teaser", "sampled_cuts")
    assert all((tmp_path / "out" / name).stat().st_size > 2000 for name in SIMULATED)


def test_real_figures(tmp_path, shared_data):
    shared_data("r1")
    make(tmp_path, "merging")
    assert all((tmp_path / "out" / name).stat().st_size > 300 for name in REAL)


def test_missing_data_are_reported(tmp_path):
    printed = make(tmp_path, "merging", "quality_over_time", MSTFILTER_SHARED=tmp_path)
    assert printed.count("left out") == 2
    assert not (tmp_path / "out").exists()
    assert "no figure is called 'mergin'" in make(tmp_path, "mergin", expected_exit=2)


def test_quality_over_time_is_a_complete_file(tmp_path):
    study = make_study(tmp_path / "study", arms=("ours", "<theirs>", "a ceiling"), reported_only=("a ceiling",))
    (path,) = script("quality_over_time").make(tmp_path / "out", study)
    text = path.read_text()
    ElementTree.fromstring(text)
    assert "var(" not in text and "currentColor" not in text
    assert "ours" in text and "&lt;theirs&gt;" in text and "a ceiling" not in text
    (path,) = script("quality_over_time").make(tmp_path / "out", study, ["ours", "a ceiling"])
    assert "a ceiling" in path.read_text() and "theirs" not in path.read_text()
    assert path.name == "quality_over_time.svg", "this study has no recording, so its runs have no log loss"
    wrong = make(tmp_path, "quality_over_time", "--study", study, "--arms", "ours,mine", expected_exit=2)
    assert "the study has no arm 'mine'" in wrong


def test_figures_use_tuning_seeds():
    assert all(script(name).SEED < 100 for name in ("teaser", "sampled_cuts"))
