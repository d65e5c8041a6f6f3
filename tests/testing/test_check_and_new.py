"""The commands check and new."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from mstfilter.testing import starter_kinds, write_starter
from tests.conftest import REPOSITORY
from tests.test_cli import call

FAULTS_FILE = REPOSITORY / "tests" / "testing" / "faults.py"


@pytest.mark.parametrize("kind", starter_kinds())
def test_a_starting_file_passes_its_check(kind, tmp_path, capsys):
    mine = tmp_path / "mine.py"
    code, out, err = call("new", kind, mine, capsys=capsys)
    assert code == 0, err
    assert f"check {mine}:My{kind.capitalize()}" in out
    assert f"mstfilter check ./mine.py:My{kind.capitalize()}" in mine.read_text()
    code, out, err = call("check", f"{mine}:My{kind.capitalize()}", capsys=capsys)
    assert code == 0, out + err
    assert "all properties that apply hold" in out
    assert "exact draws" not in out, "the starting file gives those that its law is tested with"


def test_starting_files_pass_their_tests(tmp_path):
    """All in one run of pytest, since pytest starts slowly."""
    for kind in starter_kinds():
        write_starter(kind, tmp_path / f"my_{kind}.py")
    command = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed" in done.stdout
    assert "exact draws" not in done.stdout


def test_the_starting_resampler_has_three_lines_of_logic(tmp_path, capsys):
    call("new", "resampler", tmp_path / "mine.py", capsys=capsys)
    body = (tmp_path / "mine.py").read_text().split("def select(")[1].split('"""')[2]
    logic = [line for line in body.splitlines() if line.strip() and not line.strip().startswith("#")]
    assert len(logic) == 4  # three and the return


def test_nothing_is_overwritten(tmp_path, capsys):
    (tmp_path / "test_mine.py").write_text("x")
    code, _, err = call("new", "resampler", tmp_path / "mine.py", capsys=capsys)
    assert code == 2
    assert "test_mine.py exists already" in err
    assert [p.name for p in tmp_path.iterdir()] == ["test_mine.py"]
    for kind, name, message in (
        ("spoon", "mine.py", "there are: codec"),
        ("update", "my-own.py", "cannot be imported"),
        ("update", "mine.txt", "cannot be imported"),
    ):
        code, _, err = call("new", kind, tmp_path / name, capsys=capsys)
        assert code == 2
        assert message in err


def test_check_names_what_is_broken(capsys):
    code, out, _ = call("check", f"{FAULTS_FILE}:BiasedResidual", capsys=capsys)
    assert code == 1
    assert "broken   A particle gets n W_i copies on average" in out
    assert "copies are biased" in out
    assert "1e-06" in out
    assert re.search(r"BiasedResidual: (1 property is|\d+ properties are) broken", out)


def test_check_of_registered_components_with_fields(capsys):
    code, out, _ = call("check", "resampler.tempered", "power=0.25", "scheme=ssp", capsys=capsys)
    assert code == 0
    assert "Tempered: all properties that apply hold" in out
    for arguments, message in (
        (("resampler.systematik",), "did you mean"),
        (("systematic",), "KIND.NAME"),
        (("./nowhere.py:X",), "file does not exist"),
        (("resampler.tempered", "power=2"), "of at most 1"),
        (("boundary.colour_depth",), "no component"),
    ):
        code, _, err = call("check", *arguments, capsys=capsys)
        assert code == 2
        assert message in err


def test_a_missing_pytest_is_one_line():
    program = "import sys; sys.modules['pytest'] = None; from mstfilter.cli import main; main()"
    command = [sys.executable, "-c", program, "check", "resampler.systematic"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=600)
    assert done.returncode == 2
    assert "check needs pytest, which is not installed" in done.stderr
    assert "mstfilter[check]" in done.stderr
    assert "Traceback" not in done.stderr
