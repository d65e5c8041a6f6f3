"""What goes wrong in one run harms no other; what is wrong with the study is said before any run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mstfilter.base.errors import InputError
from mstfilter.base.files import locked
from mstfilter.runs.study import study as studies
from mstfilter.runs.study.config import load_study, study_of
from mstfilter.runs.study.study import run_study
from tests.conftest import REPOSITORY
from tests.runs.study.scenes import metrics, run_here, slide, table

BROKEN = Path(__file__).parent / "broken.py"
FAST = "floor_components"
LIGHT = "proposal.completer=extrude"  # without a network, so that no worker imports torch


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("failing")
    slide(path / "slide", pauses=2)
    return path


def study(folder, *arms, **more):
    """Arms of one recording: ``good`` and ``mst`` succeed, others have a transition that breaks in a way."""
    succeed = {"good": {"preset": FAST, "set": [LIGHT]}, "mst": {"set": ["transition=identity", "n_proposed=2"]}}
    entries = []
    for arm in arms:
        how, _, marker = arm.partition("@")
        rule = [f"transition={BROKEN}:Breaks", f"transition.how={how}", f'transition.marker="{marker}"', LIGHT]
        entries.append({"name": how, **succeed.get(how, {"preset": FAST, "set": rule})})
    data = {"name": "test", "folder": folder, "scenes": [{"recordings": "slide"}], "seeds": [0, 1], "arms": entries}
    return study_of({**data, **more})


def test_failures_are_isolated_listed_and_explained(folder, tmp_path):
    out = tmp_path / "out"
    result = run_study(
        study(folder, "good", "raise", "full", "die", "print", seeds=[0], tries=2), out, workers=1, cache=tmp_path
    )
    assert result.done == 2
    errors = {(r["run"], r["tries"]): r["error"] for r in table(out, "failures.csv")}
    assert "RuntimeError: the component broke" in errors["raise on slide, seed 0", "1"]
    assert "no space left" in errors["full on slide, seed 0", "1"]
    assert errors["die on slide, seed 0", "2"] == "its worker died 2 times, the last time by signal 9"
    assert len(errors) == 3
    assert {r["arm"] for r in table(out)} == {"good", "print"}  # the output of a component has no effect
    trace = next(f["trace"] for f in result.folder.failures() if f["arm"] == "raise")
    assert "broken.py" in trace
    assert not list((out / "runs").glob(".*"))  # no unfinished run remains
    for log in (out / "logs").glob("*"):
        assert log.name.startswith("worker-")


def test_only_failed_runs_are_repeated(folder, tmp_path):
    marker = tmp_path / "once"
    wanted, out = study(folder, "good", f"raise@{marker}", seeds=[0]), tmp_path / "out"
    first = run_here(wanted, out, cache=tmp_path)
    assert (first.done, len(first.failed)) == (1, 1)
    again = run_here(wanted, out, cache=tmp_path)
    assert (again.done, again.repeated, again.failed) == (2, 1, ())
    assert table(out, "failures.csv") == []


@pytest.mark.nightly
def test_a_run_whose_worker_died_is_begun_again(folder, tmp_path):
    seen = []
    wanted = study(folder, f"exit@{tmp_path / 'once'}", seeds=[0])
    result = run_study(wanted, tmp_path / "out", workers=1, cache=tmp_path, progress=seen.append)
    assert result.failed == () and result.done == 1
    assert [p.outcome and p.outcome.tries for p in seen if p.name] == [None, 2]


@pytest.mark.nightly
def test_a_run_that_takes_too_long_is_named(folder, tmp_path, monkeypatch):
    """Only the run that never ends has a time limit, so the test does not depend on the speed of the machine."""
    job_of = studies._job

    def limited(run, *others):
        return {**job_of(run, *others), "timeout_s": 1.0 if run.arm.name == "hang" else 0.0}

    monkeypatch.setattr(studies, "_job", limited)
    wanted = study(folder, "good", "hang", "mst", seeds=[0], tries=1)
    result = run_study(wanted, tmp_path / "out", workers=1, cache=tmp_path)
    assert [(n, o.error, o.tries) for n, o in result.failed] == [
        ("hang on slide, seed 0", "its worker died 1 time, the last time because it took longer than 1 s", 1)
    ]
    assert result.done == 2


@pytest.mark.nightly
def test_an_exception_in_the_progress_function_stops_the_study(folder, tmp_path):
    def stop(progress):
        if progress.name:
            raise ValueError("enough")

    with pytest.raises(ValueError, match="enough"):
        run_study(study(folder, "good", "hang"), tmp_path / "out", workers=2, cache=tmp_path, progress=stop)
    assert not list((tmp_path / "out" / "runs").glob(".*"))


def test_a_recording_that_cannot_be_made_fails_its_runs_only(folder, tmp_path):
    impossible = {"family": "demo", "seeds": 0, "group": "no", "set": {"workspace_x": 0.1, "workspace_y": 0.1}}
    wanted = study(folder, "good", scenes=[{"recordings": "slide"}, impossible], seeds=[0])
    result = run_here(wanted, tmp_path / "out", cache=tmp_path)
    assert result.done == 1
    ((name, outcome),) = result.failed
    assert name == "good on no-0, seed 0" and outcome.error
    assert table(tmp_path / "out", "failures.csv")[0]["run"] == name


def wait_for(path, process):
    """Return when a process has made a file; the process then waits to be stopped.

    The deadline ends the test of a broken program; a slow machine does not reach it.
    """
    deadline = time.monotonic() + 600
    while not path.exists():
        assert time.monotonic() < deadline, f"the process has not made {path} after 600 s"
        assert process.poll() is None, f"the process ended and did not make {path}"
        time.sleep(0.05)


def hanging_study(path, recording, marker):
    """A study file whose second run hangs until it is stopped, and makes `marker` before."""
    hangs = [f"transition={BROKEN}:Breaks", "transition.how=hang", f'transition.marker="{marker}"', LIGHT]
    path.write_text(
        f"seeds = [0, 1]\nscenes = [{{recordings = '{recording}'}}]\n"
        f"arms = [{{name = 'good', preset = '{FAST}', set = ['{LIGHT}']}}, "
        f"{{name = 'hangs', preset = '{FAST}', set = {hangs!r}}}]\n"
    )
    return path


@pytest.mark.nightly
def test_killing_the_study_and_resuming_ends_with_the_same_table(folder, tmp_path):
    """SIGKILL to the study alone: its workers end too, and the same command resumes it."""
    marker, out = tmp_path / "marker", tmp_path / "out"
    config = hanging_study(tmp_path / "study.toml", folder / "slide", marker)
    command = [sys.executable, "-m", "mstfilter", "study", config, "--workers", "1", "--out", out]
    environment = {**os.environ, "MSTFILTER_CACHE": str(tmp_path / "cache")}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for(marker, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = {p: p.stat().st_mtime_ns for p in out.glob("runs/*/result.json")}
    assert len(done) == 1
    assert not (out / "runs.csv").exists()
    resumed = run_here(load_study(config), out, cache=tmp_path / "cache")
    assert resumed.repeated == 1 and resumed.done == 4
    assert {p: p.stat().st_mtime_ns for p in done} == done
    whole = run_here(load_study(config), tmp_path / "whole", cache=tmp_path / "cache")
    assert whole.repeated == 0
    assert metrics(out) == metrics(tmp_path / "whole")
    assert not list((out / "runs").glob(".*"))


@pytest.mark.nightly
def test_a_script_needs_no_guard(folder, tmp_path):
    """Workers do not import the script."""
    script = tmp_path / "script.py"
    lines = (
        "from mstfilter.runs.study import run_study, study_of",
        f"data = {{'name': 'a', 'scenes': [{{'recordings': {str(folder / 'slide')!r}}}], 'seeds': [0]}}",
        f"print(run_study(study_of({{**data, 'arms': [{{'preset': {FAST!r}}}]}}), 'out', workers=1).done)",
    )
    script.write_text("\n".join(lines).replace("'out'", "__import__('pathlib').Path('out')"))
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "MSTFILTER_CACHE": str(tmp_path / "cache")}
    command = [sys.executable, script]
    found = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
    assert found.stdout == "1\n", found.stderr


def test_one_process_a_study(folder, tmp_path):
    out = tmp_path / "out"
    run_here(study(folder, "good", seeds=[0]), out, cache=tmp_path)
    with locked(out), pytest.raises(InputError, match="another process"):
        run_here(study(folder, "good", seeds=[0]), out, cache=tmp_path)


WRONG = {
    'arms = [{set = "resampler=sistematic"}]': "did you mean systematic",
    'arms = [{preset = "mzt"}]': "there is no preset 'mzt'",
    'arms = [{set = "n=3,"}]': "empty value",
    "arms = []": "has no arm",
    "scenes = []": "has no scene",
    "seeds = []": "has no seed",
    'seeds = "3-1"': "ends before it starts",
    'seeds = "x"': "not of the form 0-4, 7",
    "seeds = [1, 1]": "names a seed twice",
    'arms = [{set = "n=5"}, {name = "same"}]': "two arms are the same: 'mst n=5' and 'same'",
    'arms = [{name = "a"}, {name = "a", set = "n=4"}]': "two arms are called 'a'",
    'arms = [{set = "n=4,4"}]': "two arms are the same",
    'scenes = [{family = "demo", seeds = [1, 1]}]': "two scenes are the same",
    'scenes = [{family = "nowhere", seeds = 1}]': "unknown scene family 'nowhere'",
    'scenes = [{family = "demo", seeds = 1, set = {height_m = 2}}]': "has no field 'height_m'",
    'scenes = [{family = "demo", seeds = 1, set = {fps = "fast"}}]': "fps",
    'scenes = [{recordings = "absent-*"}]': "recording does not exist",
    'scenes = [{family = "demo"}]': "has no seeds",
    "scenes = [{seeds = 1}]": "needs either family",
    'seeds = "0-3000000000"': "are more than 100000 seeds",
    "arms = [{{set = {}}}]".format([f"{name}={','.join(map(str, range(1, 33)))}" for name in "nnnnnn"]): (
        "the grid of an arm has 1073741824 combinations, at most 10000 are run"
    ),
    'seeds = "0-50000"\narms = [{set = "update.n_views=1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21"}]': (
        "1050021 runs, at most 1000000 are planned: 21 arms, 1 scenes and 50001 seeds"
    ),
    'scenes = [{family = "demo", seeds = "1-2"}]\narms = [{set = "proposal=mask_folder"}]': (
        "the files of MaskProposal belong to one recording, and the study has 2 scenes"
    ),
    'reference = "mine"': "reference is 'mine', which is not an arm",
    "colour = 1": "fields of a study",
    'keep = "some"': "keep",
    "= 3": "not valid TOML",
}


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_study_is_one_clear_error_before_any_run(folder, tmp_path, line):
    base = {
        "seeds": "seeds = [0]",
        "scenes": f'scenes = [{{recordings = "{folder / "slide"}"}}]',
        "arms": 'arms = [{set = "transition=identity"}]',
    }
    given = [one.partition(" ")[0] for one in line.splitlines()]
    kept = [text for name, text in base.items() if name not in given]
    (tmp_path / "study.toml").write_text("\n".join([*kept, line]))
    with pytest.raises(InputError) as caught:
        run_study(load_study(tmp_path / "study.toml"), tmp_path / "out", cache=tmp_path / "cache")
    assert WRONG[line] in " ".join([caught.value.message, *caught.value.hints])
    assert not (tmp_path / "out").exists()


def test_folders_that_will_not_do(folder, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is not a study folder"):
        run_study(study(folder, "good"), tmp_path / "file", cache=tmp_path)
    with pytest.raises(InputError, match="cannot write .*below and a lock beside it: "):
        run_study(study(folder, "good"), tmp_path / "file" / "below", cache=tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("x")
    with pytest.raises(InputError, match="is not a study folder"):
        run_study(study(folder, "good"), tmp_path / "mine", cache=tmp_path)
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["precious.txt"]
