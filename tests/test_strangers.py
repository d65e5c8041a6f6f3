"""Files of strangers: whatever they hold is read or refused by one clear error, in time and memory; no code runs."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import resource
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from mstfilter.app.cli import main
from mstfilter.app.report import write_report
from mstfilter.base.errors import InputError, InputWarning
from mstfilter.base.files import damaged_files
from mstfilter.base.reading import check_private, read_arrays
from mstfilter.base.trained import open_model, write_model
from mstfilter.formats import open_recording, read_rgb
from mstfilter.lab.simulation import cached_recording
from mstfilter.smc import run_many
from tests import hostile
from tests.conftest import REPOSITORY

SPOILED_ON_EACH_RUN = 3  # of each kind; experiments/reliability/fuzz_inputs.py does more
NAMES = [name for name in hostile.KINDS if name != "report"]  # its files are those of a run


@pytest.fixture(scope="module")
def examples(tmp_path_factory):
    """A valid input of each kind."""
    folder = tmp_path_factory.mktemp("examples")
    for name in NAMES:
        hostile.KINDS[name].write(folder / name)
    return folder


class Hangs(BaseException):  # no OSError, as TimeoutError is: readers make those an InputError
    pass


@contextlib.contextmanager
def limits(seconds=20, megabytes=1024):
    """Fail if the block takes longer, or asks for more memory."""

    def stop(*_):
        raise Hangs

    before = signal.signal(signal.SIGALRM, stop)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + megabytes * 2**20, hard))
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@pytest.mark.parametrize("name", NAMES)
def test_spoiled_inputs_are_read_or_refused(examples, tmp_path, name):
    kind = hostile.KINDS[name]
    assert hostile.outcome(kind, hostile.copy(examples / name, tmp_path / "trial" / "it")) == "read"
    for seed in range(1 if name in ("weights", "study folder") else SPOILED_ON_EACH_RUN):
        path = hostile.copy(examples / name, tmp_path / "trial" / "it")
        what = hostile.spoil(np.random.default_rng(seed), path)
        with limits(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = hostile.outcome(kind, path)
        assert found in ("read", "refused"), what
        assert (path.parent / "canary").read_text() == "untouched"


@pytest.mark.parametrize(
    ("file", "spoiled"),
    [
        ("run.json", {"config": None, "recording": {"name": "x"}, "seed": "x", "versions": []}),
        ("pauses/000/info.json", {"weights": "x", "parents": {"previous": [7] * 6}, "quality": {}}),
        ("pauses/000/info.json", {"weights": [0.5]}),
        ("pauses/001/camera.json", {"K": [[1]], "T_world_camera": None, "width": "x", "height": 3}),
        ("run.json", {"status": "asleep"}),
    ],
)
def test_a_run_folder_is_checked_before_a_report_is_drawn(examples, tmp_path, file, spoiled, monkeypatch):
    monkeypatch.setattr("mstfilter.app.report.run_report.read_numbers", lambda run: pytest.fail("it is drawn"))
    for key, value in spoiled.items():
        path = hostile.copy(examples / "run", tmp_path / "trial" / "it")
        data = json.loads((path / file).read_text())
        (path / file).write_text(json.dumps({**data, key: value}))
        with pytest.raises(InputError, match=r"run\.json|pauses/00[01]"):
            write_report(path)


def test_an_image_is_not_decoded_if_its_header_announces_too_much(tmp_path):
    (tmp_path / "a.png").write_bytes(hostile.png_header(30_000, 30_000))
    with limits(megabytes=200), pytest.raises(InputError, match="more than 33554432 pixels"):
        read_rgb(tmp_path / "a.png")


@pytest.mark.parametrize(("shape", "gigabytes"), [((10**6, 10**6), 0), ((2**23,), 1 / 64)])
def test_an_array_is_not_unpacked_if_it_is_too_large(tmp_path, monkeypatch, shape, gigabytes):
    """By its header, or by what it contains."""
    monkeypatch.setattr("mstfilter.base.reading.MAX_FILE", 2**20)
    (tmp_path / "a.npz").write_bytes(hostile.bomb(shape, gigabytes=gigabytes))
    with limits(megabytes=200), pytest.raises(InputError, match="does not fit|at most 1048576 are read"):
        read_arrays(tmp_path / "a.npz", "volumes")


def test_large_text_is_not_read_when_a_folder_is_opened(tmp_path):
    for name in ("camera.json", "SHA256SUMS"):
        with (tmp_path / name).open("wb") as file:
            file.truncate(2**28)
    with limits(megabytes=200):
        with pytest.raises(InputError, match="at most 33554432 are read"):
            open_recording(tmp_path)
        assert damaged_files(tmp_path) == ["SHA256SUMS has changed"]


@pytest.mark.parametrize("name", ["pipe", "/dev/zero", "loop", "folder"])
def test_only_regular_files_are_read(tmp_path, name):
    path = tmp_path / "a.png"
    if name == "pipe":
        os.mkfifo(path)
    elif name == "folder":
        path.mkdir()
    else:
        path.symlink_to(path if name == "loop" else name)
    with limits(seconds=5), pytest.raises(InputError, match=r"a\.png"):
        read_rgb(path)


def test_names_in_a_list_do_not_leave_the_folder(examples, tmp_path):
    for name in ("../../secret.png", "/etc/passwd"):
        path = hostile.copy(examples / "tum", tmp_path / "trial" / "it")
        (path / "rgb.txt").write_text(f"1305031102.175 {name}\n")
        with pytest.raises(InputError, match="is outside the folder"):
            hostile.KINDS["tum"].read(path)


def test_weights_that_are_not_finite_are_refused(tmp_path):
    write_model(tmp_path / "model", {"architecture": "test"}, {"a": np.array([1.0, np.nan], np.float32)})
    with pytest.raises(InputError, match="tensor 'a' has a value that is not finite"):
        open_model(str(tmp_path / "model"))


def test_control_characters_do_not_reach_the_terminal(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["report", str(tmp_path / "\x1b[2Jred\u202e")])
    error = capsys.readouterr().err
    assert "\\x1b[2Jred\\u202e" in error and "\x1b" not in error


def test_out_of_memory_and_disk_in_plain_words(monkeypatch, capsys):
    full = OSError(errno.ENOSPC, "No space left on device", "x")
    for error, words in ((MemoryError("x"), "out of memory"), (full, "no space left")):
        monkeypatch.setattr(
            "mstfilter.runs.study.load_study", lambda *_, error=error, **__: (_ for _ in ()).throw(error)
        )
        with pytest.raises(SystemExit) as end:
            main(["study", "x.toml"])
        assert end.value.code == 1
        assert capsys.readouterr().err.startswith(f"error: {words}")


# Code in the working folder


def _plant(folder: Path) -> Path:
    """Modules that leave a mark when they are imported; returns the mark."""
    mark = folder.parent / "pwned"
    for name in ("multiprocessing", "joblib", "loky", "numpy", "pickle", "mstfilter"):
        (folder / f"{name}.py").write_text(f"open({str(mark)!r}, 'w').close()\nraise SystemExit(7)\n")
    return mark


def _one(arm: str, seed: int) -> float:
    return float(seed)


PROGRAM = """
import sys
from pathlib import Path
def main():
    from tests.test_strangers import start
    start(sys.argv[1])
if __name__ == "__main__":
    main()
"""


def start(what: str) -> None:
    """Start the processes of a kind; called in a process whose working folder is that of a stranger."""
    from mstfilter.smc import bootstrap, linear_gaussian

    if what == "run_many":
        model = linear_gaussian(*[[[1.0]]] * 4, m0=[0.0], P0=[[1.0]])
        run_many({"a": bootstrap(model, n=10)}, [[0.0], [1.0]], seeds=[0, 1], workers=2)
    else:
        from mstfilter.runs.study.worker import Worker

        worker = Worker(Path(sys.argv[0]).with_suffix(".log"))
        outcome = worker.perform({"code": "none", "tries": 1, "timeout_s": 0, "cwd": os.getcwd()})
        worker.close()
        assert outcome.error.startswith("this process has other code"), outcome


@pytest.mark.parametrize("what", ["run_many", "study"])
def test_modules_in_the_working_folder_are_not_imported(tmp_path, what):
    folder = tmp_path / "received"
    folder.mkdir()
    mark = _plant(folder)
    (tmp_path / "program.py").write_text(PROGRAM)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"} | {"PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, str(tmp_path / "program.py"), what]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)
    assert not mark.exists()
    assert done.returncode == 0, done.stderr


# Caches


def test_a_cache_is_private(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o700)
    check_private(folder)
    for mode in (0o770, 0o707):
        folder.chmod(mode)
        with pytest.raises(InputError, match=f"its mode is {mode:o}"):
            check_private(folder)
    folder.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(InputError, match="belongs to another user"):
        check_private(folder)


def test_a_cache_of_recordings_is_private_with_any_umask(tmp_path):
    mask = os.umask(0o002)
    try:
        paths = {
            cached_recording(
                "demo", 0, tmp_path / "cache" / "recordings", n_actions=1, n_candidates=4, width=160, height=120
            )
            for _ in range(2)
        }
    finally:
        os.umask(mask)
    assert len(paths) == 1
    for folder in ("cache", "cache/recordings"):
        assert (tmp_path / folder).stat().st_mode & 0o077 == 0


def test_a_cached_recording_that_was_edited_is_simulated_again(tmp_path):
    small = {"width": 80, "height": 60, "n_actions": 1, "frames_per_clip": 3, "fps": 1.0, "supersample": False}
    small["n_candidates"] = 4
    folder = cached_recording("s1", 0, tmp_path, **small)
    depth = folder / "depth" / "000000.png"
    before, stamp = depth.read_bytes(), depth.stat().st_mtime_ns
    edited = bytearray(before)
    edited[len(before) // 2] ^= 1
    depth.write_bytes(bytes(edited))
    os.utime(depth, ns=(stamp, stamp))
    with pytest.warns(InputWarning, match=r"depth/000000\.png has changed"):
        assert cached_recording("s1", 0, tmp_path, **small) == folder
    assert depth.read_bytes() == before
