"""``mstfilter check ./model.py:model``."""

from __future__ import annotations

import numpy as np
import pytest

from tests.app.test_cli import call

MODELS = """
import numpy as np
from mstfilter.smc import Normal, Program, StateSpaceModel, guided, observe, sample

right = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
mixed = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x.mean(), 0.5), lambda x: Normal(x, 1.0))
functions = StateSpaceModel(
    lambda rng, n: rng.normal(size=n),
    lambda rng, x: 0.9 * x + rng.normal(size=len(x)),
    lambda x, y: -0.5 * (x - y) ** 2,
)
narrow = guided(right, lambda x, y: Normal(0.9 * x, 0.02), 100)
ys = [0.3, -0.2, 0.8]


def program(previous, y):
    x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], 0.5))
    observe("y", Normal(x, 1.0), y)
"""


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.py").write_text(MODELS, encoding="utf-8")
    np.save(tmp_path / "ys.npy", [0.3, -0.2, 0.8])
    return "./model.py"


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["right"], 0, "right: all properties that apply hold"),
        (["program"], 0, "program: all properties that apply hold"),
        (["functions", "--observations", "./model.py:ys"], 0, "all properties that apply hold"),
        (["functions", "--observations", "ys.npy"], 0, "all properties that apply hold"),
        (["functions"], 1, "has no sample_observation to draw observations: give observations"),
        (["mixed"], 1, "a particle moves differently among others"),
        (["narrow"], 1, "nats too small: it is narrower than the posterior"),
        (["missing"], 2, "has no 'missing'"),
        (["right", "n=3"], 2, "is a model, which has no fields to set"),
        (["right", "--observations", "none.npy"], 2, "observations none.npy"),
    ],
)
def test_models_of_a_file_are_checked(file, arguments, code, text, capsys):
    found, out, err = call("check", f"{file}:{arguments[0]}", *arguments[1:], capsys=capsys)
    assert found == code, out + err
    assert text in " ".join((out + err).split())
