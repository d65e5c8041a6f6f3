"""Models with a planted fault, and right models in many styles. Each entry is a function without arguments.

A fault makes a filter of another model, a wrong evidence or a random result, without an error in most libraries.
"""

# ruff: noqa: NPY002 (faults)
from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats
from scipy.special import expit, logsumexp

from mstfilter.smc import (
    Bernoulli,
    Categorical,
    Distribution,
    MultivariateNormal,
    Normal,
    Program,
    StateSpaceModel,
    Student,
    Uniform,
    auxiliary,
    bootstrap,
    guided,
    hidden_markov,
    linear_gaussian,
    nonlinear_gaussian,
    observe,
    sample,
    switch,
)

N = 200


def model(move=None, likelihood=None, initial=None, **further):
    """A model by functions, observed with noise."""
    return StateSpaceModel(
        initial or (lambda rng, n: rng.normal(size=n)),
        move or (lambda rng, x: 0.9 * x + 0.5 * rng.normal(size=len(x))),
        likelihood or (lambda x, y: stats.norm.logpdf(y, x, 0.7)),
        sample_observation=lambda rng, x: rng.normal(np.reshape(x, (len(x), -1))[:, 0], 0.7),
        **further,
    )


def densities(transition, observation=None, initial=None):
    return StateSpaceModel.of(initial or Normal(0.0, 1.0), transition, observation or (lambda x: Normal(x, 0.7)))


PLAIN = densities(lambda x: Normal(0.9 * x, 0.5))


class Remembers:
    """Moves by the difference to the particles of the call before."""

    def __init__(self):
        self.before = None

    def __call__(self, rng, x):
        step = 0.0 if self.before is None or len(self.before) != len(x) else 0.1 * (x - self.before)
        self.before = x
        return x + step + 0.5 * rng.normal(size=len(x))


class Memo:
    """A likelihood that is kept by the number of particles."""

    def __init__(self):
        self.kept = {}

    def __call__(self, x, y):
        if len(x) not in self.kept:
            self.kept[len(x)] = stats.norm.logpdf(y, x, 0.7)
        return self.kept[len(x)]


class Scaled(Distribution):
    """Draws with a standard deviation of 0.5, a density with another one."""

    def __init__(self, centre, scale):
        self.centre, self.scale = centre, scale

    @property
    def mean(self):
        return self.centre

    def sample(self, rng, size):
        return self.centre + 0.5 * rng.standard_normal(size)

    def log_prob(self, value):
        return stats.norm.logpdf(value, self.centre, self.scale)


def halves(rng, x):
    z = rng.normal(size=(len(x) + 1) // 2)
    return 0.9 * x + 0.5 * np.concatenate([z, z])[: len(x)]


def antithetic(rng, x):
    z = rng.normal(size=(len(x) + 1) // 2)
    return 0.9 * x + 0.5 * np.concatenate([z, -z])[: len(x)]


def program(body):
    def ar1(previous, y):
        x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], 0.5))
        return body(x, y, previous)

    return Program(ar1)


def seen(x, y, scale=0.7):
    observe("y", Normal(x, scale), y)


def vector(move=None, likelihood=None, **further):
    return model(
        move or (lambda rng, x: 0.9 * x + 0.5 * rng.normal(size=x.shape)),
        likelihood or (lambda x, y: stats.norm.logpdf(y, x[:, 0], 0.7)),
        lambda rng, n: rng.normal(size=(n, 2)),
        **further,
    )


def guide(of):
    def proposal(previous, y):
        sample("x", of(0.0 if previous is None else 0.9 * previous["x"], y))

    return program(lambda x, y, previous: seen(x, y)).guided(proposal, N)


FAULTY = {
    # noise
    "a fixed seed in the move": lambda: model(
        lambda rng, x: 0.9 * x + 0.5 * np.random.default_rng(7).normal(size=len(x))
    ),
    "noise of the first half for the second": lambda: model(halves),
    "antithetic noise": lambda: model(antithetic),
    "sorted noise": lambda: model(lambda rng, x: 0.9 * x + 0.5 * np.sort(rng.normal(size=len(x)))),
    "cumulated noise": lambda: model(lambda rng, x: 0.9 * x + 0.1 * np.cumsum(rng.normal(size=len(x)))),
    "stratified noise": lambda: model(
        lambda rng, x: 0.9 * x + 0.5 * stats.norm.ppf((np.arange(len(x)) + rng.random(len(x))) / len(x))
    ),
    "one noise for pairs": lambda: model(
        lambda rng, x: 0.9 * x + 0.5 * np.repeat(rng.normal(size=len(x) // 2 + 1), 2)[: len(x)]
    ),
    "one matrix of noise for all": lambda: vector(lambda rng, x: x @ (np.eye(2) + 0.3 * rng.normal(size=(2, 2)))),
    # mixing
    "particles in another order": lambda: model(lambda rng, x: rng.permutation(x) + 0.5 * rng.normal(size=len(x))),
    "resampling in the move": lambda: model(
        lambda rng, x: x[rng.integers(0, len(x), len(x))] + 0.5 * rng.normal(size=len(x))
    ),
    "clipped at quantiles of all": lambda: model(
        lambda rng, x: np.clip(x, *np.quantile(x, [0.2, 0.8])) + 0.5 * rng.normal(size=len(x))
    ),
    "the distance to the nearest other": lambda: model(
        lambda rng, x: x + 0.3 * np.sort(abs(x[:, None] - x), axis=1)[:, 1] + 0.5 * rng.normal(size=len(x))
    ),
    "pulled to the centre of all": lambda: vector(
        lambda rng, x: x - 0.2 * (x - x.mean(axis=0)) + 0.5 * rng.normal(size=x.shape)
    ),
    "ranks in the likelihood": lambda: model(
        likelihood=lambda x, y: stats.norm.logpdf(y, np.argsort(np.argsort(x)) / len(x), 0.7)
    ),
    "divided by the number of particles": lambda: model(
        likelihood=lambda x, y: stats.norm.logpdf(y, x, 0.7) / len(x)
    ),
    "minus the logarithm of the sum": lambda: model(
        likelihood=lambda x, y: stats.norm.logpdf(y, x, 0.7) - logsumexp(stats.norm.logpdf(y, x, 0.7))
    ),
    "a bandwidth of all": lambda: densities(
        lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 0.3 + 1.06 * float(np.std(x)) * len(x) ** -0.2)
    ),
    "a likelihood in turn": lambda: model(
        likelihood=lambda x, y: stats.norm.logpdf(y, x, np.resize([0.5, 0.9], len(x)))
    ),
    "a covariance of all": lambda: StateSpaceModel.of(
        MultivariateNormal(np.zeros(2), np.eye(2)),
        lambda x: MultivariateNormal(0.9 * x, np.cov(x.T) + 0.1 * np.eye(2) if len(x) > 2 else np.eye(2)),
        lambda x: Normal(x[:, 0], 0.7),
    ),
    "the mean of all from the sixth step": lambda: densities(
        lambda x, t: Normal(0.9 * x if t < 6 else 0.9 * x.mean() + 0.0 * x, 0.5)
    ),
    # kept state
    "the particles of the call before": lambda: model(Remembers()),
    "a likelihood kept by the number of particles": lambda: model(likelihood=Memo()),
    # densities
    "a density over two times the scale": lambda: model(
        log_transition=lambda old, new: stats.norm.logpdf(new, 0.9 * old, 1.0)
    ),
    "a density without its constant": lambda: model(
        log_transition=lambda old, new: -0.5 * ((new - 0.9 * old) / 0.5) ** 2
    ),
    "a density of the step, not of the state": lambda: model(
        log_transition=lambda old, new: stats.norm.logpdf(new - old, 0.0, 0.5)
    ),
    "a density of one coordinate": lambda: vector(
        log_transition=lambda old, new: stats.norm.logpdf(new[:, 0], 0.9 * old[:, 0], 0.5)
    ),
    "an initial density with another mean": lambda: model(log_initial=lambda x: stats.norm.logpdf(x, 0.2, 1.0)),
    "a density of the distribution of a user": lambda: Program(
        lambda previous, y: seen(sample("x", Scaled(np.zeros(1) if previous is None else previous["x"], 0.25)), y)
    ),
    # proposals
    "a proposal with half of its density": lambda: guided(PLAIN, lambda x, y: Scaled(0.5 * (0.9 * x + y), 0.9), N),
    "a proposal to the right only": lambda: guided(PLAIN, lambda x, y: stats.halfnorm(0.9 * x, 1.0), N),
    "a proposal far too narrow": lambda: guided(PLAIN, lambda x, y: Normal(0.9 * x, 0.02), N),
    "a priority of the best of all": lambda: auxiliary(PLAIN, lambda x, y: -abs(x - y) + abs(x - y).min(), N),
    "a guide of the mean": lambda: guide(lambda m, y: Normal(np.mean(m) + 0.0 * m if np.ndim(m) else m, 1.0)),
    "a guide in an interval": lambda: guide(lambda m, y: Uniform(m - 0.4, m + 0.4)),
    # programs
    "an observation weighted by rank": lambda: program(
        lambda x, y, previous: seen(x, y, 0.5 + np.argsort(np.argsort(x)) / len(x))
    ),
    "previous in another order": lambda: program(
        lambda x, y, previous: seen(x if previous is None else x + 0.1 * previous["x"][::-1], y)
    ),
    "numpy's noise on the observation": lambda: program(lambda x, y, previous: seen(x + 0.3 * np.random.normal(), y)),
}


def growing(rng, tracks):
    return tuple((*t, rng.normal()) if rng.random() < 0.3 else t for t in tracks)


def tempered(rng, x):
    accepted = rng.random(len(x)) < np.exp(-0.1 * abs(x))
    return np.where(accepted, x + rng.normal(size=len(x)), x)


CHAIN = np.array([[0.9, 0.1], [0.3, 0.7]])
RIGHT = {
    "functions": model,
    "densities": lambda: PLAIN,
    "an exact density": lambda: model(log_transition=lambda old, new: stats.norm.logpdf(new, 0.9 * old, 0.5)),
    "an exact initial density": lambda: model(log_initial=lambda x: stats.norm.logpdf(x)),
    "heavy tails": lambda: densities(lambda x: Student(2.5, 0.9 * x, 0.5)),
    "Cauchy": lambda: densities(lambda x: stats.cauchy(0.9 * x, 0.3)),
    "a bounded move": lambda: densities(lambda x: Uniform(x - 1.0, x + 1.0)),
    "gamma of scipy": lambda: densities(lambda x: stats.gamma(2.0 + x, scale=0.3), initial=stats.gamma(2.0)),
    "a noise that grows with the state": lambda: densities(lambda x: Normal(0.9 * x, 0.3 + 0.2 * abs(x))),
    "steps of a Metropolis kernel": lambda: model(tempered),
    "a loop over particles": lambda: model(lambda rng, x: np.array([v * 0.9 + 0.5 * rng.normal() for v in x])),
    "a list of numbers": lambda: model(lambda rng, x: np.asarray([rng.normal(0.9 * v, 0.5) for v in x])),
    "draws by inversion": lambda: model(lambda rng, x: stats.norm.ppf(rng.random(len(x)), 0.9 * x, 0.5)),
    "rvs of scipy": lambda: model(lambda rng, x: stats.norm.rvs(0.9 * x, 0.5, random_state=rng)),
    "a child of the generator": lambda: model(lambda rng, x: 0.9 * x + rng.spawn(1)[0].normal(size=len(x))),
    "counts": lambda: model(
        lambda rng, k: rng.binomial(k, 0.9) + rng.poisson(0.5, len(k)),
        lambda k, y: stats.norm.logpdf(y, k, 0.7),
        lambda rng, n: rng.poisson(3.0, n),
    ),
    "a chain": lambda: StateSpaceModel.of(
        Categorical([0.5, 0.5]), lambda k: Categorical(CHAIN[k]), lambda k: Normal(2.0 * k, 0.7)
    ),
    "hidden_markov": lambda: replace(
        hidden_markov([0.6, 0.4], CHAIN, lambda y: stats.norm.logpdf(y, [0.0, 2.0], 0.7)),
        sample_observation=lambda rng, k: rng.normal(2.0 * k, 0.7),
    ),
    "linear_gaussian": lambda: linear_gaussian([[0.9]], [[0.25]], [[1.0]], [[0.5]], [0.0], [[1.0]]),
    "nonlinear_gaussian": lambda: nonlinear_gaussian(
        lambda x: 0.9 * np.sin(x), [[0.3]], lambda x: x**2, [[0.5]], [0.0], [[1.0]]
    ),
    "vectors": vector,
    "vectors with a deterministic part": lambda: vector(
        lambda rng, x: np.stack([x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.3 * rng.normal(size=len(x))], axis=1)
    ),
    "vectors with dependent noise": lambda: vector(
        lambda rng, x: 0.9 * x + rng.normal(size=x.shape) @ np.array([[0.5, 0.2], [0.0, 0.4]])
    ),
    "a matrix density": lambda: vector(
        log_transition=lambda old, new: stats.norm.logpdf(new, 0.9 * old, 0.5).sum(axis=1)
    ),
    "a mapping": lambda: StateSpaceModel(
        lambda rng, n: {"x": rng.normal(size=n), "on": rng.random(n) < 0.5},
        lambda rng, p: {"x": p["x"] + p["on"] * rng.normal(size=len(p["x"])), "on": p["on"]},
        lambda p, y: stats.norm.logpdf(y, p["x"], 0.7),
        sample_observation=lambda rng, p: rng.normal(p["x"], 0.7),
    ),
    "objects": lambda: StateSpaceModel(
        lambda rng, n: tuple((rng.normal(),) for _ in range(n)),
        growing,
        lambda tracks, y: np.array([-((sum(t) - y) ** 2) for t in tracks]),
        sample_observation=lambda rng, tracks: np.array([sum(t) + rng.normal() for t in tracks]),
    ),
    "time": lambda: densities(lambda x, t: Normal(0.9 * x, 0.5 / t)),
    "time with a default": lambda: densities(lambda x, t=0, a=0.9: Normal(a * x, 0.5)),
    "a static parameter": lambda: vector(
        lambda rng, x: np.column_stack([x[:, 0] + abs(x[:, 1]) * rng.normal(size=len(x)), x[:, 1]])
    ),
    "a noiseless move": lambda: model(lambda rng, x: np.tanh(x)),
    "the same start for all": lambda: model(initial=lambda rng, n: np.zeros(n)),
    "binary observations": lambda: densities(lambda x: Normal(0.9 * x, 0.5), lambda x: Bernoulli(expit(x))),
    "impossible observations of some": lambda: densities(
        lambda x: Normal(0.9 * x, 0.5), lambda x: Uniform(x - 3.0, x + 3.0)
    ),
    "angles": lambda: model(
        lambda rng, a: (a + 0.3 * rng.normal(size=len(a)) + np.pi) % (2 * np.pi) - np.pi,
        lambda a, y: stats.vonmises.logpdf(y, 4.0, loc=a),
    ),
    "a guided filter": lambda: guided(PLAIN, lambda x, y: Normal(0.5 * (0.9 * x + y), 0.6), N),
    "a wide proposal": lambda: guided(PLAIN, lambda x, y: Student(3.0, y, 2.0), N),
    "an initial proposal": lambda: guided(PLAIN, None, N, lambda y: Normal(0.7 * y, 0.9)),
    "a lookahead": lambda: auxiliary(PLAIN, lambda x, y: Normal(0.9 * x, 1.0).log_prob(y), N),
    "a program": lambda: program(lambda x, y, previous: seen(x, y)),
    "a program that keeps values": lambda: program(lambda x, y, previous: seen(x, y) or {"square": x**2}),
    "a program with two observations": lambda: bootstrap(PLAIN, N),
    "a guide": lambda: guide(lambda m, y: Normal(0.5 * (m + y), 0.8)),
    "branches": lambda: Program(
        lambda previous, y: seen(
            switch(
                "s",
                [0.3, 0.7],
                [lambda m: sample("x", Normal(m, 0.3)), lambda m: sample("x", Normal(m + 1.0, 0.6))],
                np.zeros(N) if previous is None else previous["x"],
            )
            if previous is not None
            else sample("x", Normal(0.0, 1.0)),
            y,
        )
    ),
    "scipy in a program": lambda: Program(
        lambda previous, y: seen(sample("x", stats.t(4.0, 0.0 if previous is None else previous["x"], 0.5)), y)
    ),
    "a distribution of a user": lambda: Program(
        lambda previous, y: seen(sample("x", Scaled(np.zeros(1) if previous is None else previous["x"], 0.5)), y)
    ),
}
