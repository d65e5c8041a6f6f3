"""Studies: grids, identity, resuming, isolation of what fails."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
import subprocess
import sys

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.runs import RunFolder
from mstfilter.runs.study.config import SceneEntry, load_study, split_grid, study_of
from mstfilter.runs.study.jobs import perform
from mstfilter.runs.study.plan import make_plan
from mstfilter.runs.study.study import run_study
from tests.runs.study.scenes import InProcess, metrics, slide

BASE = """
description = "test"
seeds = [0, 1]
[[scenes]]
recordings = "slide-*"
group = "slide"
[[arms]]
preset = "floor_components"
set = ["resampler=systematic,residual"]
[smoke]
seeds = 3
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two recordings of three pauses, and a study file beside them."""
    path = tmp_path_factory.mktemp("study")
    for k in range(2):
        slide(path / f"slide-{k}", seed=k)
    (path / "base.toml").write_text(BASE)
    return path


def test_a_finished_study_repeats_no_run(folder, tmp_path, capsys):
    study = load_study(folder / "base.toml")
    first = run_study(study, tmp_path / "out", InProcess(), cache=tmp_path / "cache", progress=True)
    assert (first.done, first.repeated, first.failed) == (8, 0, ())
    assert "8/8" in capsys.readouterr().err
    rows = metrics(tmp_path / "out")
    assert len(rows) == 2 * 2 * 2 * 3
    assert {r["arm"] for r in rows} == {
        "floor_components resampler=systematic",
        "floor_components resampler=residual",
    }
    assert {(r["scene"], r["family"]) for r in rows} == {("slide-0", "slide"), ("slide-1", "slide")}
    made = {p: p.stat().st_mtime_ns for p in (tmp_path / "out" / "runs").rglob("result.json")}
    before = (tmp_path / "out" / "runs.csv").read_bytes()
    again = run_study(study, tmp_path / "out", InProcess(), cache=tmp_path / "cache")
    assert (again.done, again.repeated) == (8, 8)
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "out" / "runs").rglob("result.json")} == made
    assert (tmp_path / "out" / "runs.csv").read_bytes() == before


def test_split_grid():
    assert split_grid("n=1,2") == ["n=1", "n=2"]
    assert split_grid("a.b = x , y") == ["a.b=x", "a.b=y"]
    assert split_grid('a=[1, 2],"x,y"') == ["a=[1, 2]", 'a="x,y"']


def test_identity_depends_on_the_configuration(folder):
    study = load_study(folder / "base.toml")
    runs = make_plan(study).runs
    assert len({run.identity for run in runs}) == len(runs) == 8
    assert [run.identity for run in make_plan(study).runs] == [run.identity for run in runs]
    other = make_plan(study, ["n=4"]).runs
    assert not {run.identity for run in other} & {run.identity for run in runs}
    assert json.loads(json.dumps(runs[0].arm.config)) == runs[0].arm.config


def test_a_corrected_truth_is_another_recording(tmp_path):
    """Quality and all that oracles do depend on it."""
    found = set()
    for label in (1, 2, 2):
        path = slide(tmp_path / "slide", seed=0)
        with np.load(path / "voxels.npz") as data:
            volumes = {name: np.where(data[name] == 1, label, data[name]) for name in data.files}
        np.savez(path / "voxels.npz", **volumes)
        study = study_of(
            {"name": "s", "folder": tmp_path, "scenes": [{"recordings": "slide"}], "arms": [{}], "seeds": [0]}
        )
        found.add(make_plan(study).runs[0].identity)
        shutil.rmtree(path)
    assert len(found) == 2


def test_recordings_of_one_name_in_two_groups(tmp_path):
    scenes = []
    for k, group in enumerate("ab"):
        slide(tmp_path / group / "000001", seed=k)
        scenes.append({"recordings": f"{group}/000001", "group": group})
    base = {"name": "s", "folder": tmp_path, "arms": [{}], "seeds": [0]}
    assert [s.name for s in make_plan(study_of({**base, "scenes": scenes})).scenes] == ["a-000001", "b-000001"]
    unnamed = [{"recordings": s["recordings"]} for s in scenes]
    with pytest.raises(InputError, match="two scenes are called 'recordings-000001'") as caught:
        make_plan(study_of({**base, "scenes": unnamed}))
    assert caught.value.hints == ("give each a different group",)


def test_keep_tables_removes_the_hypotheses(folder, tmp_path):
    study = load_study(folder / "base.toml", smoke=True)
    scenes = (SceneEntry(recordings=("slide-0",)),)
    for keep in ("all", "tables"):
        chosen = study.model_copy(update={"keep": keep, "scenes": scenes})
        run_study(chosen, tmp_path / keep, InProcess(), cache=tmp_path / "cache")
        runs = list((tmp_path / keep / "runs").iterdir())
        assert runs and all((path / "pauses").exists() == (keep == "all") for path in runs)
    assert metrics(tmp_path / "all") == metrics(tmp_path / "tables")


def test_a_worker_with_other_code_refuses():
    outcome = perform({"kind": "run", "code": "another", "folder": "unused"})
    assert outcome.error == "this process has other code of mstfilter than the study began with"


def test_arms_that_use_the_ground_truth_are_marked(folder, tmp_path):
    data = {"name": "s", "folder": folder, "scenes": [{"recordings": "slide-0"}], "seeds": [0]}
    arms = [{"preset": "mst"}]
    arms.append({"name": "oracle", "preset": "mst", "set": ['update.evidence=["true_quality"]']})
    result = run_study(study_of({**data, "arms": arms}), tmp_path / "out", InProcess(), cache=tmp_path / "cache")
    assert result.failed == ()
    assert result.folder.truth_users == {"oracle": ["TrueQuality"]}
    for run in result.folder.description["runs"]:
        marked = RunFolder.open(result.folder.run(run["folder"])).description["uses_truth"]
        assert marked == result.folder.truth_users.get(run["arm"], [])


def test_shared_work_changes_no_result(folder, tmp_path):
    """Without it, writing it, finding it, and finding it broken."""
    data = {"name": "s", "folder": folder, "scenes": [{"recordings": "slide-0"}], "arms": [{}], "seeds": [0]}
    found, cache = {}, tmp_path / "cache"
    for case in ("none", "written", "found", "broken"):
        if case == "broken":
            files = list((cache / "work").rglob("*.val"))
            assert files
            for path in files:
                path.write_bytes(path.read_bytes()[:-40])
        study = study_of({**data, "cache_gb": 0 if case == "none" else 1})
        run_study(study, tmp_path / case, InProcess(), cache=cache)
        found[case] = metrics(tmp_path / case)
        assert (cache / "work").exists() == (case != "none")
    with contextlib.closing(sqlite3.connect(cache / "work" / "cache.db")) as database:
        stored = {name for (name,) in database.execute("SELECT DISTINCT tag FROM Cache")}
    assert stored >= {"clip tracks", "segmentation_tree", "completion"}
    assert found["none"] == found["written"] == found["found"] == found["broken"]


def test_peak_memory():
    # In a new process: what earlier tests left is given back at any time.
    code = (
        "import numpy as np; from mstfilter.runs.study.jobs import *; reset_peak(); before = peak_megabytes(); "
        "held = np.ones(40 * 2**20 // 8); print(peak_megabytes() - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True)
    assert 35 <= float(done.stdout) < 100
