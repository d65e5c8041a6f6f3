"""The main study runs from end to end in its small form, on tuning seeds, and goes on where it was."""

from __future__ import annotations

import csv

import pytest

from mstfilter.cli import main
from mstfilter.simulation.families import FIRST_REPORTED_SEED
from mstfilter.study.config import load_study
from mstfilter.study.plan import make_plan
from tests.conftest import REPOSITORY

CONFIG = REPOSITORY / "experiments/main/study.toml"
FUSION = REPOSITORY / "experiments/fusion"


def test_smoke(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    command = ["study", str(CONFIG), "--smoke", "--out", str(tmp_path / "out"), "--workers", "2"]
    for _ in range(2):
        try:
            main(command)
        except SystemExit as end:
            assert not end.code
    arms = [arm.name for arm in make_plan(load_study(CONFIG)).arms]
    assert f"{len(arms)} of them before" in capsys.readouterr().out  # the second time nothing is run
    with (tmp_path / "out" / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["arm"] for row in rows} == set(arms) and len(rows) == len(arms) * 2


@pytest.mark.parametrize("config, first", [(CONFIG, 1000), (FUSION / "reported.toml", 1100)])
def test_seeds_are_of_the_right_side(config, first):
    """The studies report seeds that nothing is tuned on; their small forms never look at one."""
    reported = [scene.source["seed"] for scene in make_plan(load_study(config)).scenes]
    assert set(reported) <= set(range(first, first + 100)) and min(reported) >= FIRST_REPORTED_SEED
    small = [scene.source["seed"] for scene in make_plan(load_study(config, smoke=True)).scenes]
    assert max(small) < 100


def test_what_is_reported_of_fusion_is_what_was_tuned():
    """The same arms on other scenes."""
    tuned, reported = (make_plan(load_study(FUSION / f"{name}.toml")) for name in ("study", "reported"))
    assert [(arm.name, arm.key) for arm in tuned.arms] == [(arm.name, arm.key) for arm in reported.arms]
    assert not {scene.name for scene in tuned.scenes} & {scene.name for scene in reported.scenes}
    assert len(tuned.scenes) == len(reported.scenes) == 30
