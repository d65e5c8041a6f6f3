"""The main study runs from end to end in its small form, on tuning seeds, and goes on where it was."""

from __future__ import annotations

import csv

from mstfilter.cli import main
from mstfilter.simulation.families import FIRST_REPORTED_SEED
from mstfilter.study.config import load_study
from mstfilter.study.plan import make_plan
from tests.conftest import REPOSITORY

CONFIG = REPOSITORY / "experiments/main/study.toml"


def test_smoke(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    command = ["study", str(CONFIG), "--smoke", "--out", str(tmp_path / "out"), "--workers", "2"]
    for _ in range(2):
        try:
            main(command)
        except SystemExit as end:
            assert not end.code
    assert "17 of them before" in capsys.readouterr().out  # the second time nothing is run
    with (tmp_path / "out" / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    arms = [arm.name for arm in make_plan(load_study(CONFIG)).arms]
    assert {row["arm"] for row in rows} == set(arms) and len(rows) == len(arms) * 2


def test_seeds_are_of_the_right_side():
    """The study reports seeds that nothing is tuned on; its small form never looks at one."""
    reported = [scene.source["seed"] for scene in make_plan(load_study(CONFIG)).scenes]
    assert set(reported) <= set(range(1000, 1100)) and min(reported) >= FIRST_REPORTED_SEED
    small = [scene.source["seed"] for scene in make_plan(load_study(CONFIG, smoke=True)).scenes]
    assert max(small) < 100
