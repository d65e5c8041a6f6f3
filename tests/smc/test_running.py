"""Collectors, many runs, tables, checkpoints."""

from __future__ import annotations

import io
import os
import re
import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError, MissingLibraryError
from mstfilter.smc import (
    Always,
    Chains,
    Codec,
    Key,
    Multinomial,
    Population,
    State,
    WithInput,
    bootstrap,
    collect,
    ess,
    kalman_filter,
    keep as keep_record,
    linear_gaussian,
    log_evidence,
    mean,
    resampled,
    run_many,
    unique_ancestors,
)
from mstfilter.smc.checkpoint import load_state, save_state
from tests.smc.models import AR1, SYMBOLS, Box, ar1_observations, hmm

YS = ar1_observations(10)


# --- collectors ---------------------------------------------------------------------------------------------------
def test_collectors():
    filter = bootstrap(AR1, 64)
    kept = {"ess": ess, "unique": unique_ancestors, "z": log_evidence, "mean": mean}
    found = collect(filter.iterate(YS, 3), **kept, own=lambda state, info: [info.t, 2 * info.t])
    state, infos = filter.run(YS, 3)
    assert set(found) == {*kept, "own"}
    np.testing.assert_array_equal(found["ess"], [info.ess for info in infos])
    parents = [state.population.parents.get("previous", []) for state, _ in filter.iterate(YS, 3)]
    assert found["unique"].tolist() == [len(set(index)) for index in parents]
    np.testing.assert_array_equal(found["own"], [[t, 2 * t] for t in range(10)])
    assert found["z"][-1] == state.log_evidence == found.state.log_evidence
    w = state.population.weights
    assert found["mean"][-1] == pytest.approx(w @ state.population.particles)
    with pytest.raises(KeyError, match="nothing was collected as 'es'"):
        found["es"]
    with pytest.raises(InputError, match="different shapes"):
        collect(filter.iterate(YS, 0), odd=lambda state, info: np.zeros(info.t))
    for odd in (lambda state, info: np.zeros(info.t), lambda state, info: np.zeros(state.key.seed)):
        with pytest.raises(InputError, match="different shapes"):
            run_many(filter, YS, [0, 1], odd=odd)


def test_the_memory_of_a_long_run_is_bounded():
    """60 steps of 4,000 particles: the weights and parents of one step have 64 kB, infos of all steps less."""
    tracemalloc.start()
    infos = bootstrap(AR1, 4000).run(np.tile(YS, 6), 3)[1]
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert len(infos) == 60 and held < 500_000


# --- many runs ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("together", [True, False])
def test_results_do_not_depend_on_workers_or_on_other_arms(together):
    arms = {"systematic": bootstrap(AR1, 50), "multinomial": bootstrap(AR1, 50, Multinomial())}
    kept = {"log_evidence": log_evidence, "mean": mean}
    one = run_many(arms, YS, range(6), together=together, **kept)
    more = run_many({"third": bootstrap(AR1, 7), **arms}, YS, range(6), workers=3, together=together, **kept)
    for name in kept:
        np.testing.assert_array_equal(one[name], more[name][1:])
    # Paired: both arms start from the same draws, so the first step is the same.
    np.testing.assert_array_equal(one["mean"][0, :, 0], one["mean"][1, :, 0])


def test_runs_that_are_not_together_are_single_runs():
    runs = run_many(bootstrap(AR1, 50), YS, [3, 4], together=False)
    single = [bootstrap(AR1, 50).run(YS, seed)[0].log_evidence for seed in (3, 4)]
    assert runs["log_evidence"][:, -1].tolist() == single


def test_errors_in_workers_name_the_run():
    def broken(state, info):
        raise InputError("no")

    for workers in (1, 2):
        for filters, where in (({"a": bootstrap(AR1, 4)}, "arm 'a'.*seed 5: no"), (bootstrap(AR1, 4), "seed 5: no")):
            with pytest.raises(InputError, match=where):
                run_many(filters, YS, [5], workers=workers, x=broken)
    with pytest.raises(InputError, match="workers is 0"):
        run_many({"a": bootstrap(AR1, 4)}, YS, [5], workers=0)


FRAGILE = replace(AR1, log_likelihood=lambda x, y: np.where(x < -0.2, AR1.log_likelihood(x, y), -np.inf))


def test_lost_runs_of_workers_are_those_of_one_process():
    arms = {"few": bootstrap(FRAGILE, 3), "many": bootstrap(FRAGILE, 60)}
    one, two = (run_many(arms, YS[:5], range(12), workers=k, x=resampled) for k in (1, 2))
    assert one.lost == two.lost and {arm for arm, _ in one.lost} == {"few"}
    np.testing.assert_array_equal(one["x"], two["x"])


def ends_the_process(state, info):
    if state.key.seed == 5:
        os._exit(3)
    return info.ess


def test_a_worker_that_dies_is_named_with_its_runs():
    died = r"a worker process died \(EXIT\(3\)\); the first runs that are not finished: (seed 4; )?seed 5"
    with pytest.raises(InputError, match=died):
        run_many(bootstrap(AR1, 4), YS[:3], [4, 5, 6], workers=2, together=False, x=ends_the_process)


# --- codecs -------------------------------------------------------------------------------------------------------
class Boxes(Codec):
    def encode(self, particles):
        return {"grids": np.array([box.grid for box in particles])}

    def decode(self, arrays):
        return tuple(Box(tuple(grid)) for grid in arrays["grids"].tolist())


def test_what_cannot_be_stored_is_one_clear_error(tmp_path):
    def save(particles, codec=None):
        save_state(tmp_path / "s.npz", State(1, Population(particles), Key(0)), codec)

    with pytest.raises(InputError, match="particles of type complex cannot be stored"):
        save((1j, 2j))
    with pytest.raises(InputError, match="array of Python objects"):
        save(np.array([object()]))
    with pytest.raises(InputError, match="particles of type Box cannot be stored"):
        save((Box((1,)),))
    assert not list(tmp_path.iterdir()), "nothing is left behind"
    save((Box((1,)), Box((2,))), Boxes())
    assert load_state(tmp_path / "s.npz", Boxes()).population.particles == (Box((1,)), Box((2,)))
    whole = (tmp_path / "s.npz").read_bytes()
    other, single = io.BytesIO(), io.BytesIO()
    np.savez(other, x=np.zeros(3))
    np.save(single, np.zeros(3))
    for content in (b"", b"no zip", b"PK nonsense", whole[: len(whole) // 2], single.getvalue(), other.getvalue()):
        (tmp_path / "s.npz").write_bytes(content)
        with pytest.raises(InputError, match="s.npz") as found:
            load_state(tmp_path / "s.npz", Boxes())
        assert found.value.hints
    for head in ('"text"', "3", "{}", '{"format": 1}', '{"format": 1, "seed": 0, "path": [], "t": 1}', "not json"):
        np.savez(tmp_path / "s.npz", head=np.array(head), log_weights=np.zeros(2))
        with pytest.raises(InputError, match="s.npz"):
            load_state(tmp_path / "s.npz", Boxes())
    with pytest.raises(InputError, match="checkpoint is missing"):
        load_state(tmp_path / "t.npz")


@pytest.mark.parametrize(
    ("filter", "ys", "codec"),
    [(bootstrap(AR1, 30), YS, None), (bootstrap(hmm("objects"), 30), SYMBOLS, Boxes())],
    ids=["arrays", "objects"],
)
def test_a_run_goes_on_from_a_stored_state(filter, ys, codec, tmp_path):
    whole, _ = filter.run(ys, 5)
    stored = filter.run(ys[:4], 5)[0]
    save_state(tmp_path / "run.npz", replace(stored, properly_weighted=False), codec)
    assert not load_state(tmp_path / "run.npz", codec).properly_weighted
    save_state(str(tmp_path / "run.npz"), stored, codec)
    state = load_state(str(tmp_path / "run.npz"), codec)
    state, infos = filter.run(ys[state.t :], state)
    assert [info.t for info in infos] == list(range(4, len(ys)))
    assert (state.log_evidence, state.t, state.key) == (whole.log_evidence, len(ys), whole.key)
    for name, index in whole.population.parents.items():
        np.testing.assert_array_equal(state.population.parents[name], index)
    for a, b in zip(state.population.particles, whole.population.particles, strict=True):
        assert a == b


class Table:
    """What a data frame does: it iterates over the names of its columns."""

    columns = ("y",)

    def __iter__(self):
        return iter(self.columns)


@pytest.mark.parametrize("together", [True, False])
def test_collected_values_have_a_type_of_all_runs(together):
    """A collector that returns integers in the first run and numbers in the second."""

    def own(state, info):
        return 3 if state.key.seed == 0 else 2.5

    found = run_many(bootstrap(AR1, 8), YS[:2], [0, 1], together=together, own=own)["own"]
    assert found.tolist() == [[3.0, 3.0], [2.5, 2.5]]


@pytest.mark.parametrize(
    ("observations", "message", "hint"),
    [
        (Table(), "observations are a Table", "to_numpy"),
        ({"y": [1.0]}, "observations are a dict", "to_numpy"),
        ("ab", "observations are a str", "to_numpy"),
        ([np.ones(1), np.array([np.nan])], "observation 1 is NaN", "None"),
        (np.array([1.0, 2.0, np.nan]), "observation 2 is NaN", "None"),
        (np.array([1.0, np.nan], np.float32), "observation 1 is NaN", "None"),
        ([1.0, np.float16("nan")], "observation 1 is NaN", "None"),
        ([1.0, WithInput(np.nan, 0.3)], "observation 1 is NaN", "None"),
        (np.ma.masked_invalid([1.0, np.nan]), "observation 1 has masked entries", "None"),
        (np.ma.masked_less([[1.0], [-9.0]], 0.0), "observation 1 has masked entries", "None"),
        ([np.ma.masked_less([1.0, -9.0], 0.0)], "observation 0 has masked entries", "None"),
    ],
)
def test_observations_that_cannot_be_meant_are_refused_before_the_first_step(observations, message, hint):
    one = [np.eye(1)] * 4
    filter = bootstrap(linear_gaussian(*one, np.zeros(1), np.eye(1)), n=5)
    calls = (
        lambda: filter.run(observations, seed=0),
        lambda: next(iter(filter.iterate(observations, filter.start(0)))),
        lambda: run_many(filter, observations, range(2)),
        lambda: keep_record(filter, observations),
        lambda: kalman_filter(*one, np.zeros(1), np.eye(1), observations),
    )
    for call in calls:
        with pytest.raises(InputError, match=message) as caught:
            call()
        assert hint in caught.value.hints[0]


# --- tables --------------------------------------------------------------------------------------------------------
RNG = np.random.default_rng(0)
CHAINS = Chains(RNG.normal(size=(4, 2, 3)), RNG.normal(size=(4, 2)), RNG.normal(size=(4, 2)), np.array([0.25, 0.5]))


MISTAKES_OF_RUN_MANY = {
    "seeds are 100, expected one seed for each run": ({"seeds": 100}, "seeds=range(100)"),
    "a seed is 1.5, expected an integer": ({"seeds": [0, 1.5]}, "seeds=range(100)"),
    "a seed is True, expected an integer": ({"seeds": [True]}, "seeds=range(100)"),
    "seeds are '0-9', expected integers": ({"seeds": "0-9"}, "seeds=range(100)"),
    "seeds are None, expected integers": ({"seeds": None}, "seeds=range(100)"),
    "n_runs is 100, which is neither a parameter nor a collector": ({"n_runs": 100}, "seeds=range(100)"),
    "collect is [<function mean": ({"collect": [mean]}, "mean=mean"),
    "n is 'many', which is neither": ({"n": "many"}, "ess=ess"),
    "filters are a list, expected a ParticleFilter or a mapping": (
        {"filters": [bootstrap(AR1, 8), bootstrap(AR1, 9)]},
        'give each filter a name: {"small"',
    ),
    "filters are a StateSpaceModel, expected": ({"filters": AR1}, ""),
    "filter 'a' is 3, expected a ParticleFilter": ({"filters": {"a": 3}}, ""),
    "there are no filters": ({"filters": {}}, ""),
}


@pytest.mark.parametrize("message", MISTAKES_OF_RUN_MANY)
def test_mistakes_of_run_many_are_named_with_what_may_be_given(message):
    given, hint = MISTAKES_OF_RUN_MANY[message]
    with pytest.raises(InputError, match=re.escape(message)) as found:
        run_many(**{"filters": bootstrap(AR1, 8), "observations": ar1_observations(3), "seeds": [0], **given})
    assert hint in " ".join(found.value.hints)


def test_a_collector_that_is_no_function():
    with pytest.raises(InputError, match=re.escape("ess is 0.5, which is neither")):
        collect(bootstrap(AR1, 8).iterate(ar1_observations(3)), ess=0.5)


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
