"""Run the contracts on correct components; none may be rejected.

python experiments/correct_components/run.py [--only PART] [--out FILE]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from mstfilter import smc
from mstfilter.files import write_csv
from mstfilter.smc import Normal, Population
from mstfilter.testing import run_contract
from tests.smc.models import AR1, SD0, TAU, optimal, optimal_initial, predictive
from tests.testing import faults, other_faults

RESULTS = Path(__file__).parent / "results" / "checks.csv"


# --- examples ---


def numbers(rng, n):
    return Population(rng.standard_normal(n), 0.5 * rng.standard_normal(n)), 0.5


def wide(rng, n):
    return Population(rng.standard_cauchy(n), 3 * rng.standard_normal(n)), -2.0


def vectors(rng, n):
    return Population(rng.standard_normal((n, 2)), rng.standard_normal(n)), np.array([0.3, -0.1])


def mapping(rng, n):
    return Population({"x": rng.standard_normal(n), "k": rng.integers(0, 5, n)}, rng.standard_normal(n)), 0.4


def objects(rng, n):
    return Population(tuple(f"particle {k}" for k in rng.integers(0, 30, n)), rng.standard_normal(n)), None


def different(rng, n):
    """Distinct objects, because `Coalesced` gives all copies of equal objects to the first of them."""
    return Population(tuple(f"particle {k}" for k in range(n)), rng.standard_normal(n)), None


EXAMPLES = (numbers, wide, vectors, mapping, objects)
ARRAYS = (numbers, vectors, mapping)


# --- components as a user writes them ---


@dataclass(frozen=True)
class Move(smc.Transition):
    """Moves all particles x by ``function(rng, x, y)``."""

    function: Any

    def predict(self, rng, population, observation):
        return population.moved(self.function(rng, population.particles, observation))


@dataclass(frozen=True)
class Draw(smc.Proposal):
    """Draws n particles by ``function(rng, n)``."""

    function: Any

    def sample(self, rng, observation, n):
        return Population(self.function(rng, n))


def mixture(rng, x, y):
    """A random walk with a large step with probability 0.1."""
    return x + np.where(rng.random(len(x)) < 0.1, 3.0, 0.3) * rng.standard_normal(len(x))


def kernel_smoothing(rng, x, y):
    """Liu and West (2001): shrinks to the mean and keeps the variance. A single particle does not move."""
    a = 0.95
    return a * x + (1 - a) * x.mean() + np.sqrt(1 - a * a) * x.std() * rng.standard_normal(len(x))


def odometry(rng, x, y):
    """The observation is an input of the move."""
    return x + (0.0 if y is None else y) + 0.1 * rng.standard_normal(len(x))


MOVES = {
    "random walk": lambda rng, x, y: x + 0.3 * rng.standard_normal(len(x)),
    "tiny steps": lambda rng, x, y: x + 1e-4 * rng.standard_normal(len(x)),
    "heavy tails": lambda rng, x, y: x + rng.standard_cauchy(len(x)),
    "skewed": lambda rng, x, y: x + rng.exponential(size=len(x)),
    "deterministic": lambda rng, x, y: 0.9 * x,
    "still": lambda rng, x, y: x,
    "mixture": mixture,
    "rare jumps": lambda rng, x, y: x + (rng.random(len(x)) < 0.02),
    "multiplicative": lambda rng, x, y: x * rng.lognormal(0, 0.2, len(x)),
    "to zero": lambda rng, x, y: np.where(rng.random(len(x)) < 0.5, 0.0, x),
    "reflected": lambda rng, x, y: np.abs(x + rng.standard_normal(len(x))),
    "liu-west": kernel_smoothing,
    "odometry": odometry,
    "towards y": lambda rng, x, y: x + 0.1 * rng.standard_normal(len(x)) + (0.0 if y is None else 0.1 * (y - x)),
    "categories": lambda rng, x, y: np.floor(x) + rng.integers(0, 3, len(x)),
    "row by row": lambda rng, x, y: np.array([v + rng.normal(0, 0.2) for v in x]),
}


def exact_move(previous_of, move):
    def exact(rng, n):
        previous = previous_of(rng, n)
        return Population(previous), Population(move(rng, previous, 0.5)), 0.5

    return exact


DRAWS = {
    "normal": lambda rng, n: rng.standard_normal(n),
    "cauchy": lambda rng, n: rng.standard_cauchy(n),
    "counts": lambda rng, n: rng.poisson(2.0, n).astype(float),
    "vectors": lambda rng, n: rng.standard_normal((n, 3)),
    "mapping": lambda rng, n: {"x": rng.gamma(2.0, size=n), "k": rng.integers(0, 4, n)},
    "sorted": lambda rng, n: np.sort(rng.standard_normal(n)),
    "stratified": lambda rng, n: stats.norm.ppf((rng.permutation(n) + rng.random(n)) / n),
    "two components": lambda rng, n: np.where(rng.random(n) < 0.3, -2.0, 2.0) + rng.standard_normal(n),
}

LIKELIHOODS = {
    "normal": lambda x: stats.norm.logpdf(0.5, x, 0.5),
    "student": lambda x: stats.t.logpdf(0.5 - x, 3),
    "cauchy": lambda x: stats.cauchy.logpdf(0.5 - x),
    "box": lambda x: np.where(np.abs(x - 0.5) < 1, np.log(0.5), -np.inf),
    "poisson": lambda x: stats.poisson.logpmf(2, np.exp(x)),
    "logistic": lambda x: -np.logaddexp(0, -x),
    "constant": lambda x: np.zeros(len(x)),
    "laplace": lambda x: stats.laplace.logpdf(0.5 - x),
    "mixture": lambda x: np.logaddexp(
        np.log(0.9) + stats.norm.logpdf(0.5, x, 0.3), np.log(0.1) + stats.norm.logpdf(0.5, 0, 3)
    ),
    "large": lambda x: 1e4 + stats.norm.logpdf(0.5, x, 0.5),
}


def exact_weights(log_likelihood):
    def exact(rng, n):
        prior = Population(rng.standard_normal(n))
        return prior, prior.reweighted(log_likelihood(prior.particles)), 0.5

    return exact


def resampled_posterior(log_likelihood):
    """Exact draws by rejection from the prior."""

    def exact(rng, n):
        x = rng.standard_normal(60 * n if n < 1000 else 30 * n)
        lw = log_likelihood(x)
        kept = x[np.log1p(-rng.random(len(x))) < lw - max(lw.max(), log_likelihood(np.linspace(-6, 6, 4001)).max())]
        return Population(rng.standard_normal(n)), Population(kept[rng.permutation(len(kept))[:n]]), 0.5

    return exact


# --- checks: name, component, example, exact ---


def resamplers() -> Iterator[tuple[str, Any, Any, Any]]:
    basic = {
        **{name: getattr(smc, name)() for name in ("Multinomial", "Stratified", "Systematic", "Residual", "Ssp")},
        **{name: getattr(smc, name)() for name in ("Killing", "FearnheadClifford", "Chopthin")},
        "Chopthin, 20": smc.Chopthin(20.0),
        "Chopthin, 4": smc.Chopthin(4.0),
    }
    own = {f"user: {scheme!r}": scheme for scheme in (faults.Correct(), faults.CorrectWeighted(), *faults.CORRECT)}
    own.update({f"user: heaps at {p}": faults.RareHeaps(p) for p in (0.0001, 0.0005, 0.002, 0.01, 0.1, 0.5, 1.0)})
    yield from ((name, scheme, numbers, None) for name, scheme in {**basic, **own}.items())
    for name, scheme in basic.items():
        yield f"shuffled {name}", smc.Shuffled(scheme), vectors, None
        yield f"tempered {name}", smc.Tempered(scheme, 0.5), mapping, None
        yield f"sorted {name}", smc.Sorted(scheme), numbers, None
        yield f"coalesced {name}", smc.Coalesced(scheme), different, None
    for example in (numbers, wide, vectors, mapping, different):
        yield f"systematic of {example.__name__}", smc.Systematic(), example, None
        yield f"user: heaps of {example.__name__}", faults.RareHeaps(), example, None
        yield f"largest of {example.__name__}", smc.LargestWeights(), example, None
        yield f"coalesced of {example.__name__}", smc.Coalesced(), example, None
    for example in (numbers, vectors, mapping):
        yield f"clusters of {example.__name__}", smc.ClusterStratified(), example, None
        yield f"Hilbert sort of {example.__name__}", smc.Sorted(), example, None
    yield "keep weights", smc.KeepWeights(), numbers, None


def transitions() -> Iterator[tuple[str, Any, Any, Any]]:
    for name, move in MOVES.items():
        yield f"move {name}", Move(move), numbers, None
        if name in ("liu-west", "odometry", "towards y"):
            continue
        for law, previous in (("normal", DRAWS["normal"]), ("cauchy", DRAWS["cauchy"])):
            yield f"move {name} of {law}, exact", Move(move), numbers, exact_move(previous, move)
    for F in ([[0.9]], [[1.0]], [[0.0]], [[-0.5]]):
        model = smc.linear_gaussian(F=F, Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
        yield (
            f"linear, F = {F}",
            smc.Dynamics(model),
            lambda rng, n: (Population(rng.standard_normal((n, 1))), np.ones(1)),
            None,
        )
    A, eye = [[1.0, 0.1], [0.0, 1.0]], np.eye(2).tolist()
    model = smc.linear_gaussian(F=A, Q=eye, H=eye, R=eye, m0=[0.0, 0.0], P0=eye)
    yield "linear, two dimensions", smc.Dynamics(model), vectors, None
    yield "AR(1)", smc.Dynamics(AR1), numbers, other_faults.exact_walk
    yield "AR(1), guided", smc.Dynamics(AR1, optimal), numbers, other_faults.exact_moves
    yield "user: guided", other_faults.Guided(), numbers, other_faults.exact_moves
    yield "branching", smc.Branching(smc.Dynamics(AR1), 3), numbers, None
    yield "density", other_faults.CorrectDensity(), numbers, other_faults.exact_density


def proposals() -> Iterator[tuple[str, Any, Any, Any]]:
    for name, draw in DRAWS.items():
        yield f"draws {name}", Draw(draw), numbers, None
        yield f"draws {name}, exact", Draw(draw), numbers, lambda rng, n, draw=draw: (Population(draw(rng, n)), 0.5)
    yield "AR(1)", smc.Prior(AR1), numbers, other_faults.exact_prior
    yield "AR(1), guided", smc.Prior(AR1, optimal_initial), numbers, guided_prior
    for component in (
        other_faults.correct_draws(),
        other_faults.correct_weighed(),
        other_faults.correct_antithetic(),
    ):
        yield type(component).__name__, component, numbers, other_faults.exact_prior


def guided_prior(rng, n):
    return Population(rng.normal(0.0, SD0, n)), 0.7, lambda x: Normal(x, TAU).log_prob(0.7)


def updates() -> Iterator[tuple[str, Any, Any, Any]]:
    for name, g in LIKELIHOODS.items():
        component = smc.Reweight(lambda x, y, g=g: g(x))
        yield f"likelihood {name}", component, numbers, None
        yield f"likelihood {name}, exact weights", component, numbers, exact_weights(g)
        yield f"likelihood {name}, exact draws", component, numbers, resampled_posterior(g)
    yield "user: posterior", other_faults.Posterior(), numbers, other_faults.exact_evidence


def rejuvenations() -> Iterator[tuple[str, Any, Any, Any]]:
    exact = exact_ar1
    for scale in (0.1, 0.7, 3.0):
        yield f"random walk, {scale}", smc.RandomWalkMove(AR1, scale), numbers, exact
    yield "user: Metropolis", other_faults.correct_kernel(), numbers, exact
    yield "nothing", other_faults.nothing(), numbers, exact
    yield "Gibbs", other_faults.gibbs(), numbers, exact


def exact_ar1(rng, n):
    previous = rng.normal(0.2, 1.0, n)
    return Population(previous), Population(optimal(previous, 0.7).sample(rng, n)), 0.7


def values() -> Iterator[tuple[str, Any, Any, Any]]:
    triggers = [smc.Always(), smc.Never(), *map(smc.EssBelow, (0.1, 0.5, 0.9, 1.0))]
    for example in EXAMPLES:
        for trigger in triggers:
            yield f"{trigger!r} of {example.__name__}", trigger, example, None
        yield f"equal {example.__name__}", smc.ExactEquality(), example, None
        yield f"KLD of equal {example.__name__}", smc.Kld(smc.ExactEquality()), example, None
    for example in ARRAYS:
        yield f"ArrayCodec of {example.__name__}", smc.ArrayCodec(), example, None
        for width in (0.1, 1.0, 10.0):
            yield f"bins of {width} of {example.__name__}", smc.Bins(width), example, None
            yield f"KLD, bins of {width} of {example.__name__}", smc.Kld(smc.Bins(width)), example, None
            yield f"gaussian {width} of {example.__name__}", smc.Gaussian(width), example, None
    for function in (predictive, lambda x, y: np.zeros(len(x)), lambda x, y: -np.abs(x - y)):
        yield "priority", smc.PriorityLookahead(function), numbers, None


PARTS = {f.__name__: f for f in (values, proposals, updates, rejuvenations, transitions, resamplers)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=PARTS, action="append")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    rows = []
    for part in options.only or PARTS:
        for name, component, example, exact in PARTS[part]():
            start = time.process_time()
            results = run_contract(component, example, exact)
            seconds = time.process_time() - start
            broken = "; ".join(f"{r.name}: {r.failure}" for r in results if r.failure)
            rows.append({"part": part, "component": name, "seconds": f"{seconds:.2f}", "broken": broken})
            if broken:
                print(f"{part}, {name}: {broken}")
    write_csv(options.out, rows)
    print(f"{len(rows)} checks, {sum(bool(row['broken']) for row in rows)} rejected")


if __name__ == "__main__":
    main()
