"""Collectors, many runs, checkpoints."""

from __future__ import annotations

import copy
import io
import os
import pickle
import re
import signal
import subprocess
import sys
import time
import tracemalloc
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.files import folder_name
from mstfilter.smc import (
    Codec,
    EssBelow,
    Key,
    Multinomial,
    Normal,
    Population,
    State,
    StateSpaceModel,
    Tempered,
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
    weight_entropy,
)
from mstfilter.smc.checkpoint import digest, load_state, save_state
from tests.conftest import REPOSITORY
from tests.smc.models import AR1, SYMBOLS, Box, ar1_observations, hmm

YS = ar1_observations(10)
FACTOR = 2.0


# --- collectors ---------------------------------------------------------------------------------------------------
def test_collectors():
    filter = bootstrap(AR1, 64)
    kept = {"ess": ess, "unique": unique_ancestors, "entropy": weight_entropy, "z": log_evidence, "mean": mean}
    found = collect(filter.iterate(YS, 3), **kept, own=lambda state, info: [info.t, 2 * info.t])
    state, infos = filter.run(YS, 3)
    assert set(found) == {*kept, "own"}
    np.testing.assert_array_equal(found["ess"], [info.ess for info in infos])
    parents = [state.population.parents.get("previous", []) for state, _ in filter.iterate(YS, 3)]
    assert found["unique"].tolist() == [len(set(index)) for index in parents]
    np.testing.assert_array_equal(found["own"], [[t, 2 * t] for t in range(10)])
    assert found["z"][-1] == state.log_evidence == found.state.log_evidence
    w = state.population.weights
    assert found["entropy"][-1] == pytest.approx(-(w * np.log(w)).sum())
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
def test_results_do_not_depend_on_workers_or_on_other_arms():
    arms = {"systematic": bootstrap(AR1, 50), "multinomial": bootstrap(AR1, 50, Multinomial())}
    kept = {"log_evidence": log_evidence, "mean": mean}
    one = run_many(arms, YS, range(6), **kept)
    more = run_many({"third": bootstrap(AR1, 7), **arms}, YS, range(6), workers=3, **kept)
    alone = run_many(arms["multinomial"], YS, [4], **kept)
    for name in kept:
        np.testing.assert_array_equal(one[name], more[name][1:])
        np.testing.assert_array_equal(one[name][1, 4], alone[name][0])
    # Paired: both arms start from the same draws, so the first step is the same.
    np.testing.assert_array_equal(one["mean"][0, :, 0], one["mean"][1, :, 0])


def test_errors_in_workers_name_the_run():
    def broken(state, info):
        raise InputError("no")

    for workers in (1, 2):
        for filters, where in (({"a": bootstrap(AR1, 4)}, "arm 'a', seed 5: no"), (bootstrap(AR1, 4), "^seed 5: no")):
            with pytest.raises(InputError, match=where):
                run_many(filters, YS, [5], workers=workers, x=broken)
    with pytest.raises(InputError, match="workers is 0"):
        run_many({"a": bootstrap(AR1, 4)}, YS, [5], workers=0)


FRAGILE = replace(AR1, log_likelihood=lambda x, y: np.where(x < -0.2, AR1.log_likelihood(x, y), -np.inf))


def test_lost_runs_of_workers_are_those_of_one_process():
    """What `History.lost` and the arrays of lost runs hold is tested in test_batching.py."""
    arms = {"few": bootstrap(FRAGILE, 3), "many": bootstrap(FRAGILE, 60)}
    one, two = (run_many(arms, YS[:5], range(12), workers=k, x=resampled) for k in (1, 2))
    assert one.lost == two.lost and {arm for arm, _ in one.lost} == {"few"}
    np.testing.assert_array_equal(one["x"], two["x"])


CALLS: list[int] = []


def counted(state, info):
    CALLS.append(info.t)
    return info.ess


def test_stored_runs_are_not_run_again(tmp_path):
    def run(seeds, n=2, **options):
        return run_many({"a/b": bootstrap(FRAGILE, n)}, YS[:5], seeds, folder=tmp_path / "runs", x=counted, **options)

    steps: list[tuple[int, int]] = []
    first = run(range(4), progress=lambda done, total: steps.append((done, total)))
    assert steps[-1] == (4, 4)
    before = len(CALLS)
    (tmp_path / "runs" / folder_name("a/b") / "2.npz").unlink()
    again = run(range(4))
    # Only run 2 was repeated.
    assert len(CALLS) - before == np.isfinite(first["x"][0, 2]).sum()
    np.testing.assert_array_equal(first["x"], again["x"])
    assert first.lost == again.lost and len(again.lost) > 0
    for other in (
        lambda: run(range(4), n=6),
        lambda: run_many({"a/b": bootstrap(FRAGILE, 2)}, YS[:4], [0], folder=tmp_path / "runs", x=counted),
    ):
        with pytest.raises(
            InputError, match="was made by another filter or seed, other observations or other collectors"
        ):
            other()


LINEAR = linear_gaussian(*np.array([[[0.9]], [[0.4]], [[1.0]], [[0.2]]]), [0.0], [[1.0]])


def test_an_arm_that_is_processed_together_gives_the_numbers_of_single_runs(tmp_path):
    arms = {"together": bootstrap(LINEAR, 20), "single": bootstrap(replace(LINEAR, batched=False), 20)}
    kept = {"z": log_evidence, "ess": ess, "x": mean}
    runs = run_many(arms, YS, range(5), **kept, folder=tmp_path)
    for name in kept:
        np.testing.assert_array_equal(runs[name][0], runs[name][1])
    assert runs.single == {"single": "initial: it is not batched"}
    assert run_many(arms, YS, range(5), **kept, folder=tmp_path).single == {}, "all runs are stored"
    one = run_many(arms["together"], YS, range(5), **kept)
    assert one.dims == ("seed", "time") and list(one.coords) == ["seed", "time"]
    np.testing.assert_array_equal(one["x"], runs["x"][0])


def test_every_seed_with_its_own_data(tmp_path):
    filter, data = bootstrap(LINEAR, 20), [YS, YS[::-1], 2 * np.asarray(YS)]
    for workers in (1, 2):  # the second call reads the stored runs
        runs = run_many(filter, data, [5, 3, 4], paired=True, workers=workers, folder=tmp_path)
        for r, seed in enumerate([5, 3, 4]):
            assert runs["log_evidence"][r, -1] == filter.run(data[r], seed)[0].log_evidence
    with pytest.raises(InputError, match=r"3.npz was made by .*; 2 stored runs cannot be used"):
        run_many(filter, [data[0], data[2], data[1]], [5, 3, 4], paired=True, folder=tmp_path)


ODD_NAMES = ("a", "A", "..", "", "a/b", "/etc/x", "con", "a.", "a\0", "\u00e9", "e\u0301", "x" * 5000, "\ud800")


def test_every_name_of_an_arm_has_a_folder_inside(tmp_path):
    folder = tmp_path / "in" / "runs"
    arms = {name: bootstrap(AR1, n) for n, name in enumerate(ODD_NAMES, 3)}
    runs = run_many(arms, YS[:3], [1], folder=folder, x=ess)
    files = [p for p in tmp_path.rglob("*") if p.is_file()]
    names = [p.parent.name for p in files]
    assert len(files) == len(arms) and all(p.parent.parent == folder and p.name == "1.npz" for p in files)
    assert len({name.lower() for name in names}) == len(arms) and max(map(len, names)) < 100
    assert all(re.fullmatch("[a-z0-9_~-]+", name) and name != "con" for name in names)
    np.testing.assert_array_equal(run_many(arms, YS[:3], [1], folder=folder, x=ess)["x"], runs["x"])


def test_damaged_stored_runs_are_named(tmp_path):
    """Cut anywhere, with any byte changed, or other content: never a raw error, never another result."""

    def run(**collectors):
        return run_many({"a": bootstrap(AR1, 4)}, YS[:3], [0, 1], folder=tmp_path, **(collectors or {"x": ess}))

    first = run()["x"]
    path = tmp_path / "a" / "1.npz"
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    changed = [bytearray(whole) for _ in range(60)]
    for content in changed:
        content[rng.integers(len(whole))] ^= rng.integers(1, 256)
    other = io.BytesIO()
    np.savez(other, head=np.array(3.0))
    single = io.BytesIO()
    np.save(single, np.zeros(3))
    cut = [whole[:k] for k in (*range(0, len(whole), 100), len(whole) - 1)]
    refused = 0
    for content in (*cut, *changed, other.getvalue(), single.getvalue(), b"no zip at all", pickle.dumps([1])):
        path.write_bytes(content)
        try:
            again = run()["x"]
        except InputError as error:
            assert str(path) in error.message and error.hints, error
            refused += 1
        else:  # a byte without a meaning, such as a date
            np.testing.assert_array_equal(again, first)
    assert refused > len(cut) + 40
    for content in (b"", (tmp_path / "a" / "0.npz").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(InputError, match="1.npz"):
            run()
    (tmp_path / "a" / "0.npz").write_bytes(b"")
    with pytest.raises(InputError, match="0.npz.*2 stored runs cannot be used"):
        run()
    with pytest.raises(InputError, match="is a file"):
        run_many({"a": bootstrap(AR1, 4)}, YS[:3], [0], folder=path)


def ends_the_process(state, info):
    if state.key.seed == 5:
        os._exit(3)
    return info.ess


def test_a_worker_that_dies_is_named_with_its_runs(tmp_path):
    died = r"a worker process died \(EXIT\(3\)\); the first runs that are not finished: (seed 4; )?seed 5"
    filter = bootstrap(replace(AR1, batched=False), 4)
    with pytest.raises(InputError, match=died) as error:
        run_many(filter, YS[:3], [4, 5, 6], workers=2, folder=tmp_path, x=ends_the_process)
    assert "continues" in error.value.hints[-1]


def test_workers_need_a_script_that_is_not_imported(tmp_path):
    """On import, workers would import the module again, and wait for the import to end."""
    pytest.importorskip("joblib")
    lines = (
        "from mstfilter.smc import bootstrap, linear_gaussian, run_many",
        "model = linear_gaussian([[0.9]], [[1]], [[1]], [[1]], [0], [[1]])",
        "def one(state, info): return 1.0",
        "runs = run_many({'a': bootstrap(model, 5)}, [0.1], range(4), workers=2, x=one)",
        "print('made', runs['x'].sum())",
    )
    (tmp_path / "script.py").write_text("\n".join(lines))
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}

    def python(*arguments):
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)

    found = python("-c", "import script")
    assert "script.py, line 4: run_many with workers is called in an import" in found.stderr
    assert (
        found.returncode == 1
        and found.stderr.count("\nmstfilter.errors.InputError") == 1
        and "__main__" in found.stderr
    )
    assert python("script.py").stdout == "made 4.0\n"


# --- codecs -------------------------------------------------------------------------------------------------------
class Boxes(Codec):
    def encode(self, particles):
        return {"grids": np.array([box.grid for box in particles])}

    def decode(self, arrays):
        return tuple(Box(tuple(grid)) for grid in arrays["grids"].tolist())


@pytest.mark.parametrize(
    "particles",
    [
        np.random.default_rng(0).normal(size=(4, 2)).astype(np.float32),
        {"x": np.arange(3.0), "k": np.array([True, False, True])},
    ],
    ids=["array", "mapping"],
)
def test_states_come_back_bit_for_bit(particles, tmp_path):
    n = len(next(iter(particles.values()))) if isinstance(particles, dict) else len(particles)
    population = Population(particles, np.linspace(-1e4, 1, n), {"previous": np.arange(n)})
    save_state(tmp_path / "s.npz", State(7, population, Key(3), False))
    state, _ = load_state(tmp_path / "s.npz")
    found = state.population.particles
    assert (state.t, state.key, state.properly_weighted) == (7, Key(3), False)
    np.testing.assert_array_equal(state.population.log_weights, population.log_weights)
    np.testing.assert_array_equal(state.population.parents["previous"], np.arange(n))
    if isinstance(particles, np.ndarray):
        assert found.dtype == particles.dtype
        np.testing.assert_array_equal(found, particles)
    else:
        assert {k: a.dtype for k, a in found.items()} == {k: a.dtype for k, a in particles.items()}
        np.testing.assert_array_equal(found["x"], particles["x"])


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
    assert load_state(tmp_path / "s.npz", Boxes())[0].population.particles == (Box((1,)), Box((2,)))
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


# --- checkpoints of runs ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("filter", "ys", "codec"),
    [
        (bootstrap(AR1, 30), YS, None),
        (bootstrap(hmm("objects"), 30), SYMBOLS, Boxes()),
    ],
    ids=["arrays", "objects"],
)
def test_a_run_goes_on_from_its_checkpoint(filter, ys, codec, tmp_path):
    whole, _ = filter.run(ys, 5)
    path = tmp_path / "run.npz"
    _, first = filter.run(ys[:4], 5, checkpoint=path, codec=codec)
    state, rest = filter.run(ys, 5, checkpoint=path, codec=codec)
    assert [i.t for i in (*first, *rest)] == list(range(len(ys)))
    again, none = filter.run(ys, 5, checkpoint=path, codec=codec)
    assert none == []
    for other in (state, again):
        assert other.log_evidence == whole.log_evidence and other.t == len(ys)
        for a, b in zip(other.population.particles, whole.population.particles, strict=True):
            assert a == b
    with pytest.raises(InputError, match="its seed is"):
        filter.run(ys, 6, checkpoint=path, codec=codec)
    with pytest.raises(InputError, match="is of another run: its filter"):
        bootstrap(AR1, 31).run(YS, 5, checkpoint=path, codec=codec)
    with pytest.raises(InputError, match="folder of the checkpoint"):
        filter.run(ys, 5, checkpoint=tmp_path / "no" / "run.npz")
    # A field of a component that changed would give neither run.
    for other, message in (
        (replace(filter, trigger=EssBelow(0.9)), r"its filter.trigger.share is 0.5, expected 0.9"),
        (
            replace(filter, resampler=Tempered(power=0.5)),
            "filter.resampler.class is Systematic, expected Temp",
        ),
        (replace(filter, n=31), "its filter.n is 30|its filter.n is 8"),
    ):
        with pytest.raises(InputError, match=message):
            other.run(ys, 5, checkpoint=path, codec=codec)
    same = replace(filter, n=np.int64(filter.n))
    assert same.run(ys, 5, checkpoint=path, codec=codec)[1] == []
    with pytest.raises(InputError, match=f"its first {len(ys)} observations differ"):
        filter.run([*ys[:2], None, *ys[3:]], 5, checkpoint=path, codec=codec)
    with pytest.raises(InputError, match="there are only 3 observations"):
        filter.run(ys[:3], 5, checkpoint=path, codec=codec)
    with pytest.raises(InputError, match="its first step is 0, expected 2"):
        filter.run(ys[2:], filter.run(ys[:2], 5)[0], checkpoint=path, codec=codec)


def with_noise(sd):
    return StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, sd), lambda x: Normal(x, 1.0))


def test_a_checkpoint_of_another_model_is_refused(tmp_path):
    """Also if the models differ only in a number that a function encloses, or in its code."""
    path = tmp_path / "run.npz"
    bootstrap(with_noise(0.5), 20).run(YS[:3], 0, checkpoint=path)
    assert len(bootstrap(with_noise(0.5), 20).run(YS, 0, checkpoint=path)[1]) == len(YS) - 3
    for other in (
        with_noise(0.6),
        replace(with_noise(0.5), log_likelihood=lambda x, y: -((x - y) ** 2)),
        replace(with_noise(0.5), log_likelihood=partial(with_noise(0.5).log_likelihood)),
    ):
        with pytest.raises(InputError, match="is of another run: its filter"):
            bootstrap(other, 20).run(YS, 0, checkpoint=path)


def test_what_a_hash_depends_on():
    """The same value gives the same hash, and every pair of different ones different hashes."""

    def recursive(x):
        return recursive(x) if x else FACTOR

    values = [
        None, 0, 0.0, False, "0", (), [], (1,), {"a": 1}, {"a": 2}, {"b": 1}, np.zeros(2), np.zeros((2, 1)),
        np.zeros(2, np.float32), np.array([0.0, 1.0]), np.float64(0.0), {1, 2}, frozenset({1, 2}), recursive,
        lambda x: x, lambda x: x + 1, lambda x, y=1: x, EssBelow(0.5), EssBelow(0.25), EssBelow, partial(len, "a"),
        np.array([1, "a"], object), with_noise(1.0).density, with_noise(2.0).density,
    ]  # fmt: skip
    hashes = [digest(value) for value in values]
    assert hashes == [digest(copy.deepcopy(value)) for value in values]
    assert len(set(hashes)) == len(hashes)


def test_a_hash_follows_the_constants_that_a_function_uses(monkeypatch):
    before = digest(lambda x: FACTOR * x)
    monkeypatch.setitem(globals(), "FACTOR", 3.0)
    assert digest(lambda x: FACTOR * x) != before


def killed(kind, path, delays):
    """Run a script and kill it after each delay."""
    script = REPOSITORY / "tests" / "smc" / "killed.py"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    for delay in delays:
        process = subprocess.Popen([sys.executable, script, kind, path], env=environment, stdout=subprocess.PIPE)
        process.stdout.readline()  # the run has begun
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
    subprocess.run([sys.executable, script, kind, path], check=True, env=environment)


@pytest.mark.skipif(sys.platform == "win32", reason="kills a process by a signal")
@pytest.mark.parametrize(("kind", "n_kills"), [("checkpoint", 4), ("run_many", 2)])
def test_a_killed_run_ends_as_one_that_was_not(kind, n_kills, tmp_path):
    """Kills at random moments; experiments/reliability stops a run at every operation on files."""
    whole, path = tmp_path / "whole.npz", tmp_path / "run.npz"
    killed(kind, whole, [])
    killed(kind, path, np.random.default_rng(1).uniform(0, 0.12, n_kills))
    pairs = (
        [(whole, path)] if kind == "checkpoint" else [(f, path / f.relative_to(whole)) for f in whole.rglob("*.npz")]
    )
    assert len(pairs) == (1 if kind == "checkpoint" else 2 * 8 + 1)
    for files in pairs:
        with np.load(files[0]) as a, np.load(files[1]) as b:
            assert a.files == b.files
            for name in a.files:
                np.testing.assert_array_equal(a[name], b[name])


class Table:
    """What a data frame does: it iterates over the names of its columns."""

    columns = ("y",)

    def __iter__(self):
        return iter(self.columns)


@pytest.mark.parametrize(
    ("observations", "message", "hint"),
    [
        (Table(), "observations are a Table", "to_numpy"),
        ({"y": [1.0]}, "observations are a dict", "to_numpy"),
        ("ab", "observations are a str", "to_numpy"),
        ([np.ones(1), np.array([np.nan])], "observation 1 is NaN", "None"),
        (np.array([1.0, 2.0, np.nan]), "observation 2 is NaN", "None"),
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
