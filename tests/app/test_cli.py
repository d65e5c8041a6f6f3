"""The command line: exit codes, messages, a light start, and the default path without open3d and torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mstfilter.app.cli import main
from mstfilter.formats import open_recording
from mstfilter.runs import RunFolder, compared_configs
from mstfilter.runs.presets import build_filter, load_config
from tests.conftest import REPOSITORY
from tests.scene.test_recording import write

HEAVY = ("torch", "open3d", "cv2", "scipy", "higra", "mujoco", "matplotlib")


def call(*arguments, capsys):
    """Exit code, standard output and standard error of a command."""
    code = 0
    try:
        main([str(a) for a in arguments])
    except SystemExit as end:
        code = end.code or 0
    out = capsys.readouterr()
    return code, out.out, out.err


@pytest.fixture
def recording(tmp_path):
    return write(tmp_path / "slide")


@pytest.fixture
def two_pauses(tmp_path):
    return write(tmp_path / "slide", n=3, statics=(0, 2))


def test_run_and_report(two_pauses, tmp_path, capsys):
    run = tmp_path / "run"
    few = ("n=3", "n_proposed=2")
    code, out, err = call("run", two_pauses, *few, "--out", run, "--seed", 4, "--no-report", capsys=capsys)
    assert code == 0, err
    assert "pause 1     " in out and out.count("            3 hypotheses, ESS ") == 2
    table = RunFolder.open(run).objects(1)
    assert f"{sum(one.visible for one in table)} objects in view." in out
    assert (run / "objects.csv").read_text().count("\n1,") == len(table)
    assert RunFolder.open(run).description["seed"] == 4
    assert not (run / "report.html").exists()
    code, out, err = call("report", run, "--out", tmp_path / "r.html", capsys=capsys)
    assert code == 0, err
    assert "<html" in (tmp_path / "r.html").read_text()


PLACES = {"a file in the way": "is a file", "a long name": "too long"}
WRITERS = {
    "run": ("none", "--out"),
    "demo": ("--out",),
    "simulate": ("demo",),
    "convert": ("none",),
    "study": ("none.toml", "--out"),
    "train": ("border", "--out"),
    "report": ("none", "--out"),
    "objects": ("none", "--out"),
    "view": ("none", "--out"),
    "quality": ("none", "none", "--csv"),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("command", WRITERS)
def test_an_output_that_cannot_be_written_is_an_error_before_any_work(tmp_path, capsys, command, place):
    """Inputs do not exist (but the file of a study): the error about the output comes first."""
    (tmp_path / "file").write_text("kept")
    out = {"a file in the way": tmp_path / "file" / "x", "a long name": tmp_path / ("x" * 300)}
    words = [tmp_path / "study.toml" if word == "none.toml" else word for word in WRITERS[command]]
    (tmp_path / "study.toml").write_text((REPOSITORY / "experiments/fusion/study.toml").read_text())
    code, printed, err = call(command.partition(",")[0], *words, out[place], capsys=capsys)
    assert (code, printed) == (2, "") and err.startswith("error: cannot write") and PLACES[place] in err, err
    assert "hint: choose another place" in err
    assert {path.name for path in tmp_path.iterdir()} == {"file", "study.toml"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "nowhere"), "does not exist"),
        (("run", "nowhere", "resampler=sistematic"), "there is no resampler 'sistematic'"),
        (("run", "nowhere", "--preset", "mts"), "did you mean mst?"),
        (("run", "nowhere", "resamplr=systematic"), "did you mean resampler?"),
        (("simulate", "demo", "out", "n_object_max=3"), "did you mean n_objects_max?"),
        (("simulate", "demo", "out", "n_actions=-1"), "n_actions is -1"),
        (("report", "nowhere"), "not a run folder"),
        (("list", "spoons"), "there is no kind"),
    ],
)
def test_wrong_arguments(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, _, err = call(*arguments, capsys=capsys)
    assert code == 2
    assert err.startswith("error: ")
    assert message in err
    assert list(tmp_path.iterdir()) == []


def test_a_file_larger_than_the_shell_allows_is_one_clear_error(two_pauses, tmp_path, capsys):
    """The soft limit of ulimit -f; no folder is left, and the run can be repeated."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, limits[1]))
    try:
        code, _, err = call("run", two_pauses, "--out", tmp_path / "run", "--preset", "floor_one_blob", capsys=capsys)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == 1 and "error: a file exceeds the largest size" in err, err
    assert "ulimit -f" in err and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "command", [("run", "none", "--out"), ("simulate", "demo"), ("demo", "--out"), ("convert", "none")]
)
def test_a_folder_with_files_is_left_alone(tmp_path, capsys, command):
    (tmp_path / "thesis.tex").write_text("x")
    code, _, err = call(*command, tmp_path, capsys=capsys)
    assert code == 2 and "it exists and is not an empty folder" in err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert "expected the name of a file" in call("report", "none", "--out", tmp_path, capsys=capsys)[2]


def test_simulate_takes_changes_to_the_family(tmp_path, capsys):
    small = (
        "n_objects_min=2",
        "n_objects_max=2",
        "n_actions=1",
        "frames_per_clip=5",
        "width=80",
        "height=60",
        "n_candidates=4",
    )
    code, _, err = call("simulate", "demo", tmp_path / "out", *small, capsys=capsys)
    assert code == 0, err
    recording = open_recording(tmp_path / "out")
    assert (len(recording), recording.pauses) == (5, (0, 4))
    assert set(np.unique(recording.truth(0))) == {0, 1, 2}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("run", "repeat the command to resume\n"),
        ("run --replace", "resume, without --replace"),
        ("run --live=5", "cannot be resumed"),
        ("demo", "anew"),
    ],
)
def test_an_interrupted_command_says_what_it_keeps(command, message, tmp_path, monkeypatch, capsys):
    def interrupt(*arguments, **named):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mstfilter.lab.simulation.simulate_recording", interrupt)
    monkeypatch.setattr("mstfilter.lab.simulation.simulate_recording", interrupt)
    monkeypatch.setattr("mstfilter.formats.open_recording", interrupt)
    monkeypatch.setattr("mstfilter.formats.open_format", interrupt)
    name, *options = command.split()
    code, _, err = call(name, *(["x", *options] if name == "run" else []), capsys=capsys)
    assert code == 130
    assert message in err
    assert list(tmp_path.iterdir()) == []


def test_runs_to_compare_are_kept_beside_the_run(recording, tmp_path, capsys):
    arguments = ("run", recording, "n=1", "n_proposed=1", "--compare", "--no-report", "--out", tmp_path / "run")
    code, _, _ = call(*arguments, capsys=capsys)
    compared = RunFolder.open(tmp_path / "run").compared()
    assert code == 0 and list(compared) == ["single frame", "without past"]
    samplers = {name: run.description["config"]["proposal"]["sampler"] for name, run in compared.items()}
    assert samplers["single frame"]["component"] == "optimal" != samplers["without past"]["component"]
    completers = [run.description["config"]["proposal"]["completer"]["component"] for run in compared.values()]
    assert completers == ["network", "network"]  # that of the update of `mst`, whose samples are surfaces
    assert all(run.description["config"]["transition"]["component"] == "identity" for run in compared.values())


def test_compared_filters_of_a_proposal_without_completer_and_sampler():
    """A component from a file has neither field; `true_masks` has a completer."""
    path = REPOSITORY / "docs/examples/scenes/proposal.py"
    own = compared_configs(load_config("mst", [f"proposal={path}:MyProposal"]))
    assert list(own) == ["without past"] and own["without past"]["proposal"].keys() == {"component"}
    masks = compared_configs(load_config("mst", ["proposal=true_masks"]))
    assert masks["without past"]["proposal"]["completer"] == load_config("mst")["update"]["completer"]
    for config in (*own.values(), *masks.values()):
        build_filter(config, allow_files=True)


def python(code, *arguments):
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, timeout=600
    )


@pytest.mark.parametrize("arguments", [["--help"], ["florp"], ["run", "x", "resampler=none-such"], ["run", "--help"]])
def test_a_light_start(arguments):
    """Help and unknown names answer before any heavy library is imported."""
    done = python(
        "import sys\n"
        "from mstfilter.app.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit: pass\n"
        f"print('heavy:', sorted(set({HEAVY!r}) & set(sys.modules)))",
        *arguments,
    )
    assert "heavy: []" in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize(
    "preset, blocked",
    [
        pytest.param("mst", ["open3d"], marks=pytest.mark.nightly),
        ("mst_rules", ["open3d", "torch"]),
        ("mst", ["torch"]),
    ],
)
def test_what_the_presets_need(preset, blocked, two_pauses, tmp_path):
    """A run and its report with libraries made unimportable. Only the network of `mst` needs torch, and says so."""
    done = python(
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] in {blocked}:\n"
        "            raise ImportError(name + ' is blocked')\n"
        "sys.meta_path.insert(0, Blocked())\n"
        "from mstfilter.app.cli import main\n"
        "main(sys.argv[1:])",
        *("run", two_pauses, "n=1", "n_proposed=1", "--preset", preset, "--out", tmp_path / "run"),
        *(["--no-report"] if preset == "mst" else []),
    )
    if preset == "mst" and "torch" in blocked:
        assert (
            done.returncode == 2
            and "needs torch, which cannot be imported" in done.stderr
            and "mst_rules" in done.stderr
        )
        assert not (tmp_path / "run").exists()
        return
    assert done.returncode == 0, done.stderr
    assert preset == "mst" or "<html" in (tmp_path / "run" / "report.html").read_text()


USER_FILE = """
from dataclasses import dataclass
from mstfilter.mst.completion import Completer
from mstfilter.smc import Transition

@dataclass(frozen=True)
class Fails(Transition):
    def predict(self, rng, population, observation):
        return population.particles[99]

@dataclass(frozen=True)
class Nothing(Transition):
    def predict(self, rng, population, observation):
        pass

@dataclass(frozen=True)
class Needs(Transition):
    scale: float

    def predict(self, rng, population, observation):
        return population

@dataclass(frozen=True)
class Void(Completer):
    def fill(self, rng, seen):
        pass
"""


def test_an_error_in_a_file_of_the_user_is_located(recording, tmp_path, monkeypatch, capsys):
    """The message has the file, the line and its text, or at least names the component."""
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(USER_FILE, encoding="utf-8")
    line = USER_FILE.splitlines().index("        return population.particles[99]") + 1
    cases = {
        "transition=./mine.py:Fails": (f"(mine.py, line {line}: return population.particles[99])", "step 1, transi"),
        "transition=./mine.py:Nothing": ("step 1, transition: Nothing returned NoneType, expected a Popul", "return"),
        "proposal.completer=./mine.py:Void": ("step 0, proposal: Void.fill (mine.py, line", "returns None"),
        "proposal.boundary=./mine.py:Fails": ("Fails of ./mine.py is no boundary", "import BoundaryModel"),
        "transition=./mine.py:Needs": ("transition: Needs needs scale, without a default", "transition.scale=VALUE"),
        "proposal.boundary=./mine.py:Flot": ("has no class 'Flot'", "it has: Fails, Nothing"),
    }
    for k, (override, texts) in enumerate(cases.items()):
        code, out, err = call("run", recording, override, "n_proposed=1", "--out", f"run{k}", capsys=capsys)
        assert code in (1, 2), override
        assert "\nerror: " in f"\n{err}"
        assert all(text in err for text in texts), err
        assert "Traceback" not in out + err
        assert "in the program" not in err
    code, _, err = call("check", "./mine.py:Needs", capsys=capsys)
    assert code == 2
    assert "give it a value, scale=VALUE" in err
    for text in ("x = numpy.pie", "x = = 3"):
        Path("mine.py").write_text(f"import numpy\n{text}\n", encoding="utf-8")
        code, _, err = call("run", recording, "transition=./mine.py:A", capsys=capsys)
        assert code == 2 and f"mine.py, line 2: {text}" in err


def test_an_earlier_run_is_replaced_if_asked(recording, tmp_path, capsys):
    arguments = ("run", recording, "--out", tmp_path / "run", "--no-report", "--preset", "floor_one_blob")
    assert call(*arguments, capsys=capsys)[0] == 0
    code, _, err = call(*arguments, "n=2", capsys=capsys)
    assert code == 2
    assert "--replace" in err
    assert call(*arguments, "n=2", "--replace", capsys=capsys)[0] == 0
    assert RunFolder.open(tmp_path / "run").description["config"]["n"] == 2
