"""Light distributions against scipy.stats; adapters; layout of rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.special import gammaln, i0e, i1e, xlogy

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Bernoulli,
    Beta,
    Binomial,
    Categorical,
    Dirichlet,
    Gamma,
    LogNormal,
    Mixture,
    MultivariateNormal,
    Normal,
    Poisson,
    Product,
    StateSpaceModel,
    Student,
    Truncated,
    Uniform,
    VonMises,
    as_distribution,
    bootstrap,
)

COV = np.array([[2.0, 0.6], [0.6, 0.5]])
CASES = [
    (Normal(0.3, 2.0), stats.norm(0.3, 2.0)),
    (Student(4.0, -1.0, 0.5), stats.t(4.0, -1.0, 0.5)),
    (Uniform(-1.0, 2.5), stats.uniform(-1.0, 3.5)),
    (Bernoulli(0.3), stats.bernoulli(0.3)),
    (Categorical([0.2, 0.0, 0.5, 0.3]), stats.rv_discrete(values=(np.arange(4), [0.2, 0.0, 0.5, 0.3]))),
    (Gamma(2.5, 0.7), stats.gamma(2.5, scale=0.7)),
    (Gamma(0.3), stats.gamma(0.3)),
    (LogNormal(0.2, 0.6), stats.lognorm(0.6, scale=np.exp(0.2))),
    (Beta(2.0, 0.7), stats.beta(2.0, 0.7)),
    (Poisson(2.5), stats.poisson(2.5)),
    (Binomial(7, 0.3), stats.binom(7, 0.3)),
    (Truncated(Normal(0.5, 1.0), -0.2, 2.2), stats.truncnorm(-0.7, 1.7, 0.5, 1.0)),
    (Truncated(Normal(), 9.0, 9.5), stats.truncnorm(9.0, 9.5)),
    (Truncated(Normal(), -9.5, -9.0), stats.truncnorm(-9.5, -9.0)),
    (Truncated(stats.expon(scale=2.0), 0.5), stats.expon(0.5, 2.0)),
    (
        Mixture([1, 3], [Categorical([1.0]), Binomial(3, 0.5)]),
        stats.rv_discrete(values=(np.arange(4), [0.25 + 3 / 32, 9 / 32, 9 / 32, 3 / 32])),
    ),
]
IDS = [type(ours).__name__ for ours, _ in CASES]


@pytest.mark.parametrize(("ours", "theirs"), CASES, ids=IDS)
def test_log_prob_is_that_of_scipy(ours, theirs):
    values = np.concatenate([[-2.0, -1.0, 0.0, 0.4, 1.0, 2.0, 3.0, 40.0], np.linspace(-1, 5, 13)])
    if ours.discrete:
        values = np.floor(values)
        expected = theirs.logpmf(values)
    else:
        values = values[(values != 2.5) & (values != 0.0)]  # ends of a support: a matter of convention
        expected = theirs.logpdf(values)
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(ours.log_prob(values), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", [np.uint8, np.int8, np.uint16, np.int64])
def test_integer_parameters_and_values_are_real_numbers(kind):
    """Against scipy: integers of few bits must neither wrap nor get logarithms of few digits."""
    a, b, x = (np.array(v, dtype=kind) for v in ([3, 100, 7], [5, 120, 90], [1, 90, 100]))
    large = np.full((1, 300), 1 / 300)
    for ours, theirs in (
        (Normal(a, b), stats.norm(a.astype(float), b.astype(float))),
        (Normal(a, 2.0), stats.norm(a.astype(float), 2.0)),
        (Normal(5, 120), stats.norm(5, 120)),
        (Normal(kind(5), kind(120)), stats.norm(5, 120)),
        (Student(a, b, a), stats.t(a.astype(float), b.astype(float), a.astype(float))),
        (Uniform(a, b), stats.uniform(a.astype(float), (b - a).astype(float))),
        (Bernoulli(np.array([1, 0, 1], kind)), stats.bernoulli([1, 0, 1])),
        (Categorical(large), stats.randint(0, 300)),
    ):
        expected = theirs.logpmf(x) if ours.discrete else theirs.logpdf(x.astype(float))
        np.testing.assert_allclose(ours.log_prob(x), expected, rtol=1e-12, err_msg=repr(ours))
        assert ours.sample(np.random.default_rng(0), 3).dtype.kind in "fib"
    np.testing.assert_allclose(Normal(a, 2.0).log_prob(300), stats.norm(a.astype(float), 2.0).logpdf(300))
    wide = Uniform(np.array([-100, 0], np.int8), np.array([100, 120], np.int8))
    np.testing.assert_allclose(wide.log_prob([50.0, 50.0]), -np.log([200.0, 120.0]))
    np.testing.assert_allclose(wide.mean, [0.0, 60.0])
    assert (np.abs(wide.sample(np.random.default_rng(0), 2)) <= 120).all()


@pytest.mark.parametrize(("ours", "theirs"), CASES, ids=IDS)
def test_draws_have_the_law(ours, theirs):
    """Kolmogorov-Smirnov, or chi-square for discrete ones, at a false-alarm rate of 1e-4."""
    x = ours.sample(np.random.default_rng(5), 4000)
    assert x.shape == (4000,)
    if not ours.discrete:
        assert stats.kstest(x, theirs.cdf).pvalue > 1e-4
    else:
        counts = np.bincount(x.astype(int), minlength=9)[:9]
        p = np.append(theirs.pmf(np.arange(8)), theirs.sf(7))
        counts[8] = len(x) - counts[:8].sum()
        assert counts[p == 0].sum() == 0
        assert stats.chisquare(counts[p > 0], len(x) * p[p > 0]).pvalue > 1e-4
    if not isinstance(ours, Student):
        np.testing.assert_allclose(ours.mean, theirs.mean())


@pytest.mark.parametrize("concentration", [0.0, 1e-3, 0.5, 30.0])
def test_angles(concentration):
    """Density against scipy, anywhere on the line; draws by their mean cosine, which is I_1 / I_0 (5 sd)."""
    ours, theirs = VonMises(3.0, concentration), stats.vonmises(max(concentration, 1e-12), 3.0)
    x = np.linspace(-9, 9, 31)
    np.testing.assert_allclose(ours.log_prob(x), theirs.logpdf(x), rtol=1e-9)
    np.testing.assert_allclose(ours.log_prob(x), ours.log_prob(x + 2 * np.pi), rtol=1e-9)
    drawn = np.cos(ours.sample(np.random.default_rng(0), 20_000) - 3.0)
    assert abs(drawn.mean() - i1e(concentration) / i0e(concentration)) < 5 * drawn.std() / np.sqrt(20_000)
    assert float(ours.mean) == 3.0


@pytest.mark.parametrize("a", [[0.5, 2.0, 3.0], [0.02, 0.05, 0.01]])
def test_shares(a):
    """Against scipy and the exact mean and variance, also where Gamma variates of these shapes underflow (5 sd)."""
    ours, x = Dirichlet(a), Dirichlet(a).sample(np.random.default_rng(0), 20_000)
    inner = x[(x > 1e-290).all(axis=1)][:50]
    np.testing.assert_allclose(ours.log_prob(inner), stats.dirichlet(a).logpdf(inner.T / inner.sum(axis=1)))
    mean, variance = stats.dirichlet(a).mean(), stats.dirichlet(a).var()
    np.testing.assert_allclose(ours.mean, [mean])
    assert (abs(x.mean(axis=0) - mean) < 5 * np.sqrt(variance / 20_000)).all()
    np.testing.assert_allclose(x.var(axis=0), variance, rtol=0.1)
    assert ours.log_prob([0.5, 0.5, 0.5]) == ours.log_prob([1.5, -0.25, -0.25]) == -INF
    rows = Dirichlet(np.stack([a, a[::-1]]))
    np.testing.assert_allclose(rows.log_prob([0.2, 0.3, 0.5])[0], ours.log_prob([0.2, 0.3, 0.5]))


def test_truncated_rows_and_boxes():
    """Rows with bounds of their own against truncnorm; a box; counts above zero; NaN where nothing is left."""
    x, low = np.linspace(-3, 3, 7), np.linspace(-4, 5, 7)
    ours = Truncated(Normal(x, 2.0), low, low + 1.0)
    values = ours.sample(np.random.default_rng(1), 7)
    theirs = stats.truncnorm((low - x) / 2, (low + 1 - x) / 2, x, 2.0)
    np.testing.assert_allclose(ours.log_prob(values), theirs.logpdf(values))
    np.testing.assert_allclose(ours.mean, theirs.mean(), rtol=1e-6)
    box = Truncated(Normal(np.zeros((1, 2)), 1.0), low=[[0.0, -1.0]], high=np.array([[INF, 1.0]]))
    inside = box.sample(np.random.default_rng(2), 500)
    assert (inside[:, 0] >= 0).all() and (abs(inside[:, 1]) <= 1).all()
    mass = 0.5 * (2 * stats.norm.cdf(1) - 1)
    np.testing.assert_allclose(box.log_prob(inside), stats.norm.logpdf(inside).sum(axis=1) - np.log(mass))
    assert box.log_prob([-0.1, 0.0])[0] == -INF
    seen = Truncated(Poisson(np.array([0.1, 3.0])), low=1)
    np.testing.assert_allclose(np.exp([seen.log_prob(k) for k in range(40)]).sum(axis=0), 1.0)
    np.testing.assert_allclose(seen.mean, np.array([0.1, 3.0]) / -np.expm1([-0.1, -3.0]))
    assert (seen.sample(np.random.default_rng(3), 2) >= 1).all() and np.isneginf(seen.log_prob(0)).all()
    nothing = Truncated(Normal(np.array([0.0, 1.0]), 0.1), 8.0, 9.0)
    assert np.isnan(nothing.log_prob(8.5)).all()
    with pytest.raises(InputError, match="no probability between 8.0 and 9.0 in row 0 .2 of 2."):
        nothing.sample(np.random.default_rng(0), 2)
    with pytest.raises(InputError, match="a VonMises cannot be truncated"):
        Truncated(VonMises(), 0.0, 1.0)


def test_mixtures():
    """Law of a continuous mixture by its distribution function; weights by row; vectors; scipy parts; errors."""
    ours = Mixture([0.3, 0.7], [Normal(-1.0, 0.5), stats.expon()])
    x = ours.sample(np.random.default_rng(0), 4000)
    assert stats.kstest(x, lambda v: 0.3 * stats.norm.cdf(v, -1.0, 0.5) + 0.7 * stats.expon.cdf(v)).pvalue > 1e-4
    expected = np.log(0.3 * stats.norm.pdf(x, -1.0, 0.5) + 0.7 * stats.expon.pdf(x))
    np.testing.assert_allclose(ours.log_prob(x), expected)
    assert float(ours.mean) == pytest.approx(0.4)
    rows = Mixture([[1.0, 0.0], [0.5, 0.5]], [Normal(np.array([0.0, 1.0]), 1.0), Normal(5.0, 1.0)])
    np.testing.assert_allclose(rows.mean, [0.0, 3.0])
    np.testing.assert_allclose(rows.log_prob(0.5)[0], stats.norm.logpdf(0.5))
    vectors = Mixture([1, 1], [MultivariateNormal([0.0, 0.0], COV), MultivariateNormal([4.0, 0.0], COV)])
    assert vectors.sample(np.random.default_rng(0), 6).shape == (6, 2) and vectors.parameter_shape == (1, 2)
    np.testing.assert_allclose(vectors.mean, [[2.0, 0.0]])
    both = [stats.multivariate_normal(m, COV).pdf([1.0, 0.2]) for m in ([0.0, 0.0], [4.0, 0.0])]
    np.testing.assert_allclose(vectors.log_prob([1.0, 0.2]), np.log(np.mean(both)))
    for weights, parts in (([1.0], [Normal(), Normal()]), ([1, 1], [Normal(), Poisson(1.0)])):
        with pytest.raises(InputError, match="expected as many weights, and components of one kind"):
            Mixture(weights, parts)


def test_products():
    """Entries of a vector have the sum of the log densities."""
    vector = Product([Normal(0.0, 1.0), Gamma(2.0)])
    values = vector.sample(np.random.default_rng(0), 5)
    assert (values.shape, vector.event_shape, vector.value_shape(5)) == ((5, 2), (2,), (5, 2))
    both = stats.norm.logpdf(values[:, 0]) + stats.gamma.logpdf(values[:, 1], 2.0)
    np.testing.assert_allclose(vector.log_prob(values), both)
    np.testing.assert_allclose(vector.log_prob(values[0]), both[0])
    np.testing.assert_allclose(vector.mean, [[0.0, 2.0]])
    with pytest.raises(InputError, match="give vectors a name"):
        Product([Dirichlet([1.0, 1.0])])


def test_gaussian_vectors():
    rng = np.random.default_rng(1)
    shared = MultivariateNormal([1.0, -1.0], COV)
    x = shared.sample(rng, 20000)
    np.testing.assert_allclose(x.mean(axis=0), [1, -1], atol=0.06)
    np.testing.assert_allclose(np.cov(x.T), COV, atol=0.08)
    expected = stats.multivariate_normal([1.0, -1.0], COV).logpdf(x[:50])
    np.testing.assert_allclose(shared.log_prob(x[:50]), expected)
    each = MultivariateNormal(np.tile([1.0, -1.0], (50, 1)), np.tile(COV, (50, 1, 1)))
    np.testing.assert_allclose(each.log_prob(x[:50]), expected)
    np.testing.assert_allclose(each.log_prob(x[0]), np.full(50, expected[0]))
    np.testing.assert_allclose(
        MultivariateNormal(x[:50], COV).log_prob(np.zeros(2)),
        [stats.multivariate_normal(m, COV).logpdf(np.zeros(2)) for m in x[:50]],
    )


def test_categorical_rows():
    """Each row by its own probabilities: the residual of a category sums to nearly 0 (5 standard deviations)."""
    rng = np.random.default_rng(0)
    p = rng.dirichlet([1, 1, 1], size=6000)
    k = Categorical(p).sample(rng, 6000)
    np.testing.assert_allclose(np.exp(Categorical(p).log_prob(k)), p[np.arange(6000), k])
    for j in range(3):
        assert abs(((k == j) - p[:, j]).sum()) < 5 * np.sqrt((p[:, j] * (1 - p[:, j])).sum())


@pytest.mark.parametrize(
    ("distribution", "batch", "event"),
    [
        (Normal(0.0, 1.0), (), ()),
        (Normal(np.zeros(5), 1.0), (5,), ()),
        (Normal(np.zeros((1, 3)), np.ones(3)), (1,), (3,)),
        (Student(np.ones((5, 1)), np.ones((5, 2))), (5,), (2,)),
        (Uniform(np.zeros((5, 2, 2)), 1.0), (5,), (2, 2)),
        (Categorical([0.5, 0.5]), (), ()),
        (Categorical(np.ones((5, 3))), (5,), ()),
        (MultivariateNormal([0.0, 0.0], COV), (1,), (2,)),
        (MultivariateNormal(0.0, COV), (1,), (2,)),
        (MultivariateNormal(np.zeros((5, 2)), COV), (5,), (2,)),
        (MultivariateNormal([0.0, 0.0], np.tile(COV, (5, 1, 1))), (5,), (2,)),
        (Gamma(np.ones(5), 2.0), (5,), ()),
        (Beta(np.ones((1, 3)), np.ones((5, 3))), (5,), (3,)),
        (Poisson(np.ones(5)), (5,), ()),
        (Binomial(3, np.full(5, 0.5)), (5,), ()),
        (LogNormal(np.zeros((5, 1))), (5,), (1,)),
        (VonMises(np.zeros(5), 2.0), (5,), ()),
        (Dirichlet([1.0, 2.0]), (1,), (2,)),
        (Dirichlet(np.ones((5, 2))), (5,), (2,)),
        (Truncated(Normal(), np.linspace(-3, 0, 5), 1.0), (5,), ()),
        (Truncated(Normal(np.zeros((5, 2))), 0.0), (5,), (2,)),
        (Mixture(np.ones((5, 2)), [Normal(), Normal(1.0)]), (5,), ()),
        (Mixture([1, 2], [Normal(np.zeros((5, 2))), Student(np.ones((1, 2)))]), (5,), (2,)),
        (Product([Normal(), Gamma(np.ones(5))]), (5,), (2,)),
        (Product([Normal(), Gamma(1.0)]), (1,), (2,)),
        (as_distribution(stats.norm(np.zeros((5, 2)), 1.0)), (5,), (2,)),
        (as_distribution(stats.rv_discrete(values=([0, 1], [0.5, 0.5]))), (), ()),
        (as_distribution(stats.multivariate_normal([0.0, 1.0], COV)), (1,), (2,)),
        (as_distribution(stats.multivariate_normal(0.0, 1.0)), (1,), (1,)),
        (as_distribution(stats.multinomial(4, [0.5, 0.2, 0.3])), (1,), (3,)),
        (as_distribution(stats.dirichlet([1.0, 2.0])), (1,), (2,)),
        (as_distribution(stats.wishart(4, COV)), (1,), (2, 2)),
        (as_distribution(stats.multivariate_t([0.0, 1.0], COV, df=5)), (1,), (2,)),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, tuple) else str(value),
)
def test_shapes_of_batch_and_event(distribution, batch, event):
    assert (distribution.parameter_shape, distribution.event_shape) == ((*batch, *event), event)
    values = distribution.sample(np.random.default_rng(0), 5)
    assert values.shape == distribution.value_shape(5) == (5, *event)
    assert distribution.log_prob(values).shape == (5,)
    for row in (0, 3):  # the log density of a row is that of the same value alone
        alone = np.broadcast_to(distribution.log_prob(values[row]), 5)
        np.testing.assert_allclose(distribution.log_prob(values)[row], alone[row])
    if batch == (5,):
        with pytest.raises(InputError, match=r"do not fit 4 particles"):
            distribution.value_shape(4)


NAN, INF = np.nan, np.inf
BAD_COV = np.array([[1.0, 2.0], [2.0, 1.0]])


def with_row(good, bad, row=2):
    """An array whose rows are `good`, but one."""
    rows = np.stack([np.asarray(good, np.float64)] * 4)
    rows[row] = bad
    return rows


@pytest.mark.parametrize(
    ("make", "named", "value"),
    [
        *[(lambda v: Normal(with_row(0.0, v), 1.0), "loc of a Normal", v) for v in (NAN, INF, -INF)],
        *[(lambda v: Normal(0.0, with_row(1.0, v)), "scale of a Normal", v) for v in (0.0, -1.0, NAN, INF)],
        (lambda v: Normal(with_row([0.0, 1.0], [0.0, v]), 1.0), "loc of a Normal", NAN),
        (lambda v: Normal(np.float32(with_row(0.0, v)), 1.0), "loc of a Normal", NAN),
        *[(lambda v: Student(with_row(3.0, v)), "df of a Student", v) for v in (0.0, -1.0, NAN)],
        (lambda v: Student(3.0, 0.0, with_row(3.0, v)), "scale of a Student", -0.5),
        *[(lambda v: Uniform(with_row(0.0, v), 1.0), "of a Uniform", v) for v in (1.0, 1.5, NAN)],
        *[(lambda v: Uniform(0.0, with_row(1.0, v)), "high of a Uniform", v) for v in (0.0, -1.0, NAN, INF)],
        *[(lambda v: Bernoulli(with_row(0.5, v)), "p of a Bernoulli", v) for v in (-0.1, 1.1, NAN)],
        *[(lambda v: Categorical(with_row([0.5, 0.5], [0.5, v])), "categorical", v) for v in (-0.1, NAN, INF)],
        (lambda v: Categorical(with_row([0.5, 0.5], v)), "categorical", 0.0),
        (lambda v: MultivariateNormal(with_row([0.0, 0.0], v), COV), "loc of a MultivariateNormal", NAN),
        (lambda v: MultivariateNormal([0.0, 0.0], with_row(COV, v)), "not positive definite", BAD_COV),
        (lambda v: MultivariateNormal([0.0, 0.0], with_row(COV, v)), "not symmetric", [[1.0, 0.5], [0.0, 1.0]]),
        (lambda v: MultivariateNormal([0.0, 0.0], with_row(COV, v)), "covariance", NAN),
        *[(lambda v: Gamma(with_row(1.0, v)), "shape of a Gamma", v) for v in (0.0, -1.0, NAN, INF)],
        (lambda v: Gamma(1.0, with_row(1.0, v)), "scale of a Gamma", -2.0),
        (lambda v: LogNormal(0.0, with_row(1.0, v)), "scale of a", -2.0),
        (lambda v: Beta(with_row(2.0, v), 1.0), "a of a Beta", NAN),
        *[(lambda v: Poisson(with_row(2.0, v)), "rate of a Poisson", v) for v in (-1.0, NAN, INF)],
        *[(lambda v: Binomial(with_row(2.0, v), 0.5), "n of a Binomial", v) for v in (1.5, -1.0, NAN)],
        (lambda v: Binomial(2, with_row(0.5, v)), "p of a Binomial", 1.1),
        (lambda v: VonMises(0.0, with_row(2.0, v)), "concentration of a VonMises", -1.0),
        (lambda v: Dirichlet(with_row([1.0, 1.0], v)), "concentration of a Dirichlet", 0.0),
        (lambda v: Truncated(Normal(0.0, with_row(1.0, v)), -1.0), "scale of a Normal", -1.0),
        (lambda v: Mixture([1, 1], [Normal(), Normal(with_row(1.0, v))]), "loc of a Normal", NAN),
    ],
)
def test_a_parameter_out_of_range_names_its_row(make, named, value):
    with pytest.raises(InputError, match=named + ".* in row 2"):
        make(value).check_parameters()
    with pytest.raises(InputError, match=named + ".* in row 2"):
        make(value).sample(np.random.default_rng(0), 4)
    d = make(value)  # as in a move: that row has no density, the others are as they were
    drawn = np.zeros(d.value_shape(4), dtype=int)
    with np.errstate(all="ignore"):
        log_prob = np.broadcast_to(d.log_prob(drawn), 4)
    assert not log_prob[2] > -INF
    assert (~np.isnan(log_prob[[0, 1, 3]])).all()


@pytest.mark.parametrize("value", [0.0, -1.0, NAN, INF, None, "a", 1j])
def test_a_number_out_of_range(value):
    for make in (lambda v: Normal(0.0, v), lambda v: Student(v), lambda v: Uniform(0.0, v)):
        with pytest.raises(InputError, match="of a (Normal|Student|Uniform) is"):
            make(value)
    with pytest.raises(InputError, match="p of a Bernoulli is 1.5, expected a probability"):
        Bernoulli(1.5)
    for make, message in (
        (lambda: Categorical([0.0, 0.0]), "categorical"),
        (lambda: MultivariateNormal([0.0, 0.0], [[1.0, 0.5], [0.0, 1.0]]), "not symmetric"),
        (lambda: MultivariateNormal([0.0, 0.0], BAD_COV), "positive definite"),
    ):
        with pytest.raises(InputError, match=message):
            make()


def test_large_parameters_and_integers_are_in_range():
    huge = np.array([1e200, -1e300])  # the sum of their squares overflows
    assert Normal(huge, 1.0).sample(np.random.default_rng(0), 2).shape == (2,)
    for d in (Normal(0, 1), Normal(np.arange(3), np.arange(1, 4)), Uniform(0, 2), Bernoulli(1)):
        assert np.isfinite(d.sample(np.random.default_rng(0), 3)).all()
    assert Normal(np.zeros(0), np.zeros(0)).sample(np.random.default_rng(0), 0).shape == (0,)


@pytest.mark.parametrize(("ours", "theirs"), CASES, ids=IDS)
def test_a_value_of_nan_has_no_density(ours, theirs):
    with np.errstate(all="ignore"):
        assert np.isnan(ours.log_prob(np.array([NAN, 1.0]))[0])


def test_parameters_that_do_not_fit_together():
    with pytest.raises(InputError, match=r"shapes \(4, 2\) and \(4,\) do not fit together"):
        Normal(np.zeros((4, 2)), np.ones(4)).sample(np.random.default_rng(0), 4)
    for shapes in (((4, 1), (4,)), ((4,), (4, 1))):  # numpy would make (4, 4)
        with pytest.raises(InputError, match="do not fit together"):
            Normal(*map(np.ones, shapes)).sample(np.random.default_rng(0), 4)
    assert Normal(np.zeros((4, 1)), np.ones(3)).event_shape == (3,)
    with pytest.raises(InputError, match=r"mean of shape \(1,\) does not fit a covariance of shape \(2, 2\)"):
        MultivariateNormal([0.0], COV)
    with pytest.raises(InputError, match=r"mean of shape \(4,\) does not fit a covariance of shape \(1, 1\)"):
        MultivariateNormal(np.zeros(4), [[1.0]])


@pytest.mark.parametrize(
    ("loc", "y", "expected"),
    [
        (lambda x: x, np.zeros(5), r"shape \(5,\), expected the event shape \(\)"),
        (lambda x: x, np.zeros((5, 1)), r"shape \(5, 1\), expected the event shape \(\)"),
        (lambda x: np.stack([x, x], axis=1), 0.5, r"shape \(\), expected the event shape \(2,\)"),
        (lambda x: x + x[:, None], 0.5, r"shape \(\), expected the event shape \(5,\)"),
    ],
)
def test_a_state_space_model_compares_an_observation_with_the_event(loc, y, expected):
    model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(x, 1.0), lambda x: Normal(loc(x), 1.0))
    with pytest.raises(InputError, match="step 0, update: the observation has " + expected):
        bootstrap(model, 5).run([y], 0)


def test_log_prob_does_not_write_to_its_argument():
    x = np.linspace(-1, 1, 5)
    kept = x.copy()
    for d in (Normal(0.0, 2.0), Student(3.0), Uniform(-2, 2), MultivariateNormal([0.0], [[1.0]])):
        d.log_prob(x if not isinstance(d, MultivariateNormal) else x[:, None])
        np.testing.assert_array_equal(x, kept)


@pytest.mark.parametrize(
    ("frozen", "log_prob"),
    [
        (stats.norm(1.0, 2.0), Normal(1.0, 2.0).log_prob),
        (stats.poisson(3.0), lambda k: xlogy(k, 3.0) - gammaln(k + 1) - 3.0),
    ],
    ids=["continuous", "discrete"],
)
def test_scipy_distributions(frozen, log_prob):
    d = as_distribution(frozen)
    a, b = (d.sample(np.random.default_rng(3), 3000) for _ in range(2))
    np.testing.assert_array_equal(a, b)
    assert a.shape == (3000,)
    assert abs(a.mean() - float(d.mean)) < 5 * a.std() / np.sqrt(3000)
    np.testing.assert_allclose(d.log_prob(a[:20]), log_prob(a[:20]))


def test_other_things_are_refused():
    with pytest.raises(InputError, match="expected a distribution, found a builtins.float"):
        as_distribution(3.0)


@pytest.mark.parametrize(
    "given",
    [
        stats.multivariate_normal([0.0, 0.0], COV),
        stats.multivariate_t([0.0, 0.0], COV, 5),
        stats.dirichlet([2.0, 3.0]),
    ],
    ids=lambda d: type(d).__name__,
)
def test_vectors_of_scipy_have_one_density_per_row(given):
    ours = as_distribution(given)
    draws = ours.sample(np.random.default_rng(0), 3)
    assert ours.log_prob(draws[:1]).shape == (1,)
    np.testing.assert_allclose(ours.log_prob(draws)[:1], ours.log_prob(draws[:1]))
    assert ours.log_prob(draws[0]).shape == ()
