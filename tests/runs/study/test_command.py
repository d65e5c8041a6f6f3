"""The command `mstfilter study`: what it prints, how it ends, how lightly it starts."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys

import pytest

from mstfilter.app.cli.studying import _print_failures
from mstfilter.formats import open_recording
from mstfilter.runs import filter_recording
from mstfilter.runs.presets import load_config
from mstfilter.runs.study import JobOutcome
from tests.app.test_cli import HEAVY, call, python
from tests.runs.study.scenes import in_process, slide
from tests.runs.study.test_failures import BROKEN, FAST, LIGHT, hanging_study, wait_for


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
    with in_process():
        code, out, error = call("study", config, "--smoke", "update.n_views=1,2", "--workers", 1, capsys=capsys)
    assert code == 0, error
    assert "study       studies/mine-smoke" in out
    assert "2 done, 0 of them earlier" in out
    assert "mst transition=identity update.n_views=2" in out and "time per step (s)" in out
    assert "method minus mst transition=identity update.n_views=1), paired by scene" in " ".join(out.split())
    page = tmp_path / "studies" / "mine-smoke" / "report.html"
    assert "report      studies/mine-smoke/report.html" in out and "2 of 2 runs" in page.read_text()
    page.unlink()
    code, out, _ = call("study", config, "--smoke", "update.n_views=1,2", "--no-report", capsys=capsys)
    assert "2 done, 2 of them earlier" in out and not page.exists()
    code, _, error = call("study", config, "--smoke", "colour=1", capsys=capsys)
    assert code == 2 and error.startswith("error: arm 'mst transition=identity': a filter has no field 'colour'")


def test_without_a_terminal_each_finished_run_is_a_line(config, tmp_path, monkeypatch):
    """Also if a variable asks for colours. The run that fails is named with its error."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    own = f'[[arms]]\nset = ["transition={BROKEN}:Breaks", "transition.how=raise", "{LIGHT}"]\nname = "broken"\n'
    config.write_text(
        'seeds = "0-1"\nscenes = [{recordings = "slide"}]\n'
        f'[[arms]]\nname = "good"\npreset = "{FAST}"\nset = "{LIGHT}"\n{own}'
    )
    command = [sys.executable, "-m", "mstfilter", "study", str(config), "--workers", "1", "--no-report"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 1
    lines = [line.split("  ", 1)[1] for line in done.stderr.splitlines() if re.match(r"\d\d:\d\d:\d\d  ", line)]
    assert len(lines) == 4
    for k, line in enumerate(lines, 1):
        assert re.match(rf"{k}/4 runs(, \d failed)?, \d+ (s|min) left: \S+ on slide, seed \d", line), line
    assert sum("failed: RuntimeError: the component broke" in line for line in lines) == 2, lines
    assert lines[-1].startswith("4/4 runs, 2 failed, 0 s left")
    assert all(c.isprintable() or c == "\n" for c in done.stderr)
    assert "slide: pause 1 filtered" in (tmp_path / "studies" / "mine" / "logs" / "worker-0.log").read_text()


@pytest.mark.nightly
def test_messages_go_to_the_log(config, tmp_path, caplog, capsys):
    """Nothing is printed unless a handler is set; `--verbose` sets one."""
    recording = open_recording(tmp_path / "slide")
    filter_recording(recording, load_config(FAST), tmp_path / "quiet")
    assert capsys.readouterr() == ("", "")
    with caplog.at_level("INFO", "mstfilter"):
        filter_recording(recording, load_config(FAST), tmp_path / "logged")
    assert [r.getMessage().split(" filtered")[0] for r in caplog.records] == ["slide: pause 0", "slide: pause 1"]
    run = "run", tmp_path / "slide", "--preset", FAST, "--out"
    code, out, error = call(*run, tmp_path / "a", "--verbose", capsys=capsys)
    assert code == 0 and "slide: pause 1 filtered in" in error and "filtered in" not in out
    code, out, error = call(*run, tmp_path / "b", capsys=capsys)
    assert code == 0 and "filtered in" not in out + error


def test_many_failures_are_a_few_lines(capsys):
    """Equal errors are one line with one set of hints; of different errors, the first ten are printed."""
    hints = tuple(map(str, range(1000)))
    failed = [(f"run {k}", JobOutcome("failed", "it broke", hints)) for k in range(1000)]
    failed += [(f"other {k}", JobOutcome("failed", f"error {k}")) for k in range(1000)]
    _print_failures(failed)
    out, err = capsys.readouterr()
    assert out.splitlines()[:2] == ["failed      run 0 and 999 more: it broke", "failed      other 0: error 0"]
    assert out.splitlines()[10:] == ["failed      991 more runs, with other errors"]
    assert err.splitlines() == [f"hint: {k}" for k in range(10)]


def test_an_unknown_component_is_answered_before_heavy_imports(tmp_path):
    (tmp_path / "s.toml").write_text(
        'scenes = [{family = "demo", seeds = 0}]\narms = [{set = "resampler=sistematic"}]\n'
    )
    code = (
        "import sys; from mstfilter.app.cli import main\n"
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
