"""The commands check and new."""

from __future__ import annotations

import inspect
import re
import runpy
import shlex
import subprocess
import sys

import pytest

from mstfilter.base.resources import starter_kinds, write_starter
from mstfilter.mst.testing import check_of
from mstfilter.runs.presets import REGISTRY
from tests.app.test_cli import call
from tests.conftest import REPOSITORY
from tests.scene.test_recording import write

FAULTS_FILE = REPOSITORY / "tests" / "mst" / "testing" / "faults.py"


STARTERS = [(kind, "scenes") for kind in starter_kinds("scenes")]
STARTERS += [(kind, "numbers") for kind in starter_kinds("numbers") if kind not in ("resampler", "trigger", "size")]
#: Their printed commands run in the fast tests: a reader of files, a stage, the proposal, an update, and numbers.
FAST = [
    (kind, "scenes") for kind in ("format", "pauses", "completer", "proposal", "evidence", "trigger", "equivalence")
]
FAST += [("transition", "numbers"), ("update", "numbers"), ("codec", "numbers"), ("similarity", "numbers")]
SCENES_WITHOUT_EXACT = [(kind, "scenes") for kind in ("transition", "proposal", "update")]


@pytest.mark.parametrize(
    ("kind", "target"), [one for one in STARTERS if one not in [*FAST, ("architecture", "scenes")]]
)
def test_every_starting_file_has_a_component_that_works(kind, target, tmp_path):
    """Its results are valid; tests/mst/completion/test_own_networks.py has that of a network."""
    name = re.search(r"mine\.py:(My\w+)", " ".join(write_starter(kind, tmp_path / "mine.py", target)))[1]
    component = REGISTRY.build(kind, f"{tmp_path / 'mine.py'}:{name}", allow_files=True)
    check = check_of(component)
    methods = {"make": staticmethod(lambda: component)}
    if check.example is not None:
        methods["example"] = staticmethod(check.example)
    type("Contract", (check.contract,), methods)().test_result_is_valid()


@pytest.mark.parametrize(
    ("kind", "target"),
    [pytest.param(*one, marks=[pytest.mark.nightly] * (one not in FAST)) for one in STARTERS],
)
def test_the_printed_commands_run_as_printed(kind, target, tmp_path, monkeypatch, capsys):
    """On a recording of three frames in place of that of the demo."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "demo" / "recording", n=3, statics=(0, 2))
    code, out, err = call("new", kind, "mine.py", "--for", target, capsys=capsys)
    assert code == 0, err
    commands = [shlex.split(line)[1:] for line in out.splitlines() if line.startswith("next ")]
    assert {command[0] for command in commands} <= {"mstfilter", "python"}
    assert any(command[1] == "run" for command in commands) == (target == "scenes")
    for program, *arguments in commands:
        if program == "python":
            runpy.run_path(arguments[0], run_name="__main__")
            assert "nan" not in capsys.readouterr().out
        else:
            fast = ["--no-report"] if arguments[0] == "run" else []
            code, out, err = call(*arguments, *fast, capsys=capsys)
            assert code == 0, f"{arguments}\n{out}\n{err}"
            assert "exact draws" not in out or (kind, target) in SCENES_WITHOUT_EXACT
            assert "all properties that apply hold" in out or arguments[0] != "check"
            assert " of 0 " not in out, "hypotheses without objects"


def test_every_kind_has_a_starting_file():
    assert [k for k in REGISTRY.kinds if inspect.isabstract(REGISTRY.interface(k)) and k not in starter_kinds()] == []


def test_a_starting_file_is_for_scenes_if_there_is_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _, out, _ = call("new", "transition", "a.py", capsys=capsys)
    assert re.search("next +mstfilter check .*\nnext +mstfilter demo .*\nnext +mstfilter run demo/recording", out)
    assert "run demo/recording transition=./a.py:MyTransition --out runs/mine --replace" in out
    _, out, _ = call("new", "transition", "b.py", "--for", "numbers", capsys=capsys)
    assert "python b.py" in out
    _, out, _ = call("new", "codec", "sub/c.py", capsys=capsys)
    assert "next        mstfilter check ./sub/c.py:MyCodec" in out
    for arguments, message in (
        (("codec", "d.py", "--for", "scenes"), "no starting file of 'codec' for scenes"),
        (("boundary", "d.py", "--for", "numbers"), "no starting file of 'boundary' for numbers"),
        (("boundary", "d.py", "--for", "images"), "the target is 'images', expected scenes or numbers"),
    ):
        code, _, err = call("new", *arguments, capsys=capsys)
        assert code == 2
        assert message in err


def test_nothing_is_overwritten(tmp_path, capsys):
    (tmp_path / "mine.py").write_text("x")
    code, _, err = call("new", "resampler", tmp_path / "mine.py", capsys=capsys)
    assert code == 2
    assert "mine.py exists already" in err
    assert (tmp_path / "mine.py").read_text() == "x"
    for kind, name, message in (
        ("spoon", "mine.py", "there are: architecture, boundary"),
        ("transitoin", "mine.py", "did you mean transition?"),
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


def test_check_of_registered_components_with_fields(capsys, fewer_calls):
    given = ("check", "resampler.tempered", "power=0.25", "scheme=ssp", "--budget", "3600")
    code, out, _ = call(*given, capsys=capsys)
    assert code == 0
    assert "Tempered: all properties that apply hold" in out
    for arguments, message in (
        (("resampler.systematik",), "did you mean"),
        (("systematic",), "KIND.NAME"),
        (("./nowhere.py:X",), "file does not exist"),
        (("resampler.tempered", "power=2"), "of at most 1"),
        (("format.tum",), "no component"),
    ):
        code, _, err = call("check", *arguments, capsys=capsys)
        assert code == 2
        assert message in err


def test_contracts_of_numbers_need_numpy_and_scipy_only():
    program = (
        "import sys; from mstfilter.smc import EssBelow; from mstfilter.smc.testing import *; "
        "print([r.failure or r.skipped for r in check_properties(EssBelow(), TriggerContract)]); "
        "print(sorted({'pytest', 'cv2', 'torch', 'networkx', 'pydantic', 'mstfilter.scene'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, timeout=600
    )
    assert done.stdout.splitlines() == [str([None] * 6), "[]"], done.stderr


SLOW = """
import time
import numpy as np
from mstfilter.smc import Multinomial, WeightResampler

class Slow(WeightResampler):
    def select(self, generator, logarithms, number):
        time.sleep(2e-3 * number)
        return Multinomial().select(generator, logarithms, number)
"""


def test_what_is_not_tested_in_time_is_no_pass(tmp_path, capsys):
    (tmp_path / "slow.py").write_text(SLOW)
    code, out, _ = call("check", f"{tmp_path / 'slow.py'}:Slow", "--budget", "5", capsys=capsys)
    assert code == 0
    assert out.startswith("input    numbers (n,)")
    assert re.search(r"untested A particle gets .*\n +out of time after \d+ of 22 cases", out)
    assert re.search(r"Slow: no tested property is broken, \d are not tested in 5 s \(--budget\)", out)
