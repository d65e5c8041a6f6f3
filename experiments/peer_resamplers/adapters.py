"""Resamplers of other libraries as components: `Particles`, `Filterpy`, `Blackjax`, `StoneSoup`.

    mstfilter check experiments/peer_resamplers/adapters.py:Filterpy scheme=residual

The libraries are called as installed. An adapter does three things that they leave to the user: it makes weights that
sum to 1 from log weights, it lets the library draw from `rng`, and it makes n particles of m with schemes that only
resample n to n.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, ClassVar, Literal

import numpy as np

from mstfilter.smc import WeightResampler


class Adapter(WeightResampler):
    """A resampler of another library. Define `call`."""

    package: ClassVar[str]  # its name on PyPI
    scheme: str
    #: Schemes that only resample n to n.
    fixed_size: ClassVar[frozenset[str]] = frozenset()

    @abstractmethod
    def call(self, rng: np.random.Generator, weights: np.ndarray, n: int) -> np.ndarray:
        """What the library returns for (m,) weights: (n,) ancestors."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        """Call the library with normalised weights.

        A scheme of fixed size resamples k copies of every particle, k m >= n; a random n of the k m results are kept.
        Both steps are unbiased.
        """
        m = len(log_weights)
        fixed = self.scheme in self.fixed_size and n != m
        k = -(-n // m) if fixed else 1
        weights = np.repeat(np.exp(log_weights - np.max(log_weights)), k)
        weights /= weights.sum()
        if not fixed:
            return self.call(rng, weights, n), None
        chosen = self.call(rng, weights, k * m) // k
        return chosen[np.sort(rng.choice(k * m, n, replace=False))], None


@dataclass(frozen=True)
class Filterpy(Adapter):
    """``filterpy.monte_carlo``."""

    scheme: Literal["multinomial", "residual", "stratified", "systematic"] = "systematic"
    package = "filterpy"
    fixed_size = frozenset({"multinomial", "residual", "stratified", "systematic"})

    def call(self, rng: np.random.Generator, weights: np.ndarray, n: int) -> np.ndarray:
        from filterpy import monte_carlo

        if n != len(weights):
            raise NotImplementedError("has no argument for the number of particles")
        with drawing_from(rng):
            return getattr(monte_carlo, f"{self.scheme}_resample")(weights)


@dataclass(frozen=True)
class Particles(Adapter):
    """``particles.resampling``."""

    scheme: Literal["killing", "multinomial", "residual", "ssp", "stratified", "systematic"] = "systematic"
    package = "particles"
    fixed_size = frozenset({"killing"})

    def call(self, rng: np.random.Generator, weights: np.ndarray, n: int) -> np.ndarray:
        from particles import resampling

        if self.scheme == "ssp":
            _numba_seed()(rng.integers(2**32))
        with drawing_from(rng):
            return resampling.resampling(self.scheme, weights, M=n)


@dataclass(frozen=True)
class Blackjax(Adapter):
    """``blackjax.smc.resampling``, compiled, with the default of jax: single precision."""

    scheme: Literal["multinomial", "residual", "stratified", "systematic"] = "systematic"
    package = "blackjax"

    def call(self, rng: np.random.Generator, weights: np.ndarray, n: int) -> np.ndarray:
        import jax

        key = jax.random.key(int(rng.integers(2**32)))
        return np.asarray(_compiled(self.scheme)(key, jax.numpy.asarray(weights), int(n)))


@dataclass(frozen=True)
class StoneSoup(Adapter):
    """``stonesoup.resampler.particle``."""

    scheme: Literal["multinomial", "residual", "stratified", "systematic"] = "systematic"
    package = "stonesoup"
    fixed_size = frozenset({"residual"})

    def call(self, rng: np.random.Generator, weights: np.ndarray, n: int) -> np.ndarray:
        from stonesoup.resampler import particle
        from stonesoup.types.array import StateVectors
        from stonesoup.types.state import ParticleState

        resampler = getattr(particle, f"{self.scheme.capitalize()}Resampler")()
        with np.errstate(divide="ignore"):
            log_weights = np.log(weights)
        state = ParticleState(StateVectors(np.arange(len(weights))[None]), log_weight=log_weights)
        with drawing_from(rng):
            found = resampler.resample(state, n)
        return np.asarray(found.state_vector)[0].astype(np.int64)


@contextmanager
def drawing_from(rng: np.random.Generator) -> Iterator[None]:
    """The global generator of numpy draws from `rng`."""
    before = np.random.get_bit_generator()
    np.random.set_bit_generator(rng.bit_generator)
    try:
        yield
    finally:
        np.random.set_bit_generator(before)


@lru_cache
def _numba_seed() -> Callable[[int], None]:
    """Seeds the generator of numba, which is not that of numpy."""
    from numba import njit

    @njit
    def seed(value: int) -> None:
        np.random.seed(value)  # noqa: NPY002

    return seed


@lru_cache
def _compiled(scheme: str) -> Any:
    import jax
    from blackjax.smc import resampling

    return jax.jit(getattr(resampling, scheme), static_argnums=2)


SCHEMES = ("multinomial", "residual", "stratified", "systematic")
ADAPTERS: tuple[Adapter, ...] = (
    *(Filterpy(scheme) for scheme in SCHEMES),
    *(Particles(scheme) for scheme in (*SCHEMES, "ssp", "killing")),
    *(Blackjax(scheme) for scheme in SCHEMES),
    *(StoneSoup(scheme) for scheme in SCHEMES),
)


def installed(package: str) -> str | None:
    """Version of a library; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
