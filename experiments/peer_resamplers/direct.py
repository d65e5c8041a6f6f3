"""Direct calls of the libraries: inputs that an adapter normalises or that its generator never makes.

Every function ``test_...`` is a test. The first line of its docstring is the property; the message of its
AssertionError says how a scheme violates it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from unittest import SkipTest
from unittest.mock import patch

import numpy as np
from adapters import Adapter, Blackjax


def called(adapter: Adapter, weights: np.ndarray, n: int | None = None, seed: int = 0) -> np.ndarray:
    """Ancestors; AssertionError if the library raises an error, or returns something else than indices."""
    n = len(weights) if n is None else n
    try:
        found = np.asarray(adapter.call(np.random.default_rng(seed), weights, n))
    except Exception as error:
        raise AssertionError(f"{type(error).__name__}: {error}") from error
    m = len(weights)
    wrong = found[(found < 0) | (found >= m)]
    assert not len(wrong), "returns indices beyond the last particle"
    assert len(found) == n, f"returns {len(found)} particles, expected {n}"
    return found


def refused_or_in_proportion(adapter: Adapter, weights: np.ndarray) -> None:
    """A clear error, or copies in proportion to the weights, over 200 calls."""
    copies = np.zeros(len(weights))
    for seed in range(200):
        try:
            found = called(adapter, weights, seed=seed)
        except AssertionError as error:
            if "ValueError" in str(error) and ("weight" in str(error) or "prob" in str(error)):
                return
            raise
        copies += np.bincount(found, minlength=len(weights))
    mean, expected = copies / 200, len(weights) * weights / weights.sum()
    # The variance of a mean of 200 multinomial counts bounds that of each scheme; 6 standard errors.
    wrong = np.flatnonzero(np.abs(mean - expected) > 6 * np.sqrt(expected / 200))
    assert not len(wrong), (
        f"biased: particle {wrong[0]} gets {mean[wrong[0]]:.2f} copies on average, expected {expected[wrong[0]]:.2f}"
    )


def test_sum_below_one(adapter: Adapter) -> None:
    """Weights whose sum is 0.9 are refused or normalised."""
    refused_or_in_proportion(adapter, np.linspace(1, 2, 10) * (0.9 / 15))


def test_sum_above_one(adapter: Adapter) -> None:
    """Weights whose sum is 1.1 are refused or normalised."""
    refused_or_in_proportion(adapter, np.linspace(1, 2, 10) * (1.1 / 15))


def refused(adapter: Adapter, weights: np.ndarray) -> None:
    """A clear error."""
    try:
        found = called(adapter, weights)
    except AssertionError as error:
        if "ValueError" in str(error) and ("weight" in str(error) or "prob" in str(error)):
            return
        raise
    raise AssertionError(f"returns ancestors {found.tolist()}")


def test_all_zero(adapter: Adapter) -> None:
    """Weights that are all zero are refused."""
    refused(adapter, np.zeros(10))


def test_nan(adapter: Adapter) -> None:
    """A weight that is NaN is refused."""
    weights = np.full(10, 0.1)
    weights[4] = np.nan
    refused(adapter, weights)


def test_single_precision(adapter: Adapter) -> None:
    """100 000 weights of type float32 are resampled correctly."""
    many(adapter, np.float32, 100_000)


def test_a_million(adapter: Adapter) -> None:
    """A million weights are resampled correctly."""
    many(adapter, np.float64, 1_000_000)


def many(adapter: Adapter, kind: type, n: int) -> None:
    """Copies in ten blocks of particles, in 20 calls."""
    weights = np.random.default_rng(5).exponential(size=n).astype(kind)
    weights /= weights.sum()
    share = weights.astype(np.float64).reshape(10, -1).sum(axis=1)
    for seed in range(20 if n < 1e6 else 5):
        found = called(adapter, weights, seed=seed)
        blocks = np.bincount(found // (n // 10), minlength=10)
        # Eight standard deviations of multinomial resampling, which has the largest variance.
        wrong = np.flatnonzero(np.abs(blocks - n * share) > 8 * np.sqrt(n * share * (1 - share)))
        assert not len(wrong), (
            f"call {seed}: tenth {wrong[0]} of the particles gets {blocks[wrong[0]]} copies, "
            f"expected {n * share[wrong[0]]:.0f}"
        )


def test_equal_weights(adapter: Adapter) -> None:
    """Equal weights are resampled, also where n (1/n) is not 1."""
    for n in (1, 2, 3, 7, 9, 11, 49, 98, 103):
        weights = np.full(n, 1 / n)
        try:
            with np.errstate(all="ignore"):
                called(adapter, weights, seed=n)
        except AssertionError as error:
            raise AssertionError(f"{n} particles: {error}") from error


def test_one_positive_weight(adapter: Adapter) -> None:
    """Of one positive weight among zeros all copies are made."""
    for i in range(5):
        weights = np.zeros(5)
        weights[i] = 1.0
        for seed in range(20):
            found = called(adapter, weights, seed=seed)
            assert (found == i).all(), f"only particle {i} has weight; ancestors are {found.tolist()}"


def test_any_size(adapter: Adapter) -> None:
    """It resamples 5 particles to 3 and to 12."""
    for n in (3, 12):
        called(adapter, np.linspace(1, 2, 5) / 7.5, n)


def test_smallest_uniform(adapter: Adapter) -> None:
    """The uniform number 0 does not select a particle of weight zero."""
    extreme(adapter, np.array([0.0, 0.3, 0.0, 0.7, 0.0]), 0.0)


def test_largest_uniform(adapter: Adapter) -> None:
    """The largest uniform number does not select a particle of weight zero, if rounding makes the sum 1 - 8 ulp."""
    eps = np.finfo(np.float32 if isinstance(adapter, Blackjax) else np.float64).eps
    extreme(adapter, np.array([0.3, 0.7, 0.0]) * (1 - 8 * eps), 1.0)


def extreme(adapter: Adapter, weights: np.ndarray, value: float) -> None:
    """No error, and no particle of weight zero, if the uniform numbers have an extreme value."""
    with uniforms(adapter, value), np.errstate(all="ignore"):
        found = called(adapter, weights)
    assert (weights[found] > 0).all(), f"selects particle {found[weights[found] == 0][0]}, weight 0"


@contextmanager
def uniforms(adapter: Adapter, value: float) -> Iterator[None]:
    """The first uniform number is 0, or the last one is the largest below 1; the others are 1/2."""
    if adapter.package == "particles" and adapter.scheme == "ssp":
        raise SkipTest("draws inside compiled code")
    with ExitStack() as stack:
        if isinstance(adapter, Blackjax):
            import jax

            largest = 1 - 2.0**-23  # the largest number that jax.random.uniform returns
            stack.enter_context(jax.disable_jit())
            stack.enter_context(
                patch("jax.random.uniform", lambda key, shape=(): jax.numpy.asarray(draws(shape, value, largest)))
            )
        else:

            def draw(*size: int) -> np.ndarray | np.float64:
                return draws(size, value, 1 - 2.0**-53)

            def between(low: np.ndarray, high: np.ndarray) -> np.ndarray | np.float64:
                return low + (high - low) * draw(*np.shape(low))

            stack.enter_context(patch("numpy.random.rand", draw))
            stack.enter_context(patch("numpy.random.uniform", between))
            if adapter.package == "filterpy":
                stack.enter_context(patch("filterpy.monte_carlo.resampling.random", draw))
        yield


def draws(shape: tuple[int, ...], value: float, largest: float) -> np.ndarray | np.float64:
    """Uniform numbers of a shape; `value` is 0 or 1."""
    found = np.full(shape or (1,), 0.5)
    found[0 if value == 0 else -1] = min(value, largest)
    return found if shape else found[0]


TESTS = {
    name.removeprefix("test_"): function for name, function in list(globals().items()) if name.startswith("test_")
}
