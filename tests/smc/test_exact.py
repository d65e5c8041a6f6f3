"""Shipped references against independent ones: conditioning of the joint Gaussian, enumeration of paths."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from mstfilter.base.errors import InputError
from mstfilter.smc import bootstrap, forward_backward, hidden_markov, kalman_filter
from tests.smc.models import EMIT, MOVES, START
from tests.smc.test_particle_filter import M0, P0, F, H, Q, R


def joint(Fs, Qs, m0, P0):
    """Mean (T d,) and covariance (T d, T d) of x_0 .. x_{T-1}: x = A (x_0, v_1, ..), with A block triangular."""
    T, d = len(Fs), len(m0)
    A, noise = np.eye(T * d), np.zeros((T * d, T * d))
    for t in range(T):
        rows = slice(t * d, t * d + d)
        noise[rows, rows] = Qs[t] if t else P0
        if t:
            A[rows] += Fs[t] @ A[(t - 1) * d : t * d]
    return (A[:, :d] @ m0), A @ noise @ A.T


def conditioned(Fs, Qs, Hs, Rs, m0, P0, ys, last):
    """Mean and covariance of x_0 .. x_{T-1} given y_0 .. y_last, and their log density."""
    T, d = len(Fs), len(m0)
    mean, cov = joint(Fs, Qs, m0, P0)
    seen = [t for t in range(last + 1) if ys[t] is not None]
    if not seen:
        return mean.reshape(T, d), cov, 0.0
    k = len(Hs[0])
    big = np.zeros((len(seen) * k, T * d))
    noise = np.zeros((len(seen) * k,) * 2)
    for row, t in enumerate(seen):
        big[row * k : row * k + k, t * d : t * d + d] = Hs[t]
        noise[row * k : row * k + k, row * k : row * k + k] = Rs[t]
    S, y = big @ cov @ big.T + noise, np.concatenate([np.atleast_1d(ys[t]) for t in seen])
    gain = cov @ big.T @ np.linalg.inv(S)
    log_p = stats.multivariate_normal(big @ mean, S).logpdf(y)
    return (mean + gain @ (y - big @ mean)).reshape(T, d), cov - gain @ big @ cov, log_p


@pytest.mark.parametrize("missing", [(), (2,), (0, 3, 4)])
@pytest.mark.parametrize("d, k, changing", [(1, 1, False), (2, 1, False), (3, 2, True), (1, 2, True)])
def test_kalman_is_the_conditioned_joint_gaussian(d, k, changing, missing):
    rng, T = np.random.default_rng(10 * d + k), 5

    def covariance(n):
        root = rng.normal(size=(n, n))
        return root @ root.T + 0.1 * np.eye(n)

    Fs, Hs = rng.normal(size=(T, d, d)), rng.normal(size=(T, k, d))
    Qs, Rs = np.stack([covariance(d) for _ in range(T)]), np.stack([covariance(k) for _ in range(T)])
    if not changing:
        Fs[:], Hs[:], Qs[:], Rs[:] = Fs[0], Hs[0], Qs[0], Rs[0]
    m0, P0 = rng.normal(size=d), covariance(d)
    ys = [None if t in missing else rng.normal(size=k) for t in range(T)]
    found = kalman_filter(*((Fs, Qs, Hs, Rs) if changing else (Fs[0], Qs[0], Hs[0], Rs[0])), m0, P0, ys)
    for t in range(T):
        mean, cov, log_p = conditioned(Fs, Qs, Hs, Rs, m0, P0, ys, t)
        block = slice(t * d, t * d + d)
        np.testing.assert_allclose(found.means[t], mean[t], atol=1e-9)
        np.testing.assert_allclose(found.covariances[t], cov[block, block], atol=1e-9)
        assert found.log_evidence[t] == pytest.approx(log_p, abs=1e-9)
    for t in range(T):  # given all observations
        np.testing.assert_allclose(found.smoothed_means[t], mean[t], atol=1e-9)
        block = slice(t * d, t * d + d)
        np.testing.assert_allclose(found.smoothed_covariances[t], cov[block, block], atol=1e-9)


@pytest.mark.parametrize("case", ["full rank", "singular Q and P0", "no noise at first", "exact observations"])
def test_kalman_does_not_depend_on_units(case):
    """The joint Gaussian in even units, and the same model in units that differ by 1e8 for the entries."""
    rng, T, d, ys = np.random.default_rng(5), 6, 3, [0.3, -0.8, None, 1.4, 0.2, -0.1]
    F, H = rng.normal(size=(d, d)) / 2, rng.normal(size=(2, d))
    root = rng.normal(size=(d, 1 if case == "singular Q and P0" else d))
    Q, R, P0 = root @ root.T, 0.1 * np.eye(2), np.diag([1.0, 0.0, 2.0])
    P0 = np.zeros((d, d)) if case == "no noise at first" else P0
    R = np.zeros((2, 2)) if case == "exact observations" else R
    ys = [None if y is None else np.array([y, 1 - y]) for y in ys]
    m0, x, y = rng.normal(size=d), np.array([1e4, 1.0, 1e-4]), np.array([1e3, 1e-5])  # units of state and observation
    xx, yy = np.outer(x, x), np.outer(y, y)
    units = F * np.outer(x, 1 / x), Q * xx, H * np.outer(y, 1 / x), R * yy, x * m0, P0 * xx
    found = kalman_filter(*units, [None if value is None else y * value for value in ys])
    for t in range(T):
        mean, cov, log_p = conditioned(*([a] * T for a in (F, Q, H, R)), m0, P0, ys, t)
        block = slice(t * d, t * d + d)
        np.testing.assert_allclose(found.means[t] / x, mean[t], atol=1e-8)
        np.testing.assert_allclose(found.covariances[t] / xx, cov[block, block], atol=1e-8)
        n = sum(value is not None for value in ys[: t + 1])
        assert found.log_evidence[t] == pytest.approx(log_p - n * np.log(y).sum(), abs=1e-6)
    for t in range(T):
        block = slice(t * d, t * d + d)
        np.testing.assert_allclose(found.smoothed_means[t] / x, mean[t], atol=1e-8)
        np.testing.assert_allclose(found.smoothed_covariances[t] / xx, cov[block, block], atol=1e-8)


def log_emit(y):
    with np.errstate(divide="ignore"):
        return np.log(EMIT[:, y])


def enumerated(start, moves, likelihood, last):
    """(T, K) marginals given y_0 .. y_last and log p(y_0 .. y_last); rows of `likelihood` are p(y_t | x_t)."""
    T, K = likelihood.shape
    paths = np.array(list(product(range(K), repeat=T)))
    p = start[paths[:, 0]] * np.prod([moves[paths[:, t - 1], paths[:, t]] for t in range(1, T)], axis=0)
    p = p * np.prod([likelihood[t, paths[:, t]] for t in range(last + 1)], axis=0)
    return np.stack([np.bincount(paths[:, t], p, K) for t in range(T)]) / p.sum(), np.log(p.sum())


@pytest.mark.parametrize("symbols", [[0, 2, 2, 1, 3, 1], [3, None, 1, 3, None, 0], [None, 3, 0, 2, 1, None]])
def test_forward_backward_is_the_sum_over_paths(symbols):
    likelihood = np.stack([np.ones(3) if y is None else EMIT[:, y] for y in symbols])
    found = forward_backward(START, MOVES, log_emit, symbols)
    for t in range(len(symbols)):
        marginals, log_p = enumerated(START, MOVES, likelihood, t)
        np.testing.assert_allclose(found.filtered[t], marginals[t], atol=1e-12)
        assert found.log_evidence[t] == pytest.approx(log_p, abs=1e-12)
    np.testing.assert_allclose(found.smoothed, marginals, atol=1e-12)


def test_zeros_and_tiny_likelihoods_do_not_underflow():
    """A left-to-right chain, with log likelihoods of -1e4 and a state of overwhelming likelihood out of reach."""
    start, moves = np.array([1.0, 0.0, 0.0]), np.array([[0.5, 0.5, 0.0], [0.0, 0.7, 0.3], [0.0, 0.0, 1.0]])
    table = np.array([[-1e4, 0.0, 5e3], [-1e4, -1e4 - 1, 5e3], [-2.0, -1.0, -3.0], [-np.inf, -1.0, -2.0]])
    found = forward_backward(start, moves, lambda y: table[y], range(4))
    shifted = table - np.array([-1e4, -1e4, 0.0, 0.0])[:, None]
    shifted[0, 1:] = shifted[1, 2] = 0.0  # out of reach: any value
    marginals, log_p = enumerated(start, moves, np.exp(shifted), 3)
    np.testing.assert_allclose(found.smoothed, marginals, atol=1e-12)
    assert found.log_evidence[-1] == pytest.approx(log_p - 2e4, abs=1e-9)
    assert found.filtered[0].tolist() == [1.0, 0.0, 0.0]


def test_a_state_that_is_improbable_at_first_explains_all_later():
    """Probabilities of 1e-200, twice, and likelihoods of e^-400: sums over paths with logarithms of all terms."""
    start, moves = np.array([1.0, 1e-200, 0.0]), np.array([[1.0, 1e-200, 0.0], [0.0, 1.0, 1e-200], [0.0, 0.0, 1.0]])
    table = np.array([[0.0, -np.inf, -5.0], [0.0, -400.0, 2.0], [-1e4, -3e3, -2e3], [-9e3, -8e3, -7.0]])
    found, paths = forward_backward(start, moves, lambda y: table[y], range(4)), list(product(range(3), repeat=4))
    with np.errstate(divide="ignore"):
        a, b = np.log(start), np.log(moves)
    terms = np.array([a[p[0]] + sum(b[i, j] for i, j in pairwise(p)) + sum(table[range(4), p]) for p in paths])
    assert found.log_evidence[-1] == pytest.approx(logsumexp(terms), abs=1e-9)
    for t in range(4):
        expected = [np.exp(logsumexp(terms[[p[t] == k for p in paths]]) - logsumexp(terms)) for k in range(3)]
        np.testing.assert_allclose(found.smoothed[t], expected, rtol=1e-9)


def test_draws_of_a_hidden_markov_model_have_its_probabilities():
    """Chi-square of 20,000 draws per row, false alarm 1e-6 a row; a state of probability 0 is never drawn."""
    moves = np.array([[0.0, 0.7, 0.3], [0.2, 0.8, 0.0], [1.0, 0.0, 0.0]])
    model, rng = hidden_markov([0.5, 0.0, 0.5], moves, log_emit), np.random.default_rng(0)
    rows = [(model.sample_initial(rng, 20_000), np.array([0.5, 0.0, 0.5]))]
    rows += [(model.sample_transition(rng, np.full(20_000, k)), moves[k]) for k in range(3)]
    for drawn, p in rows:
        counts = np.bincount(drawn, minlength=3)
        assert not counts[p == 0].any()
        if (p > 0).sum() > 1:
            assert stats.chisquare(counts[p > 0], 20_000 * p[p > 0]).pvalue > 1e-6
    assert model.log_transition(np.array([0, 1]), np.array([1, 2])).tolist() == [np.log(0.7), -np.inf]


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: kalman_filter(np.eye(3), Q, H, R, M0, P0, [0.0]), r"F has shape \(3, 3\), expected \(2, 2\)"),
        (lambda: kalman_filter(F, Q, H, R, M0, np.eye(1), [0.0]), "P0 has shape"),
        (lambda: kalman_filter(F, Q, H, R, M0, P0, [0.0, [1.0, 2.0]]), "observation 1 has shape"),
        (lambda: kalman_filter(F, -Q, H, R, M0, P0, [0.0]), "Q is .*, expected a covariance"),
        (lambda: kalman_filter(F, Q, H, [[0.0]], M0, 0 * P0, [0.0]), "H P H' . R of observation 0 is singular"),
        (lambda: bootstrap(hidden_markov([0.5, 0.5], np.eye(2), log_emit), 5).run([0]), r"log_likelihood .* \(3,\)"),
        (lambda: hidden_markov([0.5, 0.6], np.eye(2), log_emit), "sum to 1"),
        (lambda: hidden_markov([0.5, 0.5], np.eye(3), log_emit), r"transition has shape \(3, 3\)"),
        (lambda: forward_backward(START, np.eye(2), log_emit, [0]), "transition has shape"),
        (lambda: forward_backward(START, MOVES, lambda y: [0.0], [0]), r"log_likelihood returned shape \(1,\)"),
        (lambda: forward_backward([1, 0, 0], np.eye(3), log_emit, [0, 3]), "observation 1 is 3: no state"),
    ],
)
def test_wrong_calls_are_named(call, message):
    with pytest.raises(InputError, match=message):
        call()
