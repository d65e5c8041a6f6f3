"""The scaling study: its slopes against known powers, its small form, its committed figures. No time is judged."""

from __future__ import annotations

import csv
import importlib.util
import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import linregress

from mstfilter.simulation import FIRST_REPORTED_SEED
from tests.conftest import REPOSITORY

FOLDER = REPOSITORY / "experiments/scaling"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("scaling_run", FOLDER / "run.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def lines(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_slope_of_a_power_is_its_exponent(study):
    x = np.array([1.0, 2.0, 5.0, 20.0])
    assert study.slope(x, 3 * x**1.7) == pytest.approx(1.7)
    assert np.isnan(study.slope(x, np.array([1.0, 0.0, 1.0, 1.0])))
    assert np.isnan(study.slope(np.array([16.0, 17.0]), np.array([1.0, 2.0])))
    # A constant and a power: flat at first, the power at the end.
    rows = [
        {
            "factor": "n",
            "n": str(v),
            "peak_mb": "100",
            "step_s": str(1 + v**3),
            **{f"{s}_s": "0" for s in study.STAGES},
        }
        for v in (0.01, 0.1, 100, 1000)
    ]
    found = {r["figure"]: r for r in study.slopes(rows)}
    assert float(found["step_s"]["slope_at_the_end"]) == pytest.approx(3.0, abs=0.01)
    assert float(found["step_s"]["slope"]) < 2.5
    assert float(found["peak_mb"]["slope"]) == 0.0 and found["update_s"]["slope"] == ""


def test_one_factor_at_a_time(study):
    base = study.BASE
    for factor, chosen in study.cases(False).items():
        assert all(0 <= case.seed < FIRST_REPORTED_SEED // 10 for case in chosen), "tuning seeds are 0 - 99"
        if factor != "objects":
            assert base in chosen
            field = {"voxels": "side", "n": "n", "frames": "stride"}[factor]
            assert all(vars(case) == {**vars(base), field: getattr(case, field)} for case in chosen)
            assert study.FRAMES % max(case.stride for case in chosen) == 0
    assert len({case.name for chosen in study.cases(False).values() for case in chosen}) == 20


def test_smoke(tmp_path, monkeypatch):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    command = [sys.executable, str(FOLDER / "run.py"), "--smoke"]
    refused = subprocess.run(command, capture_output=True, text=True)
    assert refused.returncode == 2 and "would overwrite the results" in refused.stderr
    for _ in range(2):
        done = subprocess.run([*command, "--out", str(tmp_path)], check=True, capture_output=True, text=True)
    assert "objects_found" not in done.stdout  # the second time nothing is measured
    rows = lines(tmp_path / "measured.csv")
    assert [(r["voxels"], r["n"], r["frames"]) for r in rows] == [
        ("7500", "2", "8"),
        ("62500", "2", "8"),
        ("62500", "1", "8"),
        ("62500", "2", "2"),
    ]
    for r in rows:
        parts = sum(float(r[f"{s}_s"]) for s in ("transition", "proposal", "update", "resampler", "build"))
        assert 0.5 * float(r["step_s"]) < parts <= float(r["step_s"]) + 1e-3
        assert float(r["peak_mb"]) > float(r["before_mb"]) > 20
    assert {r["factor"] for r in lines(tmp_path / "slopes.csv")} == {"voxels", "n", "frames"}
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_committed_slopes_are_those_of_the_committed_measurements(study):
    measured = {r["case"]: r for r in lines(FOLDER / "results/measured.csv")}
    fitted = {(r["factor"], r["figure"]): r for r in lines(FOLDER / "results/slopes.csv")}
    wanted = study.cases(False)
    assert set(measured) == {case.name for chosen in wanted.values() for case in chosen}
    for factor in (*wanted, "objects_found"):
        own = [measured[case.name] for case in wanted[factor.removesuffix("_found")]]
        x = np.log([float(r[factor]) for r in own])
        for figure in ("step_s", "transition_s", "peak_mb"):
            expected = linregress(x, np.log([float(r[figure]) for r in own])).slope
            assert float(fitted[factor, figure]["slope"]) == pytest.approx(expected, abs=0.006)
