"""Files and folders are written completely or not at all, by one process at a time, and damage is noticed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.base.files import atomic_folder, atomic_path, cache_folder, damaged_files, locked, sweep, write_sums
from mstfilter.formats import RecordingWriter, open_recording, save_recording
from mstfilter.lab.simulation import cached_recording
from mstfilter.runs import filter_recording
from mstfilter.runs.presets import load_config
from tests.app.test_cli import call
from tests.runs.study.scenes import slide
from tests.runs.test_run import content

CONFIG = load_config("floor_components")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return open_recording(slide(tmp_path_factory.mktemp("recordings") / "slide", pauses=3))


def run(recording, path, seed=1, **more):
    return filter_recording(recording, CONFIG, path, seed, **more)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


HOLDER = """
import sys, time
from mstfilter.base.files import atomic_folder, locked
with locked(sys.argv[1]), atomic_folder(sys.argv[1]) as folder:
    (folder / "half").write_text("x")
    print("ready", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path):
    """A process that writes ``out``, and has not ended."""
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        yield process
        process.kill()


def test_another_process_that_writes_is_named_and_nothing_is_touched(holder, recording, tmp_path, capsys):
    """All writers of folders refuse; when the process is killed, the next writer removes what it left."""
    out, before = tmp_path / "out", names(tmp_path)
    writers = (
        lambda: save_recording(recording, out),
        lambda: run(recording, out),
        lambda: RecordingWriter(out, recording.frames[0].camera),
    )
    for write in writers:
        with pytest.raises(InputError, match=rf"out is being written by another process: process {holder.pid} of .*"):
            write()
    small = ("simulate", "demo", out, "width=80", "height=60", "n_actions=0", "supersample=false")
    for command in (
        small,
        ("convert", recording.path, out),
        ("run", recording.path, "--out", out),
        ("demo", "--out", out),
    ):
        code, _, err = call(*command, capsys=capsys)
        assert code == 2 and str(holder.pid) in err and "wait until it has ended" in err
    assert names(tmp_path) == before and len(before) == 2  # its lock and its temporary folder
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    save_recording(recording, out)
    assert names(tmp_path) == ["out"]


def test_a_run_that_is_compared_is_locked_too(recording, tmp_path):
    run(recording, tmp_path / "run")
    with locked(tmp_path / "run"), pytest.raises(InputError, match="run is being written by another process"):
        run(recording, tmp_path / "run" / "compare" / "without-past")


def test_a_lock_is_released_and_leaves_no_files(tmp_path):
    path = tmp_path / "a" / "b" / "run"
    for _ in range(2):
        with locked(path), pytest.raises(InputError, match="another process"), locked(path):
            pass
    assert names(tmp_path) == []
    with pytest.raises(KeyboardInterrupt), locked(path):
        raise KeyboardInterrupt
    (tmp_path / "link").symlink_to(tmp_path / "real", target_is_directory=True)
    with locked(tmp_path / "real"), pytest.raises(InputError, match="another process"), locked(tmp_path / "link"):
        pass


@pytest.mark.parametrize("existing", ["refuse", "keep", "replace"])
def test_a_folder_that_was_made_meanwhile(tmp_path, existing):
    raised = pytest.raises(InputError, match="made meanwhile") if existing == "refuse" else nullcontext()
    with raised, atomic_folder(tmp_path / "x", existing) as folder:
        (folder / "new").write_text("new")
        (tmp_path / "x").mkdir()
        (tmp_path / "x" / "old").write_text("old")
    assert names(tmp_path) == ["x"]
    assert names(tmp_path / "x") == (["new"] if existing == "replace" else ["old"])


def test_a_failed_block_changes_nothing(tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "old").write_text("old")
    for write in (lambda: atomic_folder(tmp_path / "x", "replace"), lambda: atomic_path(tmp_path / "x" / "old")):
        with pytest.raises(KeyboardInterrupt), write() as partial:
            (partial / "new" if partial.is_dir() else partial).write_text("new")
            raise KeyboardInterrupt
    assert names(tmp_path) == ["x"] and (tmp_path / "x" / "old").read_text() == "old"


def test_what_killed_processes_leave_is_removed(tmp_path):
    """Of a name that is locked: everything. Of other names: what is a day old and belongs to no process."""
    old, young, foreign = ".a.01234567.partial", ".b.01234567.partial", ".c.partial"
    for name in (old, young, foreign, ".d.01234567.replaced", ".e.01234567.replaced", "e"):
        (tmp_path / name).mkdir()
    os.utime(tmp_path / old, (time.time() - 1e5,) * 2)
    with atomic_folder(tmp_path / "alive"):
        (alive,) = tmp_path.glob(".alive*")
        os.utime(alive, (time.time() - 1e5,) * 2)
        sweep(tmp_path, older_than_s=86400)
        kept = {young, foreign, ".d.01234567.replaced", ".e.01234567.replaced", "e", alive.name}
        assert set(names(tmp_path)) == kept
        for name in "bde":
            with locked(tmp_path / name):
                pass
        assert set(names(tmp_path)) == {foreign, "d", "e", alive.name}  # an earlier folder has its name back


def test_a_date_in_the_future_keeps_nothing(tmp_path):
    """As after a correction of the clock."""
    for name in (".a.01234567.partial", ".b.01234567.partial"):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time.time() + 1e7,) * 2)
    sweep(tmp_path, "a")
    assert names(tmp_path) == [".b.01234567.partial"]
    sweep(tmp_path, older_than_s=86400)
    assert names(tmp_path) == []


def test_the_cache_is_swept(tmp_path):
    litter = tmp_path / ".s1-3-00.01234567.partial"
    litter.mkdir()
    os.utime(litter, (time.time() - 1e5,) * 2)
    cached_recording("s1", 3, tmp_path, width=80, height=60, n_actions=0, supersample=False)
    assert litter.name not in names(tmp_path)


# What is removed on request


def test_a_run_is_replaced_after_the_first_step_only(recording, tmp_path):
    kept = content(run(recording, tmp_path / "run").path)

    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(recording, tmp_path / "run", 2, replace=True, progress=interrupt)
    shutil.copytree(recording.path, tmp_path / "broken")
    image = tmp_path / "broken" / "depth" / "000002.png"
    image.write_bytes(image.read_bytes()[:-50])
    with pytest.raises(InputError, match="truncated"):
        run(open_recording(tmp_path / "broken"), tmp_path / "run", 2, replace=True)
    assert content(tmp_path / "run") == kept
    assert run(recording, tmp_path / "run", 2, replace=True).description["seed"] == 2
    assert names(tmp_path) == ["broken", "run"]


@pytest.mark.parametrize("foreign", ["run.json", "pauses/000/notes.txt"])
def test_a_folder_with_files_of_others_is_not_replaced(recording, tmp_path, capsys, foreign):
    """The folder of another program that writes a run.json, and a run with a note of the user."""
    if foreign != "run.json":
        run(recording, tmp_path / "run")
    (tmp_path / "run" / foreign).parent.mkdir(exist_ok=True)
    (tmp_path / "run" / foreign).write_text('{"status": "done"}')
    before = content(tmp_path)
    code, _, err = call("run", recording.path, "--out", tmp_path / "run", "--replace", capsys=capsys)
    assert code == 2 and ("run.json: format: field required" in err or "notes.txt" in err)
    assert content(tmp_path) == before


def test_places_that_cannot_be_replaced(recording, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for path in (tmp_path / "here", Path(".")):
        with pytest.raises(InputError, match="is a mount point or the working folder"):
            run(recording, path)
    (tmp_path / "mounted").mkdir()
    monkeypatch.setattr("os.path.ismount", lambda path: path.name == "mounted")
    with pytest.raises(InputError, match="is a mount point"):
        save_recording(recording, tmp_path / "mounted")


# Damage


def test_a_stopped_run_drops_damaged_pauses(recording, tmp_path):
    whole, path = content(run(recording, tmp_path / "whole").path), tmp_path / "part"
    run(recording, path)
    state = path / "pauses" / "001" / "state.npz"
    state.write_bytes(state.read_bytes()[:-1] + b"x")
    with pytest.warns(InputWarning, match=r"pause 1 is damaged: state.npz has changed") as caught:
        run(recording, path)
    assert caught[0].message.hints == ("pauses 1 to 2 are computed again",)
    assert content(path) == whole
    shutil.rmtree(path / "pauses" / "000")
    with pytest.warns(InputWarning, match=r"pause 0 is damaged: SHA256SUMS is missing"):
        run(recording, path)
    assert content(path) == whole


def test_sums_are_those_of_sha256sum(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.bin").write_bytes(np.arange(1000).tobytes())
    write_sums(tmp_path)
    if shutil.which("sha256sum"):
        subprocess.run(["sha256sum", "--strict", "-c", "SHA256SUMS"], cwd=tmp_path, check=True, capture_output=True)
    assert damaged_files(tmp_path) == []
    text = (tmp_path / "SHA256SUMS").read_text()
    for broken in ("", text[1:], text + "\x1b[2J", text.replace("  ", " ")):
        (tmp_path / "SHA256SUMS").write_text(broken)
        assert damaged_files(tmp_path) == ["SHA256SUMS has changed"]


def test_the_cache_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "a"))
    assert cache_folder() == tmp_path / "a"
    monkeypatch.delenv("MSTFILTER_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "b"))
    assert cache_folder() == tmp_path / "b" / "mstfilter"
