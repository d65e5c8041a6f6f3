"""Monte Carlo variances of the estimates of a run, estimated from the same run, and distances between populations.

How much would the log evidence change with another seed? Particles that descend from one ancestor are not
independent, so the run itself tells: the fewer ancestors carry the weight, the larger is the variance (Lee and
Whiteley 2018).

>>> from mstfilter.smc import Normal, StateSpaceModel, bootstrap, run_variance
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> states, ys = model.simulate(50, seed=1)
>>> found = run_variance(bootstrap(model, n=1000), ys, seed=0, lag=20)
>>> estimate, standard_error = found.log_evidence[-1], found.log_evidence_variance[-1] ** 0.5

`energy_distance` compares two populations. Half of the energy distance between a population and the true state is
the energy score (Gneiting and Raftery 2007). A lower score is better:

>>> from mstfilter.smc import Population, energy_distance
>>> score = energy_distance(found.state.population, Population(states[-1:])) / 2
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from mstfilter.base.errors import InputError, check_integer, naming, warn_user
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.interfaces import Infos, State
from mstfilter.smc.population import Population, as_matrix, union
from mstfilter.smc.wrapped_resampling import Coalesced, ResamplerWrapper


def energy_distance(
    first: Population, second: Population, distance: Callable[[Any], np.ndarray] | None = None
) -> float:
    """Energy distance between two weighted populations (Szekely and Rizzo 2013), in the units of the distance.

    The energy distance is 2 E d(X, Y) - E d(X, X') - E d(Y, Y') for draws X, X' of the first and Y, Y' of the second
    population. For scalar particles the result is the square of `scipy.stats.energy_distance`. The energy distance is
    0 if both populations represent the same distribution, and positive otherwise.

    ``distance(particles)`` returns an (n, n) array, for example ``lambda p: 1 - Gaussian().matrix(p)``. The distance
    must be of negative type (Sejdinovic et al. 2013). With other distance functions, the result can be 0 for
    different distributions. The default is the Euclidean distance of arrays and mappings of arrays.
    """
    both = union(first.realised().labelled({}), second.realised().labelled({}))
    return _energy(both.particles, np.concatenate([first.weights, -second.weights]), distance)


def _energy(particles: Any, masses: np.ndarray, distance: Callable[[Any], np.ndarray] | None) -> float:
    """- sum_ij m_i m_j d(x_i, x_j) of signed masses that sum to 0."""
    if distance is not None:
        d = np.asarray(distance(particles), dtype=np.float64)
        if d.shape != (len(masses),) * 2:
            raise InputError(f"distances have shape {d.shape}, expected {(len(masses),) * 2}")
        if not np.isfinite(d).all():
            raise InputError("distances are NaN or infinite")
        return max(0.0, -float(masses @ d @ masses))
    x, some = as_matrix(particles), masses != 0
    x, masses = x[some], masses[some]
    if not np.isfinite(x).all():
        raise InputError(
            "particles have entries that are NaN or infinite",
            "leave out these variables, or give a distance that is defined for such entries",
        )
    if x.shape[1] == 1:  # 2 times the integral of the squared difference of the distribution functions
        order = np.argsort(x[:, 0])
        gaps, below = np.diff(x[order, 0]), np.cumsum(masses[order])[:-1]
        return 2.0 * float(gaps @ (below * below))
    from scipy.spatial.distance import cdist

    rows = max(1, 4_000_000 // max(1, len(x)))
    parts = [masses[k : k + rows] @ (cdist(x[k : k + rows], x) @ masses) for k in range(0, len(x), rows)]
    return max(0.0, -float(sum(parts)))


@dataclass(frozen=True, eq=False)
class RunVariance:
    """Estimates of a run and their Monte Carlo variances, estimated from the same run."""

    log_evidence: np.ndarray  #: (T,)
    #: (T,) variance of the log evidence over seeds. May be negative where it is small compared with its own error.
    log_evidence_variance: np.ndarray
    mean: np.ndarray  #: (T, ...) weighted means of the function
    mean_variance: np.ndarray  #: (T, ...) variances of these means over seeds, entry by entry
    state: State  #: the last state of the run
    infos: Infos = field(default_factory=Infos)  #: of its steps

    def __repr__(self) -> str:
        if not len(self.log_evidence):
            return "RunVariance of no step"
        z, variance = self.log_evidence[-1], self.log_evidence_variance[-1]
        return f"RunVariance after {len(self.log_evidence)} steps: log evidence {z:.6g}, its variance {variance:.3g}"


def run_variance(
    filter: ParticleFilter,
    observations: Iterable[Any],
    seed: int = 0,
    lag: int | None = None,
    function: Callable[[Any], np.ndarray] | None = None,
    until: Callable[[State], bool] | None = None,
) -> RunVariance:
    """Run a filter, and estimate the variances of its estimates from the ancestors of the particles.

    Let A_e be the total weight of the particles at time t with ancestor e at time 0. The weights at time t sum to 1.
    The variance of the log evidence (to first order, the relative variance of the evidence) is estimated by

        V = 1 - f (1 - sum_e A_e^2), where f = N / (N - 1) * product of f_s over the selections s.

    The variance of a weighted mean is estimated by ``f sum_e B_e^2``, where B_e is the sum of w (x - mean) over the
    particles with ancestor e (Lee and Whiteley 2018). For independent selections (`Multinomial`), f_s = N / (N - 1)
    makes V unbiased. Other schemes make fewer duplicates, so f_s is computed from the weights for all schemes:

        f_s = (1 - sum_e W_e^2) / (1 - sum_e V_e^2)

    W_e and V_e are the total weights of the descendants of e before and after the selection. The numerator and the
    denominator are the probabilities that two draws by weight have different ancestors. For independent selections,
    the mean of 1 / f_s is (N - 1) / N. For schemes other than `Multinomial`, f_s is an approximation, which assumes
    that pairs of particles with different ancestors are selected in proportion to their weights.

    With a lag L (Olsson and Douc 2019), the estimate for the mean uses ancestors L steps earlier instead of ancestors
    at time 0. For the evidence, the part of V that arises at time s is evaluated at time s + L instead of t, and the
    parts are added. The lag reduces the noise of the estimates. With a lag, the variances can be estimated even if
    all particles share one ancestor at time 0. The bias from the lag is small if x_t hardly depends on x_{t-L}.

    Without a lag, V never exceeds 1, its value when all particles have one ancestor at time 0: such a run contains no
    information about its variance any more, and there is a warning. Give a lag, or use more particles.

    The estimated variances are of first order in 1 / n, and too low for small n. Use more particles if the log
    evidence has a variance above 0.3 (`experiments/run_variance`).

    Parameters
    ----------
    filter : ParticleFilter
        A properly weighted filter with at least 2 particles. `Coalesced` is not supported.
    lag : int, optional
        Number of steps L, at least 1. By default, L covers all steps. Time and memory grow with n times the lag.
    function : callable, optional
        ``(particles) -> (n, ...)``: the values that are averaged. By default, array particles are averaged, and
        particles of another type give means of shape (T, 0).
    until : callable, optional
        ``(state) -> bool``: the run ends after the first state for which it is true.

    Returns
    -------
    RunVariance
        The log evidence and the means equal the estimates of ``filter.run(observations, seed)``.
    """
    if lag is not None:
        check_integer("lag", lag)
    if not filter.properly_weighted:
        raise InputError("a filter that is not properly weighted reports no evidence, and so has no variance of it")
    if filter.n < 2:
        raise InputError(f"n is {filter.n}, expected at least 2 particles to estimate a variance")
    scheme: Any = filter.resampler
    while scheme is not None:
        if isinstance(scheme, Coalesced):
            raise InputError(
                "Coalesced merges particles, so ancestors do not show the variance of a run", "use its inner scheme"
            )
        scheme = getattr(scheme, "scheme", None)
    watched = _Watched(filter.resampler)
    ancestry = _Ancestry(lag)
    rows: list[tuple[Any, ...]] = []
    state, infos = filter.start(seed), Infos()
    for state, info in replace(filter, resampler=watched).iterate(observations, seed):
        population, total = state.population, state.log_evidence
        assert population is not None and total is not None
        if info.t == 0:
            ancestry.begin(info.n_candidates)
            first = np.arange(info.n_candidates)
        with naming(f"step {info.t}"):
            parents = population.known_parents() if info.t else population.parents.get("ancestor", first)
        ancestry.descend(watched.selections, parents, population.weights)
        watched.selections.clear()
        if info.t > 0 and lag is not None:
            ancestry.begin(len(population))
        values = _values(population, function)
        mean = np.tensordot(population.weights, values, axes=1)
        rows.append((total, ancestry.evidence(), mean, ancestry.mean(values - mean)))
        infos.append(info)
        if until is not None and until(state):
            break
    columns = [np.array(column) for column in zip(*rows, strict=True)] or [np.zeros(0)] * 4
    if lag is None and len(rows) > 1 and rows[-1][1] >= 1 - 1e-12:
        warn_user("run_variance: all particles have one ancestor at time 0", "give a lag, or use more particles")
    return RunVariance(columns[0], columns[1], columns[2], columns[3], state, infos)


def _values(population: Population, function: Callable[[Any], np.ndarray] | None) -> np.ndarray:
    particles, n = population.particles, len(population)
    if function is None:
        plain = isinstance(particles, np.ndarray) and particles.dtype != object
        return np.asarray(particles, dtype=np.float64) if plain else np.zeros((n, 0))
    values = np.asarray(function(particles), dtype=np.float64)
    if values.shape[:1] != (n,):
        raise InputError(f"the function returned shape {values.shape}, expected one row per particle: ({n}, ...)")
    return values


class _Selection(NamedTuple):
    """A resampling of m particles."""

    parents: np.ndarray  #: (m,) int, their parents in the population after the previous step
    before: np.ndarray  #: (m,) their weights
    after: np.ndarray  #: (m,) shares of their copies in the weight after the selection
    ancestors: np.ndarray  #: (n,) int


@dataclass(frozen=True)
class _Watched(ResamplerWrapper):
    """Resamples by `scheme`, and stores each resampling of a step in `selections`."""

    selections: list[_Selection] = field(default_factory=list)

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        chosen = self.scheme.resample(rng, population, n)
        ancestors = chosen.parents.get("ancestor")
        if ancestors is None or (ancestors < 0).any():
            raise InputError("the variance of a run needs a resampler that reports ancestors")
        parents = population.parents.get("previous", np.arange(len(population)))
        if self.selections:
            parents = self.selections[-1].ancestors[parents]
        shares = np.bincount(ancestors, chosen.weights, len(population))
        self.selections.append(_Selection(parents, population.weights, shares, ancestors))
        return chosen


class _Ancestry:
    """For each of the times t - lag .. t: the ancestors of the present particles, and f of the selections since."""

    def __init__(self, lag: int | None) -> None:
        self.lag = lag
        #: For each time: ancestors of the present particles, and f.
        self.window: deque[tuple[np.ndarray, float]] = deque()
        self.past = 0.0  # parts of the variance of the evidence that arose before the window
        self.weights = np.zeros(0)

    def begin(self, n: int) -> None:
        """Add the present time, with the n particles as ancestors. The particles must be independent draws."""
        self.window.append((np.arange(n), n / (n - 1) if n > 1 else 1.0))

    def descend(self, selections: list[_Selection], parents: np.ndarray, weights: np.ndarray) -> None:
        """Update the ancestors and factors for the next population."""
        if self.lag is not None and len(self.window) > self.lag:
            self.past += self._relative(0) - self._relative(1)
            self.window.popleft()
        for k, (index, f) in enumerate(self.window):
            for selection in selections:
                of = index[selection.parents]
                after = _differ(of, selection.after)
                # If all descend from one ancestor, V is 1 for any f.
                f *= _differ(of, selection.before) / after if after > 1e-12 else 1.0
            self.window[k] = index[parents], f
        self.weights = weights

    def _relative(self, place: int) -> float:
        """Relative variance of the evidence that arises between entry `place` of the window and the present."""
        index, f = self.window[place]
        return 1.0 - f * _differ(index, self.weights)

    def evidence(self) -> float:
        return self.past + self._relative(0)

    def mean(self, centred: np.ndarray) -> np.ndarray:
        """(...) variance of the weighted mean of values; `centred` (n, ...) are the values minus their mean."""
        index, f = self.window[0]
        columns = (self.weights[:, None] * centred.reshape(len(centred), -1)).T
        squares = [float(np.square(np.bincount(index, column)).sum()) for column in columns]
        return f * np.array(squares).reshape(centred.shape[1:])


def _differ(groups: np.ndarray, weights: np.ndarray) -> float:
    """Probability that two draws by weight belong to different groups."""
    masses = np.bincount(groups, weights)
    return 1.0 - float(masses @ masses)
