"""The command `mstfilter study`: what it prints, how it ends, how lightly it starts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.study.scenes import slide
from tests.test_cli import HEAVY, call, python


@pytest.fixture
def config(tmp_path, monkeypatch):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    slide(tmp_path / "slide", pauses=2)
    path = tmp_path / "mine.toml"
    path.write_text(
        'seeds = "0-5"\nscenes = [{recordings = "slide"}]\narms = [{preset = "mst", set = "transition=identity"}]\n'
        "[smoke]\nseeds = 0\n"
    )
    return path


def test_it_prints_where_and_what(config, tmp_path, capsys):
    code, out, error = call("study", config, "--smoke", "update.eta=1,2", capsys=capsys)
    assert code == 0, error
    assert "study       studies/mine-smoke" in out
    assert "2 done, 0 of them before" in out
    assert "mst transition=identity update.eta=2" in out and "quality, t >= 1" in out
    code, out, _ = call("study", config, "--smoke", "update.eta=1,2", capsys=capsys)
    assert "2 done, 2 of them before" in out
    code, _, error = call("study", config, "--smoke", "colour=1", capsys=capsys)
    assert code == 2 and error.startswith("error: arm 'mst transition=identity': a filter has no field 'colour'")


def test_an_unknown_component_is_answered_before_heavy_imports(tmp_path):
    (tmp_path / "s.toml").write_text(
        'scenes = [{family = "demo", seeds = 0}]\narms = [{set = "resampler=sistematic"}]\n'
    )
    code = (
        "import sys; from mstfilter.cli import main\n"
        "try: main(['study', sys.argv[1]])\n"
        f"except SystemExit as end: print(end.code, [m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = python(code, str(tmp_path / "s.toml"))
    assert "did you mean systematic" in done.stderr
    assert done.stdout.strip() == "2 []"


def heed_interrupts():
    """Shells start background jobs deaf to Ctrl-C, and tests that such a job runs would inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_ctrl_c_ends_workers_and_loses_nothing(config, tmp_path):
    config.write_text(config.read_text().replace('"0-5"', '"0-59"'))  # more than end before the signal comes
    command = [sys.executable, "-m", "mstfilter", "study", str(config), "--workers", "1"]
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed_interrupts,
    )
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("studies/mine/runs/*/result.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted: the same command goes on from here" in error
    assert "Traceback" not in error
    assert not list(tmp_path.glob("studies/mine/runs/.*"))
    assert 1 <= len(list(tmp_path.glob("studies/mine/runs/*/result.json"))) < 60
