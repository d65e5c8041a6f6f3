"""Scripts and study files of experiments/, without running them: `make nightly` runs their small forms."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.lab.simulation import FIRST_REPORTED_SEED
from mstfilter.runs.study import load_study, make_plan
from tests.conftest import find_shared
from tests.experiments.scripts import EXPERIMENTS, import_script, run_script

SCRIPTS = [
    str(p.relative_to(EXPERIMENTS)) for p in sorted(EXPERIMENTS.glob("*/*.py")) if '"--smoke"' in p.read_text()
]


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_can_be_imported_and_its_small_form_never_overwrites_results(script):
    assert "would overwrite the" in run_script(script, "--smoke", expected_exit=2)


#: Studies of reported scenes, and their first seed; all others are of tuning scenes.
REPORTED = {"main/study": 1000, "fusion/study": 1100}
STUDIES = [
    str(p.relative_to(EXPERIMENTS).with_suffix(""))
    for p in sorted(EXPERIMENTS.glob("*/*.toml"))
    if "[[arms]]" in (text := p.read_text()) and "trained/" not in text  # needs weights that a script makes
]


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_can_be_planned_and_keeps_tuning_and_reported_seeds_apart(name, monkeypatch):
    """The small form uses tuning seeds only. Seeds from 100 to 199 confirm what was chosen on those below."""
    path, first = EXPERIMENTS / f"{name}.toml", REPORTED.get(name, 0)
    if 'family = "m1"' in path.read_text():
        monkeypatch.setenv("MSTFILTER_OBJECTS", str(find_shared("meshes/index.csv").parent))
    seeds = [scene.source["seed"] for scene in make_plan(load_study(path)).scenes]
    assert set(seeds) <= set(range(first, first + (100 if first else 200)))
    assert first == 0 or first >= FIRST_REPORTED_SEED
    if "[smoke]" in path.read_text():
        assert all(scene.source["seed"] < 100 for scene in make_plan(load_study(path, smoke=True)).scenes)


def test_f_of_segments_and_borders():
    segment_f = import_script("osd_frames/measures.py").segment_f
    truth = np.zeros((480, 640), np.int64)
    truth[100:200, 100:200], truth[100:200, 300:400] = 1, 2
    assert segment_f(truth, truth) == segment_f((3 - truth) * (truth > 0), truth) == (1.0, 1.0)
    assert segment_f(np.minimum(truth, 1), truth)[0] == 0.5  # half of its pixels are of the object that it matches
    assert segment_f(np.where(truth == 1, 1, 0), truth) == pytest.approx((2 / 3, 2 / 3))
    assert segment_f(np.zeros_like(truth), truth) == (0.0, 0.0)
    overlap, border = segment_f(np.roll(truth, 2, axis=1), truth)  # within 3 pixels, .3 % of the diagonal
    assert overlap == pytest.approx(0.98) and border == 1
    assert segment_f(np.roll(truth, 10, axis=1), truth)[1] < 0.6
