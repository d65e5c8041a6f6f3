"""The command `mstfilter study`: what it prints, how it ends, how lightly it starts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from tests.study.scenes import slide
from tests.study.test_failures import hanging_study, wait_for
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
    code, out, error = call("study", config, "--smoke", "update.n_views=1,2", "--workers", 1, capsys=capsys)
    assert code == 0, error
    assert "study       studies/mine-smoke" in out
    assert "2 done, 0 of them earlier" in out
    assert "mst transition=identity update.n_views=2" in out and "metric, t >= 1" in out
    code, out, _ = call("study", config, "--smoke", "update.n_views=1,2", capsys=capsys)
    assert "2 done, 2 of them earlier" in out
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


def default_interrupts():
    """Background jobs of a shell ignore Ctrl-C, and their child processes would too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_ctrl_c_ends_workers_and_keeps_results(config, tmp_path):
    marker = tmp_path / "marker"
    hanging_study(config, tmp_path / "slide", marker)
    command = [sys.executable, "-m", "mstfilter", "study", str(config), "--workers", "1"]
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=default_interrupts,
    )
    wait_for(marker, process)
    os.kill(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=600)
    assert process.returncode == 130
    assert "interrupted: repeat the command to resume" in error
    assert "Traceback" not in error
    assert not list(tmp_path.glob("studies/mine/runs/.*"))
    assert len(list(tmp_path.glob("studies/mine/runs/*/result.json"))) == 1
