"""The studies (main, fusion, ablations, error budget) run in their small form."""

from __future__ import annotations

import pytest

from mstfilter.app.cli import main
from mstfilter.base.files import read_csv
from mstfilter.runs.study import load_study, make_plan
from mstfilter.scoring import LOG_LOSS
from tests.experiments.scripts import EXPERIMENTS, import_script, run_script
from tests.runs.study.scenes import in_process

MAIN = EXPERIMENTS / "main/study.toml"
pytestmark = pytest.mark.nightly


def run_small(tmp_path, config, *overrides):
    """The folder of a study in its small form."""
    out = tmp_path / config.stem
    with in_process():
        try:
            main(["study", str(config), *overrides, "--smoke", "--no-report", "--workers", "1", "--out", str(out)])
        except SystemExit as end:
            assert not end.code
    return out


def write_tables(folder, out, *more):
    """The tables that the script writes of a study, by the name of the file."""
    run_script("tables.py", folder, out, *more)
    return {path.stem: read_csv(path) for path in out.iterdir()}


@pytest.mark.parametrize("name", ["main/paper_best", "fusion/study", "ablations/study", "completion/study"])
def test_studies_run_in_their_small_form(tmp_path, name):
    path = EXPERIMENTS / f"{name}.toml"
    folder = run_small(tmp_path, path)
    arms = [arm.name for arm in make_plan(load_study(path, smoke=True)).arms]
    name = load_study(path).name
    found = write_tables(folder, tmp_path / "tables")
    assert [row["arm"] for row in found[name]] == arms
    assert [row["arm"] for row in found[f"{name}_time"]] == [row["arm"] for row in found[f"{name}_cases"]] == arms
    for row in found[f"{name}_cases"]:
        assert float(row["visible"]) > 0 and 0 <= float(row["quality_visible"]) <= 1
    beside = [arm for arm in arms if arm.startswith("true masks")]
    assert [row["arm"] for row in found[f"{name}_differences"]] == [a for a in arms[1:] if a not in beside]
    if beside:
        found = write_tables(folder, tmp_path / "tables", "--reference", "true masks: mst")
        assert [row["arm"] for row in found[f"{name}_true_masks_differences"]] == beside[1:]


def test_number_of_hypotheses(tmp_path):
    """Two scenes: the log loss of each is recalibrated by the other one."""
    folder = run_small(tmp_path, EXPERIMENTS / "number/study.toml")
    rows = read_csv(folder / "runs.csv")
    assert all(0 < float(row[LOG_LOSS]) < 1 for row in rows)
    found = write_tables(folder, tmp_path / "tables")
    endpoints = [(row["endpoint"], row["arm"]) for row in found["number_differences"]]
    assert endpoints == [("quality", "mst n = 1"), (LOG_LOSS, "mst n = 1")]
    pauses = write_tables(folder, tmp_path / "tables", "--pooled")["number_pooled_pauses"]
    invented = {row["arm"]: row for row in pauses if row["metric"] == "volume_invented"}
    own = [float(row["volume_invented"]) for row in rows if row["pause"] == "1" and row["arm"] == "mst n = 5"]
    assert float(invented["mst n = 5"]["pause_1"]) == pytest.approx(sum(own) / len(own), abs=1e-4)

    run_script("number/tables.py", folder, "--out", tmp_path / "out")
    rows = read_csv(tmp_path / "out/number.csv")
    assert [row["n"] for row in rows] == ["1", "5"] and all(0 < float(row[LOG_LOSS]) < 1 for row in rows)
    difference = float(rows[1][LOG_LOSS]) - float(rows[0][LOG_LOSS])
    assert float(rows[1]["minus_smaller"]) == pytest.approx(difference, abs=2e-3)
    assert rows[0]["low"] == "" and float(rows[1]["low"]) <= float(rows[1]["minus_smaller"]) <= float(rows[1]["high"])
    assert (tmp_path / "out/number.png").exists()


def test_main_study_runs_and_resumes(tmp_path, capsys):
    for _ in range(2):
        folder = run_small(tmp_path, MAIN, "n=2")
    arms = [arm.name for arm in make_plan(load_study(MAIN)).arms]
    assert f"{len(arms)} of them earlier" in capsys.readouterr().out  # the second time no run is left to do
    rows = read_csv(folder / "runs.csv")
    assert {row["arm"] for row in rows} == set(arms) and len(rows) == len(arms) * 2


def test_a_study_by_families_has_the_tables_of_the_whole_study(tmp_path, capsys):
    config = tmp_path / "two.toml"
    small = "{ width = 160, height = 120, n_actions = 1, frames_per_clip = 8, voxel_size = 0.02 }"
    families = ("demo", "table")
    config.write_text(
        'seeds = [0]\nkeep = "tables"\narms = [{ preset = "single_frame, floor_image" }]\n'
        + "".join(f'[[scenes]]\nfamily = "{name}"\nseeds = "1-2"\nset = {small}\n' for name in families)
    )

    def study(folder, *options):
        with in_process(), pytest.raises(SystemExit) as end:
            main(["study", str(config), *options, "--no-report", "--workers", "1", "--out", str(tmp_path / folder)])
        return end.value.code

    assert study("none", "--family", "s1")
    assert "no family 's1'" in (said := capsys.readouterr().err) and "demo, table" in said
    assert not study("both")
    whole = write_tables(tmp_path / "both", tmp_path / "whole")
    joined = tmp_path / "joined"
    for name in families:
        assert not study(name, "--family", name)
        assert {row["family"] for row in read_csv(tmp_path / name / "runs.csv")} == {name}
        run_script("tables.py", tmp_path / name, tmp_path / "rows", "--rows")
    run_script("tables.py", config, joined)
    for name in ("two_scenes", "two_cases"):
        for row, expected in zip(read_csv(joined / f"{name}.csv"), whole[name], strict=True):
            assert row.keys() == expected.keys()
            for key, text in expected.items():
                same = row[key] == text or float(row[key]) == pytest.approx(float(text), abs=2e-4)
                assert same, (name, key)
    # Rows that do not belong to the plan.
    capsys.readouterr()
    config.write_text(config.read_text().replace('seeds = "1-2"', 'seeds = "1-3"'))
    import_script("tables.py").Source.of(config)
    assert "rows of 4 of 12 runs are missing" in capsys.readouterr().err
    config.write_text(config.read_text().replace('seeds = "1-3"', "seeds = 1"))
    assert "has no run" in run_script("tables.py", config, joined, expected_exit=1)


def test_error_budget(tmp_path):
    folder = run_small(tmp_path, EXPERIMENTS / "error_budget/study.toml")
    quality = {row["arm"]: float(row["quality"]) for row in read_csv(folder / "runs.csv")}
    assert len(quality) == 3
    assert quality["all true"] >= 0.95 > quality["mst"]  # readings change their segment at borders, voxels are 2 cm
