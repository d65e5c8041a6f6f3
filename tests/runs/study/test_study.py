"""Studies: grids, identity, resuming, isolation of what fails."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections import Counter

import numpy as np
import pytest

from mstfilter.app.report import write_study_report
from mstfilter.base.code import code_of
from mstfilter.base.errors import InputError
from mstfilter.runs import RunFolder
from mstfilter.runs.study.config import SceneEntry, load_study, split_grid, study_of
from mstfilter.runs.study.plan import make_plan
from mstfilter.runs.study.study import run_study
from mstfilter.runs.study.worker import perform
from mstfilter.scene import Cache
from tests.runs.study.scenes import metrics, run_here, slide, table
from tests.runs.study.test_failures import LIGHT

BASE = """
description = "test"
seeds = [0, 1]
[[scenes]]
recordings = "slide-*"
group = "slide"
[[arms]]
preset = "floor_components"
set = ["resampler=systematic,residual", "proposal.completer=extrude"]
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
    first = run_here(study, tmp_path / "out", cache=tmp_path / "cache", progress=True)
    assert (first.done, first.repeated, first.failed) == (8, 0, ())
    assert "8/8" in capsys.readouterr().err
    rows = metrics(tmp_path / "out")
    assert len(rows) == 2 * 2 * 2 * 3
    assert {r["arm"] for r in rows} == {
        f"floor_components resampler=systematic {LIGHT}",
        f"floor_components resampler=residual {LIGHT}",
    }
    assert {(r["scene"], r["family"]) for r in rows} == {("slide-0", "slide"), ("slide-1", "slide")}
    made = {p: p.stat().st_mtime_ns for p in (tmp_path / "out" / "runs").rglob("result.json")}
    before = (tmp_path / "out" / "runs.csv").read_bytes()
    again = run_here(study, tmp_path / "out", cache=tmp_path / "cache")
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
        run_here(chosen, tmp_path / keep, cache=tmp_path / "cache")
        runs = list((tmp_path / keep / "runs").iterdir())
        assert runs and all((path / "pauses").exists() == (keep == "all") for path in runs)
    assert metrics(tmp_path / "all") == metrics(tmp_path / "tables")


def test_a_worker_with_other_code_refuses():
    outcome = perform({"code": "another", "folder": "unused"})
    assert outcome.error == "this process has other code of mstfilter than the study began with"


def test_arms_that_use_the_ground_truth_are_marked(folder, tmp_path):
    data = {"name": "s", "folder": folder, "scenes": [{"recordings": "slide-0"}], "seeds": [0]}
    arms = [{"preset": "mst", "set": ["n_proposed=2"]}]
    arms.append({"name": "oracle", "preset": "mst", "set": ["n_proposed=2", 'update.evidence=["true_quality"]']})
    result = run_here(study_of({**data, "arms": arms}), tmp_path / "out", cache=tmp_path / "cache")
    assert result.failed == ()
    assert result.folder.truth_users == {"oracle": ["TrueQuality"]}
    for run in result.folder.description["runs"]:
        marked = RunFolder.open(result.folder.run(run["folder"])).description["uses_truth"]
        assert marked == result.folder.truth_users.get(run["arm"], [])


@pytest.mark.nightly
def test_what_runs_share_changes_no_result(folder, tmp_path, monkeypatch):
    """Two arms of a recording in one worker, with and without its memory; and the second arm alone."""
    data = {"name": "s", "folder": folder, "scenes": [{"recordings": "slide-0"}], "seeds": [0]}
    arms = [{"name": "first"}, {"name": "second", "set": ["update.n_views=1"]}]
    computed = []
    get_many = Cache.get_many

    def counted(self, name, keys, compute, shared=False):
        def compute_and_count(indices):
            computed.extend([name] * len(indices))
            return compute(indices)

        return get_many(self, name, keys, compute_and_count, shared)

    monkeypatch.setattr(Cache, "get_many", counted)
    found, counts = {}, {}
    for case, chosen, cache_gb in (("shared", arms, 1), ("not shared", arms, 0), ("alone", arms[1:], 1)):
        computed.clear()
        run_here(study_of({**data, "arms": chosen, "cache_gb": cache_gb}), tmp_path / case, cache=tmp_path)
        found[case] = metrics(tmp_path / case)
        counts[case] = Counter(name for name in computed if name in ("clip tracks", "segmentation_tree"))
    assert found["shared"] == found["not shared"]
    assert found["shared"][3:] == found["alone"] and len(found["alone"]) == 3
    assert counts["shared"] == counts["alone"] == {"clip tracks": 2, "segmentation_tree": 3}
    assert counts["not shared"]["segmentation_tree"] > 3


def test_an_edit_of_a_comment_does_not_make_finished_runs_foreign(folder, tmp_path, monkeypatch):
    """Of the user's file; and `code_version` ignores it in the files of the package."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "own.py"
    text = """from dataclasses import dataclass
from mstfilter.smc import Transition

@dataclass(frozen=True)
class Stay(Transition):
    def predict(self, rng, population, observation):
        return population
"""
    data = {"name": "s", "folder": folder, "scenes": [{"recordings": "slide-0"}], "seeds": [0]}
    study = study_of({**data, "arms": [{"preset": "floor_components", "set": ["transition=./own.py:Stay"]}]})

    def repeated(source):
        file.write_text(source)
        return run_here(study, tmp_path / "out", cache=tmp_path).repeated

    assert repeated(text) == 0
    assert repeated(f'"""My file."""\n{text}  # the end') == 1
    assert repeated(text.replace("return population", "return population.take([0])")) == 0
    found = {code_of(b"def f(x):\n    " + body) for body in (b"return x", b"'All.'\n    return x  # this")}
    assert len(found) == 1 and code_of(b"def f(x):\n    return -x") not in found
    assert code_of(b"__version__ = '1'") == code_of(b"__version__ = '2'") and code_of(b"(") == b"("


OWN = """
from dataclasses import dataclass
import numpy as np
from mstfilter.scoring import Metric

@dataclass(frozen=True)
class Volume(Metric):
    scale: float = 1.0

    def measure(self, recording, t, hypotheses, weights):
        return {"volume": self.scale * weights @ [(h.labels > 0).sum() for h in hypotheses], "first": float("nan")}

@dataclass(frozen=True)
class Pause(Metric):
    def measure(self, recording, t, hypotheses, weights):
        return t

@dataclass(frozen=True)
class Breaks(Metric):
    def measure(self, recording, t, hypotheses, weights):
        return 1 / (1 - t)

@dataclass(frozen=True)
class Taken(Metric):
    def measure(self, recording, t, hypotheses, weights):
        return {"quality": 1.0}

@dataclass(frozen=True)
class Text(Metric):
    def measure(self, recording, t, hypotheses, weights):
        return "high"

class Plain:
    pass
"""


@pytest.fixture
def own(folder, tmp_path, monkeypatch):
    """The data of a study, in a working folder with own metrics."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(OWN)
    light = {"preset": "floor_components", "set": [LIGHT]}
    arms = [{**light, "name": "floor_components"}, {**light, "name": "one", "set": [LIGHT, "n=1"]}]
    return {"name": "s", "folder": folder, "scenes": [{"recordings": "slide-*"}], "seeds": [0], "arms": arms}


def test_own_metrics_are_in_all_tables_and_measured_in_finished_runs(own, tmp_path):
    out = tmp_path / "out"
    run_here(study_of(own), out, cache=tmp_path)
    made = {p: p.stat().st_mtime_ns for p in out.glob("runs/*/run.json")}
    study = study_of({**own, "metric": {"component": "./own.py:Volume", "scale": 2}})
    found = run_here(study, out, ["metric=./own.py:Pause"], cache=tmp_path)
    assert (found.done, found.failed) == (4, ())
    assert {p: p.stat().st_mtime_ns for p in made} == made  # the filter did not run again
    for row in table(out):
        run = next(
            r for r in found.folder.description["runs"] if (r["arm"], r["scene"]) == (row["arm"], row["scene"])
        )
        run, t = RunFolder(found.folder.run(run["folder"])), int(row["pause"])
        volumes = [(h.labels > 0).sum() for h in run.hypotheses(t)]
        assert float(row["volume"]) == pytest.approx(2 * np.dot(run.info(t)["weights"], volumes), rel=1e-5)
        assert (row["Pause"], row["first"]) == (str(t), "")
    [one] = [c for c in found.folder.summary().compared("Pause")]
    assert (one.difference.n, one.difference.mean, one.adjusted) == (2, 0.0, True)
    rows = {row["metric"]: row for row in table(out, "differences.csv")}
    assert rows["volume"]["conclusion"].startswith("one and floor_components on recordings in volume: no difference")
    assert not rows["occupancy"]["conclusion"]
    for name in ("summary.md", "differences.md", "summary.tex", "differences.tex"):
        assert "volume" in (out / name).read_text() and "Pause" in (out / name).read_text()
    assert run_here(study, out, ["metric=./own.py:Pause"], cache=tmp_path).repeated == 4
    page = write_study_report(out).read_text()
    assert "volume" in page and "Pause" in page


def test_an_error_in_an_own_metric_is_named_and_costs_no_run(own, tmp_path):
    out = tmp_path / "out"
    names = {"Breaks": "metric Breaks at pause 1: ZeroDivisionError: ", "Taken": "another column 'quality'"}
    names["Text"] = "metric Text at pause 0 returned 'high' as 'Text', expected a number"
    made = {}
    for name, error in names.items():
        study = study_of({**own, "metric": ["./own.py:Pause", f"./own.py:{name}"], "keep": "tables"})
        found = run_here(study, out, cache=tmp_path)
        assert len(found.failed) == 4 and all(error in outcome.error for _, outcome in found.failed)
        assert ("own.py, line 21" in found.failed[0][1].error) == (name == "Breaks")
        made = made or {p: p.stat().st_mtime_ns for p in out.glob("runs/*/run.json")}
        assert {p: p.stat().st_mtime_ns for p in made} == made and len(made) == 4
        rows = table(out)
        assert len(rows) == 12 and {row["Pause"] for row in rows} == {"0", "1", "2"}
        assert error in table(out, "failures.csv")[0]["error"]
    (tmp_path / "own.py").write_text(OWN.replace("1 / (1 - t)", "1 / (1 + t)"))
    study = study_of({**own, "metric": ["./own.py:Pause", "./own.py:Breaks"], "keep": "tables"})
    assert run_here(study, out, cache=tmp_path).failed == ()
    assert [row["Breaks"] for row in table(out)][:2] == ["1", "0.5"]
    assert not list(out.glob("runs/*/pauses"))


@pytest.mark.parametrize(
    ("metric", "error"),
    [
        ("volume", "metric is 'volume', expected ./FILE.py:CLASS"),
        ("./none.py:Volume", "file does not exist: ./none.py"),
        ("./own.py:Nothing", "has no class 'Nothing'"),
        ("./own.py:Plain", "Plain is no dataclass"),
        ({"component": "./own.py:Volume", "size": 2}, "Volume has no field 'size'"),
    ],
)
def test_a_wrong_metric_is_an_error_before_any_run(own, tmp_path, metric, error):
    with pytest.raises(InputError, match=re.escape(error)):
        run_here(study_of({**own, "metric": metric}), tmp_path / "out", cache=tmp_path)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("n_recordings", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_a_study_runs_on_a_cluster(folder, tmp_path, n_recordings):
    """A local cluster of dask in this process; the runs are in worker processes all the same."""
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    scenes = tuple(SceneEntry(recordings=(f"slide-{k}",)) for k in range(n_recordings))
    seen, study = [], load_study(folder / "base.toml", smoke=True).model_copy(update={"scenes": scenes})
    with distributed.LocalCluster(
        n_recordings, processes=False, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        address, options = cluster.scheduler_address, {"cache": tmp_path, "progress": seen.append}
        found = run_study(study, tmp_path / "out", cluster=address, **options)
    assert (found.done, found.failed) == (2 * n_recordings, ())
    assert [one.name for one in seen if one.name] == [one.name for one in seen][1:]
    assert seen[-1].done == 2 * n_recordings
    assert len(list((tmp_path / "out" / "logs").iterdir())) == n_recordings  # one for each recording
    run_here(study, tmp_path / "here", cache=tmp_path)
    assert metrics(tmp_path / "out") == metrics(tmp_path / "here")


def test_a_cluster_that_is_missing_is_one_clear_error(folder, tmp_path, monkeypatch):
    study = load_study(folder / "base.toml", smoke=True)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="a cluster needs distributed") as caught:
        run_study(study, tmp_path / "out", cluster="tcp://127.0.0.1:1", cache=tmp_path)
    assert "pip install 'mstfilter[cluster]'" in caught.value.hints


@pytest.mark.nightly
def test_few_recordings_are_divided_between_the_workers(folder, tmp_path):
    """Three workers, two recordings: each of the two parts of a recording has its own worker process."""
    study = load_study(folder / "base.toml", smoke=True)
    found = run_study(study, tmp_path / "out", workers=3, cache=tmp_path)
    assert found.failed == () and {p.name for p in (tmp_path / "out" / "logs").iterdir()} == {
        f"worker-{k}.log" for k in range(3)
    }


def test_peak_memory():
    # In a new process: what earlier tests left is given back at any time.
    code = (
        "import numpy as np; from mstfilter.runs.study import *; reset_peak(); before = peak_megabytes(); "
        "held = np.ones(40 * 2**20 // 8); print(peak_megabytes() - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True)
    assert 35 <= float(done.stdout) < 100
