"""The package without any library but numpy and scipy: the filter works, the command line says what is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import REPOSITORY

BLOCK = """
import sys

class Blocked:
    allowed = sys.stdlib_module_names | {"numpy", "scipy", "mstfilter"}

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in self.allowed and not name.startswith("_"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocked())
"""
COMMAND = "from mstfilter.app.cli import main; main(sys.argv[1:])"


def light(program, *arguments):
    """A fresh interpreter in which all imports but those of numpy and scipy fail."""
    command = [sys.executable, "-P", "-c", f"{BLOCK}sys.path.insert(0, {str(REPOSITORY)!r})\n{program}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


def test_filters_and_resampling():
    done = light(
        "import numpy as np\n"
        "from mstfilter.smc import *\n"
        "from mstfilter.runs.presets import REGISTRY\n"
        "model = linear_gaussian(np.eye(1), np.eye(1), np.eye(1), np.eye(1), np.zeros(1), np.eye(1))\n"
        "for name in REGISTRY.known('resampler'):\n"
        "    scheme = REGISTRY.find_class('resampler', name)()\n"
        "    state, infos = bootstrap(model, n=20, resampler=scheme).run(np.ones((3, 1)), seed=0)\n"
        "    assert np.isfinite(state.population.weights).all()\n"
        "print('done')"
    )
    assert done.stdout == "done\n", done.stderr


def test_data_summaries_parameters_and_comparisons():
    done = light(
        "from mstfilter.smc import *\n"
        "m = ([[0.9]], [[0.5]], [[1.0]], [[1.0]], [0.0], [[1.0]])\n"
        "states, ys = linear_gaussian(*m).simulate(5, seed=1)\n"
        "arms = {type(s).__name__: bootstrap(linear_gaussian(*m), 20, s) for s in (Systematic(), Multinomial())}\n"
        "runs = run_many(arms, ys, range(5), x=mean, q=quantiles(), v=covariance)\n"
        "print(runs.compare('Systematic', x=kalman_filter(*m, ys).means))\n"
        "def filter_of(theta):\n"
        "    move = lambda x: Normal(theta['rho'] * x, 0.5)\n"
        "    return bootstrap(StateSpaceModel.of(Normal(), move, lambda x: Poisson(1.0 + x * x)), 10)\n"
        "prior = {'rho': Truncated(Normal(), -1.0, 1.0)}\n"
        "print(pmmh(filter_of, [1, 2], prior, scale=0.1, n_iterations=2)['rho'].shape)"
    )
    said = "Multinomial and Systematic on the squared error of x: no difference can be claimed at n = 5"
    assert done.stdout.startswith(said) and done.stdout.endswith("(2, 1)\n"), done.stderr


@pytest.mark.parametrize(
    "arguments, says",
    [
        ([], ["Without typer, only `list`, --help and --version"]),
        (["--help"], ["pip install mstfilter"]),
        (["--version"], ["mstfilter 0."]),
        (["list"], ["not available: pip install opencv-python-headless", "\nfamilies:\n"]),
        (["list", "resamplers"], ["systematic          Makes floor or ceil", "scheme=multinomial"]),
        (["list", "presets"], ["mst                 MST, the default"]),
    ],
)
def test_the_command_line_answers(arguments, says):
    done = light(COMMAND, *arguments)
    assert done.returncode == 0 and all(words in done.stdout for words in says), done.stderr


@pytest.mark.parametrize("arguments", [["simulate", "demo", "out"], ["run", "recording"], ["check", "update.union"]])
def test_other_commands_say_what_they_need(arguments, tmp_path):
    done = light(COMMAND, *arguments)
    message = f"error: mstfilter {arguments[0]} needs typer, which cannot be imported: No module named 'typer'"
    assert (done.returncode, done.stderr) == (2, f"{message}\nhint: pip install typer\n")


def test_a_component_says_which_library_it_needs():
    done = light("from mstfilter.runs.presets import REGISTRY; REGISTRY.find_class('update', 'partition')")
    assert "MissingLibraryError: update: component 'partition' needs networkx" in done.stderr
    assert done.stderr.endswith("hint: pip install networkx\n")


def test_storing_a_run_imports_neither_programs_nor_studies():
    code = "import sys; from mstfilter.runs import RunFolder, filter_recording; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, timeout=600)
    loaded = done.stdout.split()
    assert "mstfilter.smc.checkpoint" in loaded
    assert not [name for name in loaded if name.startswith(("mstfilter.smc.models.programs", "mstfilter.runs.study"))]
