"""Summaries of weighted particles against numpy, scipy and exact values; collectors, tables and charts of them."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from matplotlib.collections import FillBetweenPolyCollection
from scipy import stats

from mstfilter.base.errors import InputError, MissingLibraryError
from mstfilter.scoring import compare_arms, compare_runs, plot_differences
from mstfilter.smc import (
    Multinomial,
    Normal,
    Population,
    Program,
    StateSpaceModel,
    Uniform,
    bootstrap,
    circular_mean,
    collect,
    covariance,
    ess,
    kalman_filter,
    linear_gaussian,
    log_evidence,
    mean,
    observe,
    particles,
    quantiles,
    run_many,
    sample,
    variance,
    weights,
)
from tests.smc.models import AR1, ar1_observations

RNG = np.random.default_rng(0)
X, LOG_W = RNG.normal(size=(40, 2, 3)), RNG.normal(size=40)
W = np.exp(LOG_W) / np.exp(LOG_W).sum()


def test_moments_are_those_of_numpy():
    population = Population(X, LOG_W)
    np.testing.assert_allclose(population.mean(), np.average(X, axis=0, weights=W))
    expected = np.average((X - np.average(X, axis=0, weights=W)) ** 2, axis=0, weights=W)
    np.testing.assert_allclose(population.variance(), expected)
    rows = X.reshape(40, 6)
    np.testing.assert_allclose(population.covariance(), np.cov(rows.T, aweights=W, ddof=0), atol=1e-15)
    np.testing.assert_allclose(population.mean(lambda x: x[:, 0, 0] ** 2), W @ X[:, 0, 0] ** 2)
    scalar = Population(X[:, 0, 0], LOG_W)
    assert scalar.mean().shape == scalar.variance().shape == ()
    assert scalar.covariance().shape == (1, 1) and scalar.covariance()[0, 0] == pytest.approx(scalar.variance())
    far = Population(X[:, 0, 0] + 1e9, LOG_W)  # the variance is of differences from the mean
    assert far.variance() == pytest.approx(scalar.variance(), rel=1e-5)


def test_mappings_are_summarised_by_variable():
    particles = {"x": X[:, 0], "k": np.arange(40) % 3, "on": np.arange(40) < 5}
    population = Population(particles, LOG_W)
    assert population.mean().keys() == population.quantiles().keys() == particles.keys()
    np.testing.assert_allclose(population.mean()["on"], W[:5].sum())
    assert population.quantiles([0.5])["k"].dtype.kind == "i" and population.quantiles(0.5)["x"].shape == (1, 3)
    columns = population.columns()
    assert list(columns) == ["x_0", "x_1", "x_2", "k", "on", "weight"]
    rows = np.stack([columns[name] for name in list(columns)[:-1]], axis=1)
    np.testing.assert_allclose(population.covariance(), np.cov(rows.T, aweights=W, ddof=0), atol=1e-15)


@given(
    st.lists(st.tuples(st.integers(-5, 5), st.integers(0, 4)), min_size=1, max_size=12).filter(
        lambda rows: any(w for _, w in rows)
    ),
    st.integers(0, 16),
)
@settings(max_examples=200, deadline=None)
def test_a_quantile_is_the_smallest_value_with_enough_weight(rows, sixteenths):
    """By its definition with exact integers, ties and weights of zero included; as numpy where numpy has weights."""
    values, w = map(np.array, zip(*rows, strict=True))
    level = sixteenths / 16
    with np.errstate(divide="ignore"):
        found = Population(values, np.log(w)).quantiles([level])[0]
    enough = [v for v in values[w > 0] if 16 * w[values <= v].sum() >= sixteenths * w.sum()]
    assert found == min(enough)


def test_quantiles_of_arrays_and_their_errors():
    population = Population(X, LOG_W)
    expected = np.quantile(X, [0.05, 0.5, 0.95], axis=0, weights=W, method="inverted_cdf")
    np.testing.assert_array_equal(population.quantiles(), expected)
    many = Population(stats.norm.ppf((np.arange(10_000) + 0.5) / 10_000))
    np.testing.assert_allclose(many.quantiles([0.1, 0.9]), stats.norm.ppf([0.1, 0.9]), atol=1e-3)
    for levels in ([1.5], [], [np.nan]):
        with pytest.raises(InputError, match="levels of quantiles are"):
            population.quantiles(levels)
    for summary in ("mean", "variance", "covariance", "quantiles", "circular_mean"):
        with pytest.raises(InputError, match="particles of type tuple have no moments") as raised:
            getattr(Population(("a", "b")), summary)()
        assert "give a function" in raised.value.hints[0]
    assert Population(("a", "bb"), np.log([1, 3])).mean(lambda p: np.array([len(s) for s in p])) == 1.75


def test_angles_are_averaged_on_the_circle():
    """Against scipy, which has no weights: integer weights are repetitions."""
    angles, counts = np.array([3.0, -3.0, 2.5, -2.9]), np.array([3, 1, 2, 4])
    population = Population(angles, np.log(counts))
    repeated = stats.circmean(np.repeat(angles, counts), high=np.pi, low=-np.pi)
    assert population.circular_mean() == pytest.approx(repeated)
    degrees = Population(np.degrees(angles), np.log(counts)).circular_mean(period=360.0)
    assert degrees == pytest.approx(np.degrees(repeated))
    turned = Population(angles + np.array([0, 2, -4, 6]) * np.pi, np.log(counts))
    assert turned.circular_mean() == pytest.approx(repeated)
    both = Population({"heading": angles, "x": angles}, np.log(counts)).circular_mean(lambda p: p["heading"])
    assert both == pytest.approx(repeated)


F, Q, H, R, M0, P0 = (
    np.array([[0.9, 0.2], [0.0, 0.8]]),
    np.eye(2) * 0.3,
    np.eye(2),
    np.eye(2) * 0.5,
    np.zeros(2),
    np.eye(2),
)


def test_collectors_against_the_kalman_filter():
    """Means, variances and quantiles of 20 runs with 2000 particles: |z| < 4 for the mean over time."""
    model = linear_gaussian(F, Q, H, R, M0, P0)
    _, ys = model.simulate(8, 3)
    exact = kalman_filter(F, Q, H, R, M0, P0, ys)
    sd = np.sqrt(np.diagonal(exact.covariances, axis1=1, axis2=2))
    runs = run_many(
        bootstrap(model, 2000), ys, range(20), mean=mean, var=variance, cov=covariance, band=quantiles(0.1, 0.9)
    )
    assert runs["band"].shape == (20, 8, 2, 2) and runs.levels == {"band": (0.1, 0.9)}
    edges = exact.means[:, None] + np.array([[-1.0], [1.0]]) * stats.norm.ppf(0.9) * sd[:, None]
    for name, truth in (("mean", exact.means), ("var", sd**2), ("cov", exact.covariances), ("band", edges)):
        error = (runs[name] - truth).reshape(20, -1).mean(axis=1)
        assert abs(error.mean()) < 4 * error.std(ddof=1) / np.sqrt(20) + 2e-3, name


def program(previous, y):
    x = sample("x", Normal(np.zeros((1, 2)) if previous is None else previous["x"], 0.5))
    angle = sample("angle", Normal(0.0 if previous is None else previous["angle"], 0.1))
    observe("y", Normal(x, 1.0), y)
    observe("level", Normal(angle, 1.0), 0.1)


FILTER = Program(program).bootstrap(50)
_, PROGRAM_YS = Program(program).simulate(6, 1)


def test_a_collector_of_a_mapping_gives_an_array_for_each_variable():
    """In single runs and in sweeps; the levels of quantiles belong to each."""
    history = collect(FILTER.iterate(PROGRAM_YS), mean=mean, q=quantiles(), a=circular_mean)
    shapes = {name: history[name].shape for name in history}
    assert shapes == {
        **{"mean_x": (6, 2), "mean_angle": (6,), "q_x": (6, 3, 2), "q_angle": (6, 3)},
        **{"a_x": (6, 2), "a_angle": (6,)},
    }
    assert history.levels == {"q_x": (0.05, 0.5, 0.95), "q_angle": (0.05, 0.5, 0.95)}
    np.testing.assert_array_equal(history["mean_x"][-1], history.state.population.mean()["x"])
    for together in (True, False):
        runs = run_many(FILTER, PROGRAM_YS, range(3), mean=mean, q=quantiles(), together=together)
        assert {name: runs[name].shape for name in runs} == {
            **{"mean_x": (3, 6, 2), "mean_angle": (3, 6), "q_x": (3, 6, 3, 2), "q_angle": (3, 6, 3)}
        }
    np.testing.assert_array_equal(runs["mean_x"][0], history["mean_x"])
    assert runs.to_xarray()["q_angle"].sel(q_angle_level=0.5).shape == (3, 6)


def test_a_lost_run_leaves_nan_in_the_variables_of_mappings():
    """One run is lost at its first step, where no collector was called."""

    def model(previous, y):
        x = sample("x", Normal(0.0, 1.0))
        observe("positive", Uniform(0.0, 1.0), np.where(x > 0.0, 0.5, 2.0))

    runs = run_many(Program(model).bootstrap(1), [None] * 3, range(12), mean=mean, together=False)
    first = [seed for seed, why in runs.lost.items() if why.startswith("step 0")]
    assert first and len(first) < 12
    assert np.isnan(runs["mean_x"][first]).all() and runs["mean_x"].shape == (12, 3)


def test_tables():
    history = collect(FILTER.iterate(PROGRAM_YS), mean=mean, q=quantiles())
    frame = history.to_pandas()
    assert len(frame) == 6 and list(frame)[:4] == ["time", "mean_x_0", "mean_x_1", "mean_angle"]
    population = history.state.population
    table = population.to_pandas()
    assert list(table) == ["x_0", "x_1", "angle", "weight"] and table["weight"].sum() == pytest.approx(1.0)
    assert (table["angle"] * table["weight"]).sum() == pytest.approx(population.mean()["angle"])


@pytest.mark.parametrize("library", ["pandas", "arviz", "xarray"])
def test_a_missing_library_is_named(library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    history = collect(bootstrap(AR1, 5).iterate([0.1]), x=particles, weights=weights)
    export = {"pandas": history.to_pandas, "arviz": history.to_arviz, "xarray": history.to_xarray}[library]
    with pytest.raises(MissingLibraryError, match=f"this export needs {library}"):
        export()


class FakeArviz:
    """Stands for ArviZ, which the tests do not install: keeps what it is given."""

    def __init__(self, version):
        self.__version__ = version

    def from_dict(self, groups=None, coords=None, dims=None, **named):
        assert (groups is None) == (self.__version__[0] == "0")
        return {**(groups or named), "coords": coords, "dims": dims}


@pytest.mark.parametrize("version", ["0.23.4", "1.1.0"])
def test_draws_for_arviz_are_selected_by_weight(version, monkeypatch):
    """Counts of each particle are floor or ceil of n W; all particles with their weights on demand."""
    monkeypatch.setitem(sys.modules, "arviz", FakeArviz(version))
    population = Population(np.arange(40.0), LOG_W)
    drawn = population.to_arviz()
    counts = np.bincount(drawn["posterior"]["x"][0].astype(int), minlength=40)
    assert counts.sum() == 40 and (abs(counts - 40 * W) < 1).all()
    np.testing.assert_allclose(drawn["sample_stats"]["weight"], 1 / 40)
    whole = population.to_arviz(resample=False)
    np.testing.assert_array_equal(whole["posterior"]["x"], [np.arange(40.0)])
    np.testing.assert_allclose(whole["sample_stats"]["weight"], [W])
    history = collect(FILTER.iterate(PROGRAM_YS), p=particles, weights=weights, mean=mean)
    found = history.to_arviz()
    assert {name: a.shape for name, a in found["posterior"].items()} == {"p_x": (1, 50, 6, 2), "p_angle": (1, 50, 6)}
    assert found["dims"]["p_x"] == ["time", "p_x_0"] and found["sample_stats"]["weight"].shape == (1, 50, 6)
    np.testing.assert_allclose(found["posterior"]["p_angle"][0].mean(axis=0), history["mean_angle"], atol=0.02)
    kept = history.to_arviz(resample=False)
    means = (kept["posterior"]["p_angle"] * kept["sample_stats"]["weight"])[0].sum(axis=0)
    np.testing.assert_allclose(means, history["mean_angle"])
    with pytest.raises(InputError, match="no 'weights' of one run"):
        collect(FILTER.iterate(PROGRAM_YS), mean=mean).to_arviz()


def lines(axis):
    return [line.get_ydata() for line in axis.get_lines()]


def test_a_history_plots_the_band_that_was_collected():
    ys = ar1_observations(12)
    history = collect(bootstrap(AR1, 100).iterate(ys), x=quantiles(0.1, 0.5, 0.9), ess=ess)
    truth = [None, *range(11)]
    figure = history.plot(band=0.8, x=truth)
    assert [axis.get_ylabel() for axis in figure.axes] == ["x", "ess"]
    median, points = lines(figure.axes[0])
    np.testing.assert_array_equal(median, history["x"][:, 1])
    np.testing.assert_array_equal(points[1:], np.arange(11))
    (band,) = [c for c in figure.axes[0].collections if isinstance(c, FillBetweenPolyCollection)]
    edges = band.get_paths()[0].vertices
    at = {t: sorted({y for u, y in edges if u == t}) for t in range(1, 11)}
    assert all(at[t] == sorted(history["x"][t, [0, 2]]) for t in at)
    assert not figure.axes[1].collections
    with pytest.raises(
        InputError, match="the quantile 0.05 of 'x' was not collected, there are 0.1, 0.5, 0.9"
    ) as raised:
        history.plot()
    assert raised.value.hints == ("collect x=quantiles(0.05, 0.5, 0.95)",)
    for wrong, message in (
        ({"band": 1.0}, "band is 1.0"),
        ({"band": 0.8, "z": truth}, "no collected values 'z'"),
        ({"band": 0.8, "x": [1.0]}, r"true values of 'x' have shape \(1,\), expected \(12,\)"),
    ):
        with pytest.raises(InputError, match=message):
            history.plot(**wrong)


def test_runs_plot_the_spread_over_seeds():
    ys = ar1_observations(6)
    arms = {"few": bootstrap(AR1, 10), "many": bootstrap(AR1, 100)}
    runs = run_many(arms, ys, range(9), log_evidence=log_evidence, x=quantiles(), mean=mean)
    figure = runs.plot(band=0.5)
    assert [axis.get_ylabel() for axis in figure.axes] == ["log_evidence", "x", "mean"]
    np.testing.assert_allclose(lines(figure.axes[0]), np.median(runs["log_evidence"], axis=1))
    np.testing.assert_allclose(lines(figure.axes[1]), np.median(runs["x"][..., 1], axis=1))
    assert len(figure.axes[2].collections) == 2
    assert "9 seeds" in figure.axes[0].get_title(loc="left") + figure.axes[0].get_title()
    assert run_many(arms["few"], ys, range(3)).plot().axes[0].get_legend() is None
    program = collect(FILTER.iterate(PROGRAM_YS), mean=mean).plot()
    assert [axis.get_ylabel() for axis in program.axes] == ["mean_x[0]", "mean_x[1]", "mean_angle"]
    with pytest.raises(InputError, match="no values to plot"):
        collect([]).plot()


def test_lost_runs_are_left_out_of_a_band():
    model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(x, 1.0), lambda x: Uniform(x - 1.0, x + 1.0))
    runs = run_many(bootstrap(model, 2), [0.1, 0.3, -0.2], range(30), log_evidence=log_evidence)
    assert 0 < len(runs.lost) < 30
    (median,) = lines(runs.plot().axes[0])
    finite = np.where(np.isfinite(runs["log_evidence"]), runs["log_evidence"], np.nan)
    np.testing.assert_allclose(median, np.nanmedian(finite, axis=0))


def test_filters_are_compared_by_their_errors():
    """The differences are those of `compare_arms` on the mean squared errors, by seed; statement and figure."""
    model = linear_gaussian(F, Q, H, R, M0, P0)
    _, ys = model.simulate(5, 0)
    exact = kalman_filter(F, Q, H, R, M0, P0, ys)
    arms = {"few": bootstrap(model, 10), "many": bootstrap(model, 500), "plain": bootstrap(model, 10, Multinomial())}
    runs = run_many(arms, ys, range(25), mean=mean, log_evidence=log_evidence)
    found = runs.compare("few", mean=exact.means)
    errors = ((runs["mean"] - exact.means) ** 2).mean(axis=(2, 3))
    assert (
        found
        == compare_arms(dict(zip(arms, errors, strict=True)), "few")
        == compare_runs(runs, "few", mean=exact.means)
    )
    assert found["many"].is_claim and found["many"].mean < 0
    said = str(found).splitlines()
    assert said[0].startswith("many is below few on the squared error of mean (-") and len(said) == 2
    figure = plot_differences(found)
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["many", "plain"]
    assert "squared error of mean, minus few" in figure.axes[0].get_xlabel()
    centres = [container[0].get_xdata()[0] for container in figure.axes[0].containers]
    np.testing.assert_allclose(centres, [d.mean for d in found.values()])
    assert found.plot().axes[0].get_xlabel() == figure.axes[0].get_xlabel()
    last = runs.compare("few", log_evidence=exact.log_evidence)
    assert last["many"].mean < 0
    for call, message in (
        (lambda: runs.compare("few"), "0 exact quantities"),
        (lambda: runs.compare("few", mean=exact.means[:2]), r"have shape \(2, 2\), expected \(5, 2\)"),
        (lambda: runs.compare("none", mean=exact.means), "no arm 'none'"),
        (lambda: run_many(arms["few"], ys, range(3)).compare("few", log_evidence=[0.0]), "axes seed, time"),
        (lambda: plot_differences({}), "no differences to plot"),
    ):
        with pytest.raises(InputError, match=message):
            call()
