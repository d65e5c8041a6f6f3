"""The scaling study: its slopes against known powers, its cases, its small form. No time is asserted."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.files import read_csv
from tests.experiments.scripts import import_script, run_script


@pytest.fixture(scope="module")
def study():
    return import_script("scaling/run.py")


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
        assert all(0 <= case.seed < 100 for case in chosen), "tuning seeds are 0 - 99"
        if factor != "objects":
            assert base in chosen
            field = {"voxels": "side", "n": "n", "frames": "stride"}[factor]
            assert all(vars(case) == {**vars(base), field: getattr(case, field)} for case in chosen)
            assert study.FRAMES % max(case.stride for case in chosen) == 0
    assert len({case.name for chosen in study.cases(False).values() for case in chosen}) == 20


def test_smoke(tmp_path):
    arguments = ("scaling/run.py", "--smoke", "--out", tmp_path)
    assert "objects_found" in run_script(*arguments)
    printed = run_script(*arguments)
    assert "objects_found" not in printed, "finished cases are not measured again"
    rows = read_csv(tmp_path / "measured.csv")
    assert [(r["voxels"], r["n"], r["frames"]) for r in rows] == [
        ("7500", "2", "2"),
        ("62500", "2", "2"),
        ("62500", "1", "2"),
    ]
    for r in rows:
        parts = sum(float(r[f"{s}_s"]) for s in ("transition", "proposal", "update", "resampler", "build"))
        assert 0.5 * float(r["step_s"]) < parts <= float(r["step_s"]) + 1e-3
        assert float(r["peak_mb"]) > float(r["before_mb"]) > 20
    assert {r["factor"] for r in read_csv(tmp_path / "slopes.csv")} == {"voxels", "n"}
    assert (tmp_path / "figure.png").stat().st_size > 5000
