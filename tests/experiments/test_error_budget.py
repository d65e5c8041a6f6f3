"""The error budget and the study of mask quality run from end to end in their small form."""

from __future__ import annotations

import csv
import subprocess
import sys

import pytest

from tests.conftest import REPOSITORY


@pytest.mark.parametrize("name, arms", [("study", 3), ("mask_quality", 10)])
def test_smoke(tmp_path, monkeypatch, name, arms):
    from mstfilter.cli import main

    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "study"
    config = REPOSITORY / "experiments/error_budget" / f"{name}.toml"
    main_ok(main, ["study", str(config), "--smoke", "--workers", "1", "--out", str(folder)])
    with (folder / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len({row["arm"] for row in rows}) == arms
    quality = {row["arm"]: float(row["quality"]) for row in rows}
    if name == "study":
        assert quality["all true"] >= 0.97 > quality["mst"]
    else:
        best = [q for arm, q in quality.items() if "=1.0" in arm]
        assert min(best) > max(q for arm, q in quality.items() if "=0.7" in arm)
        script = [sys.executable, str(config.with_name("mask_quality.py")), str(folder), str(tmp_path / "tables")]
        subprocess.run(script, check=True, capture_output=True)
        with (tmp_path / "tables/mask_quality.csv").open(newline="") as file:
            lines = {(line["source"], line["masks"], line["method"]): line for line in csv.DictReader(file)}
        own = next(masks for source, masks, _ in lines if source == "own")
        assert 0.5 < float(own) < 1
        fused, sampled = ("mst", "object_fusion"), ("mst", "samples_only")
        expected = {("own", own): fused, ("lasting", "0.7"): fused, ("lasting", "1"): fused}
        expected |= {("independent", "0.7"): sampled, ("independent", "0.9"): sampled}
        assert set(lines) == {(*masks, method) for masks, methods in expected.items() for method in methods}
        mst, other = (lines["lasting", "1", method] for method in fused)
        for ending in ("", "_weighted"):
            gain = float(mst[f"quality{ending}"]) - float(other[f"quality{ending}"])
            assert float(other[f"mst_minus{ending}"]) == pytest.approx(gain, abs=2e-4)
        assert (tmp_path / "tables/mask_quality.png").stat().st_size > 5000


def main_ok(main, arguments):
    """The command line ends by itself where all went well."""
    try:
        main(arguments)
    except SystemExit as end:
        assert not end.code
