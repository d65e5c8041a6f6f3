"""The main study runs from end to end in its small form, on tuning seeds, and goes on where it was."""

from __future__ import annotations

import csv
import subprocess
import sys

import pytest

from mstfilter.cli import main
from mstfilter.simulation import FIRST_REPORTED_SEED
from mstfilter.study import compare, load_study, make_plan
from tests.conftest import REPOSITORY

CONFIG = REPOSITORY / "experiments/main/study.toml"
FUSION = REPOSITORY / "experiments/fusion"
NAMES = ("main_scenes", "main_differences", "paper_best_scenes", "paper_best_differences")


def study(tmp_path, config):
    """The folder of a study in its small form."""
    out = tmp_path / config.stem
    try:
        main(["study", str(config), "--smoke", "--out", str(out), "--workers", "2"])
    except SystemExit as end:
        assert not end.code
    return out


def tables(folder, out, *more):
    """What the script of tables writes of a study, by the name of the file."""
    script = REPOSITORY / "experiments/main/tables.py"
    subprocess.run([sys.executable, str(script), str(folder), str(out), *more], check=True, capture_output=True)
    return {path.stem: list(csv.DictReader(path.open(newline=""))) for path in out.iterdir()}


@pytest.mark.parametrize(
    "config", ["main/paper_best", "fusion/study", "fusion/reported", "ablations/study"], ids=lambda name: name
)
def test_other_studies_run_in_their_small_form(tmp_path, monkeypatch, config):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    path = REPOSITORY / "experiments" / f"{config}.toml"
    make_plan(load_study(path))  # the long form is one that can be run
    folder = study(tmp_path, path)
    arms = [arm.name for arm in make_plan(load_study(path, smoke=True)).arms]
    name = load_study(path).name
    found = tables(folder, tmp_path / "tables")
    assert [row["arm"] for row in found[name]] == arms
    assert all(0 < float(row["quality"]) <= 1 for row in found[name])
    assert [row["arm"] for row in found[f"{name}_time"]] == [row["arm"] for row in found[f"{name}_cases"]] == arms
    for row in found[f"{name}_cases"]:
        assert float(row["visible"]) > 0 and 0 <= float(row["quality_visible"]) <= 1
    beside = [arm for arm in arms if arm.startswith("true masks")]
    assert [row["arm"] for row in found[f"{name}_differences"]] == [a for a in arms[1:] if a not in beside]
    if beside:
        found = tables(folder, tmp_path / "tables", "--reference", "true masks: mst")
        assert [row["arm"] for row in found[f"{name}_true_masks_differences"]] == beside[1:]


def test_smoke(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    for _ in range(2):
        folder = study(tmp_path, CONFIG)
    arms = [arm.name for arm in make_plan(load_study(CONFIG)).arms]
    assert f"{len(arms)} of them before" in capsys.readouterr().out  # the second time nothing is run
    with (folder / "runs.csv").open(newline="") as file:
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


def test_committed_tables_are_of_the_study_and_agree():
    folder = CONFIG.parent / "results"
    read = {name: list(csv.DictReader((folder / f"{name}.csv").open(newline=""))) for name in NAMES}
    for config in (CONFIG, CONFIG.with_name("paper_best.toml")):
        plan = make_plan(load_study(config))
        quality = {}
        for row in read[f"{plan.config.name}_scenes"]:
            quality.setdefault((row["family"], row["arm"]), {})[row["scene"]] = float(row["quality"])
        scenes = {f: {s.name for s in plan.scenes if s.group == f} for f in ("s1", "s2", "s3")}
        assert set(quality) == {(family, arm.name) for family in scenes for arm in plan.arms}
        assert all(set(of_arm) == scenes[family] for (family, _), of_arm in quality.items())
        for row in read[f"{plan.config.name}_differences"]:
            expected = compare(quality[row["family"], plan.reference], quality[row["family"], row["arm"]])
            assert abs(expected.mean - float(row["mean"])) < 2e-4 and int(row["n"]) == expected.n
    claims = [row for row in read["main_differences"] if float(row["p_holm"]) < 0.05]
    assert not claims, "with five scenes nothing can be claimed"
