"""Tables and trees: every number is where the documentation says, and comes back."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from mstfilter.errors import MissingLibraryError
from mstfilter.smc import (
    Always,
    Chains,
    bootstrap,
    collect,
    ess,
    mean,
    resampled,
    run_many,
    unique_ancestors,
)
from tests.smc.models import AR1, ar1_observations

RNG = np.random.default_rng(0)
CHAINS = Chains(RNG.normal(size=(4, 2, 3)), RNG.normal(size=(4, 2)), RNG.normal(size=(4, 2)), np.array([0.25, 0.5]))


def test_columns_of_chains():
    columns = CHAINS.columns()
    assert list(columns) == ["chain", "draw", "theta_0", "theta_1", "theta_2", "log_evidence", "log_density"]
    for row in range(8):
        chain, draw = columns["chain"][row], columns["draw"][row]
        assert (chain, draw) == divmod(row, 4)
        assert columns["theta_2"][row] == CHAINS.theta[draw, chain, 2]
        assert columns["log_density"][row] == CHAINS.log_density[draw, chain]


def test_data_frames():
    pandas, _ = pytest.importorskip("pandas"), pytest.importorskip("xarray")
    ys = ar1_observations(5)
    _, infos = bootstrap(AR1, 8).run(ys, 1)
    history = run_many(
        {"a": bootstrap(AR1, 8), "b": bootstrap(AR1, 9)}, ys, [4, 5], ess=ess, n=lambda state, info: info.n
    )
    for table in (history, CHAINS):
        frame = pandas.DataFrame(table.columns())
        for name, column in table.columns().items():
            np.testing.assert_array_equal(frame[name].to_numpy(), column)
    frame = pandas.DataFrame(infos.rows())
    assert frame["ess"].tolist() == [info.ess for info in infos] and frame["resampled"].dtype == bool
    row = pandas.DataFrame(history.columns()).query("arm == 'b' and seed == 5 and time == 3").iloc[0]
    assert (row["ess"], row["n"]) == (history["ess"][1, 1, 3], 9)
    table = history.to_xarray()
    assert table["ess"].dims == ("arm", "seed", "time") and float(table["n"].sel(arm="b", seed=5, time=3)) == 9


def test_a_missing_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingLibraryError, match="this export needs xarray"):
        collect([]).to_xarray()


def test_a_history_shows_itself_in_five_lines():
    filter, ys = bootstrap(AR1, 8, trigger=Always()), ar1_observations(5)
    few = collect(filter.iterate(ys, 0), ess=ess, resampled=resampled)
    low, high = few["ess"].min(), few["ess"].max()
    assert repr(few) == f"History: time 5\n  ess float64 (5,), {low:.4g} to {high:.4g}\n  resampled bool (5,)"
    collectors = {
        "ess": ess,
        "n": lambda state, info: info.n,
        "unique": unique_ancestors,
        "mean": mean,
        "fired": resampled,
    }
    many = run_many({"a": filter}, [*ys, 1e200], [1, 2], **collectors)
    lines = repr(many).splitlines()
    assert lines[0] == "History: arm 1, seed 2, time 6, 2 runs lost" and len(lines) == 5
    assert lines[-1] == "  also mean, fired"
    assert repr(collect([])) == "History: time 0"


def test_chains_show_themselves():
    assert repr(CHAINS) == "Chains: 4 iterations of 2 chains, 3 parameters, accepted 0.25 to 0.50"
