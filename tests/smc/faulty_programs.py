"""Programs with a fault, each with a part of the error that names it, and correct programs beside them.

`FAULTY` holds ``name: (filter, observations, expected part of the message)``, `INHERENT` faults that run without an
error, each with the reason, and `CORRECT` programs that must run.
"""

# ruff: noqa: NPY002, B006 (faults)
from __future__ import annotations

import itertools
import random
import time

import numpy as np
from scipy import stats

from mstfilter.smc import (
    Bernoulli,
    Categorical,
    Distribution,
    MultivariateNormal,
    Normal,
    Program,
    Residual,
    Student,
    Uniform,
    observe,
    sample,
    switch,
)

YS = [0.3, -0.2, 0.9, 1.4, 0.8, 0.1]
FAULTY: dict = {}
INHERENT: dict = {}
CORRECT: dict = {}
ALONE = "alone"
SWAP = np.array([[0.0, 1.0], [1.0, 0.0]])
REPEATED = "when (it|the step) is repeated with the same random numbers"


def into(table, *rest, ys=YS, n=200, guide=None):
    """Add the filter of a program to a table; the name of the function is that of the fault."""

    def add(model):
        program, name = Program(model), model.__name__
        assert name not in table
        table[name] = (program.guided(guide, n) if guide else program.bootstrap(n), ys, *rest)
        return model

    return add


def faulty(expected, **options):
    return into(FAULTY, expected, **options)


def correct(**options):
    return into(CORRECT, **options)


def walk(previous, scale=0.6):
    return sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], scale))


def seen(x, y, scale=0.5):
    observe("y", Normal(x, scale), y)


def draw(name, distribution):
    """`sample` for programs that return nothing."""
    sample(name, distribution)


def after_the_walk(add, **bodies):
    """Programs that draw x by `walk` and then do what ``body(x, y)`` does."""

    def program_of(body):
        return lambda previous, y: body(walk(previous), y)

    for name, body in bodies.items():
        program = program_of(body)
        program.__name__ = name
        add(program)


def in_transition(expected, **functions):
    """Programs with the transition density Normal(f(x_{t-1}), 0.6)."""

    def program_of(f):
        return lambda previous, y: seen(
            sample("x", Normal(0.0, 1.0) if previous is None else Normal(f(previous["x"]), 0.6)), y
        )

    for name, f in functions.items():
        program = program_of(f)
        program.__name__ = name
        faulty(expected)(program)


# --- reductions over the particles --------------------------------------------------------------------------------
in_transition(
    ALONE,
    the_first_particle_for_all=lambda x: 0.9 * x[0],
    sorted_particles=np.sort,
    a_median=np.median,
    a_mean_at_later_steps_only=lambda x: x.mean() + 0.0 * x,
)
after_the_walk(
    faulty(ALONE),
    a_mean_in_the_likelihood=lambda x, y: seen(0.5 * x + 0.5 * x.mean(), y),
    a_standardised_state=lambda x, y: seen((x - x.mean()) / x.std(), y),
    a_maximum_decides=lambda x, y: seen(x, y, 2.0 if x.max() > 1.5 else 0.5),
    any_decides=lambda x, y: seen(x if not (x > 1.0).any() else x - 1.0, y),
    a_dot_product_over_particles=lambda x, y: seen(x, y, 0.5 + 0.001 * (x @ x)),
    the_length_of_the_population=lambda x, y: seen(x.sum() / 200, y),
    half_of_the_particles_differ=lambda x, y: seen(np.where(np.arange(len(x)) < len(x) // 2, x, -x), y),
    weights_normalised_over_particles=lambda x, y: observe("y", Bernoulli(np.exp(x) / np.exp(x).sum()), 1),
    a_centred_state=lambda x, y: {"centred": x - x.mean()},
    a_parameter_by_position=lambda x, y: {"scale": np.linspace(0.1, 1.0, len(x))},
)


@faulty(ALONE)
def a_sum_without_axis(previous, y):
    v = sample("v", Normal(np.zeros((1, 2)) if previous is None else previous["v"], 1.0))
    observe("y", Normal(v.sum(), 1.0), y)


@faulty(ALONE, ys=[0.3, None, None, 0.2])
def a_mean_if_the_observation_is_missing(previous, y):
    m = 0.0 if previous is None else previous["x"].mean() if y is None else previous["x"]
    seen(sample("x", Normal(m, 0.6)), y)


@faulty(ALONE)
def a_number_of_particles_in_the_closure(previous, y):
    x = sample("x", Normal(np.zeros(200) if previous is None else 0.9 * previous["x"], 0.6))
    seen(x, y)


# --- guides -------------------------------------------------------------------------------------------------------
def model(previous, y):
    seen(walk(previous), y)


def guided_by(expected, **guides):
    for name, guide in guides.items():
        FAULTY[name] = (Program(model).guided(guide, 200), YS, expected)


def guide_by(m):
    return lambda previous, y: draw(
        "x", Normal(0.5 * y, 1.0) if previous is None else Normal(m(previous["x"], y), 0.5)
    )


guided_by(
    ALONE,
    a_guide_with_a_mean=guide_by(lambda x, y: x.mean()),
    a_guide_with_a_maximum=guide_by(lambda x, y: x if x.max() < 1 else x + y),
)
guided_by(REPEATED, a_guide_with_other_draws=guide_by(lambda x, y: x + np.random.normal(size=len(x))))
guided_by(
    "never draws",
    a_guide_of_positive_values=lambda previous, y: draw("x", stats.gamma(2.0, scale=0.5)),
    a_guide_with_a_bounded_interval=lambda previous, y: draw("x", Uniform(y - 0.5, y + 0.5)),
)
guided_by("never draws|no particle explains", a_guide_far_away=lambda previous, y: draw("x", Uniform(5.0, 6.0)))


def one_branch(previous, y):
    switch("regime", [1.0, 0.0], [lambda: draw("x", Normal(y, 1.0))] * 2)


@faulty("never draws", guide=one_branch)
def a_guide_of_one_branch(previous, y):
    x = switch("regime", [0.5, 0.5], [lambda: sample("x", Normal(0.0, 1.0)), lambda: sample("x", Normal(0.5, 1.0))])
    seen(x, y)


# --- draws outside of sample, and kept state ----------------------------------------------------------------------
GENERATOR, COUNT, LAST = np.random.default_rng(1), itertools.count(), {"x": 0.0}


def kept_values(x, kept=[]):
    kept.append(x)
    return kept


after_the_walk(
    faulty(REPEATED),
    draws_of_another_generator=lambda x, y: seen(x + 0.3 * GENERATOR.standard_normal(len(x)), y),
    draws_of_scipy=lambda x, y: seen(x + stats.norm.rvs(size=len(x)), y),
    draws_of_the_standard_library=lambda x, y: seen(x, y, 0.5 + random.random()),
    the_time=lambda x, y: seen(x, y, 0.5 + time.perf_counter() % 1.0),
    a_counter=lambda x, y: seen(x, y, 0.5 + 0.1 * next(COUNT)),
    a_mutable_default=lambda x, y: seen(x + 0.1 * len(kept_values(x)), y),
)
after_the_walk(
    faulty(ALONE),
    draws_of_a_new_generator=lambda x, y: seen(x + 0.3 * np.random.default_rng(0).standard_normal(len(x)), y),
)


@faulty(REPEATED)
def the_last_value_in_a_global(previous, y):
    x = sample("x", Normal(0.9 * np.mean(LAST["x"]), 0.6))
    LAST["x"] = x
    seen(x, y)


@faulty(REPEATED, ys=[np.array([0.3, 0.1]), np.array([0.2, 0.5])])
def a_changed_observation(previous, y):
    v = sample("v", Normal(np.zeros((1, 2)) if previous is None else previous["v"], 1.0))
    y += 0.1
    observe("y", Normal(v, 1.0), y)


# --- parameters out of range, in some rows ------------------------------------------------------------------------
for expected, bodies in {
    r"p of a Bernoulli is 1\.\d+ in row": {
        "a_probability_above_one": lambda x, y: draw("z", Bernoulli(0.8 + 0.5 * abs(x)))
    },
    r"scale of a Normal is -\S+ in row": {"a_negative_scale": lambda x, y: draw("z", Normal(0.0, x))},
    r"scale of a Normal is 0\.0 in row": {"a_scale_of_zero": lambda x, y: draw("z", Normal(x, np.maximum(x, 0.0)))},
    "loc of a Normal is nan in row": {"a_location_of_nan": lambda x, y: draw("z", Normal(np.sqrt(x), 1.0))},
    r"high of a Uniform is \S+ in row": {"an_empty_interval": lambda x, y: draw("z", Uniform(0.0, x))},
    "df of a Student is -": {"negative_degrees_of_freedom": lambda x, y: draw("z", Student(x, 0.0, 1.0))},
    "Domain error|is NaN|nan": {"a_negative_scale_of_scipy": lambda x, y: draw("z", stats.norm(0.0, x))},
    r"p of a Bernoulli is \S+ in row": {"a_negative_probability": lambda x, y: observe("y", Bernoulli(x), 1)},
    "log density is nan": {
        "a_negative_rate": lambda x, y: observe("y", stats.poisson(x), 0),
        "an_observed_nan_of_some_particles": lambda x, y: observe("y", stats.gamma(2.0), np.log(x)),
    },
    "probabilities of a categorical are .* in row": {
        "negative_probabilities": lambda x, y: observe("y", Categorical(np.stack([0.5 + x, 0.5 - x], axis=1)), 1)
    },
    "covariance is not positive definite in row": {
        "a_covariance_of_a_row": lambda x, y: observe(
            "y", MultivariateNormal(np.zeros((1, 2)), np.eye(2) + x[:, None, None] * SWAP), [0.3, 0.3]
        )
    },
}.items():
    after_the_walk(faulty(expected), **bodies)


@faulty("loc of a Normal is nan")
def a_value_of_another_branch(previous, y):
    x = walk(previous)
    switch("s", [0.5, 0.5], [lambda: draw("jump", Normal(1.0, 0.5)), lambda: None])
    if previous is not None:
        sample("z", Normal(previous["jump"], 1.0))
    seen(x, y)


# --- values that copies share, and changes in place ---------------------------------------------------------------
class Scaled:
    largest = 1e-3

    def __call__(self, previous, y):
        x = walk(previous)
        self.largest = max(self.largest, float(np.max(x)))
        seen(x / self.largest, y)


FAULTY["a_running_maximum_of_an_object"] = (Program(Scaled()).bootstrap(200), YS, ALONE)
FAULTY["a_running_maximum_of_a_method"] = (Program(Scaled().__call__).bootstrap(200), YS, ALONE)


@faulty("in place")
def previous_changed_in_place(previous, y):
    if previous is not None:
        previous["x"][:] = 0.9 * previous["x"]
    seen(walk(previous), y)


@faulty("item assignment")
def an_entry_of_previous_replaced(previous, y):
    if previous is not None:
        previous["x"] = previous["x"] + 1.0
    seen(walk(previous), y)


# --- names, sites and branches ------------------------------------------------------------------------------------
def branches(x, y, other, probs=(0.5, 0.5)):
    """Two branches: one observes its particles v, the other ``other(v)``."""
    switch("s", np.array(probs), [lambda v: seen(v, y), lambda v: seen(other(v), y)], x)


after_the_walk(
    faulty("the value is that of a site"), a_draw_observed_by_accident=lambda x, y: observe("x", Normal(0.0, 1.0), x)
)
after_the_walk(
    faulty("returned 'x' with other values than site"), a_returned_value_over_a_site=lambda x, y: {"x": np.round(x)}
)
after_the_walk(
    faulty("does not weight the particles"), weights_by_hand=lambda x, y: {"log_weights": -0.5 * (x - y) ** 2}
)
after_the_walk(
    faulty(ALONE),
    an_argument_in_another_order=lambda x, y: branches(x[::-1], y, lambda v: -v),
    a_branch_reduces_values_of_all=lambda x, y: branches(x, y, lambda v: x.mean() + 0.0 * v),
    a_branch_takes_the_first_rows_of_all=lambda x, y: branches(x, y, lambda v: x[: len(v)]),
    a_rare_branch_reduces=lambda x, y: branches(x, y, lambda v: v - v.mean(), (0.95, 0.05)),
    a_branch_returns_a_reduction=lambda x, y: seen(
        switch("s", [0.5, 0.5], [lambda v: v, lambda v: np.full(len(v), v.max(initial=-9.0))], x), y
    ),
)


# --- distributions of the user ------------------------------------------------------------------------------------
class Mine(Distribution):
    """A Gaussian around `mean`, whose parts the cases below replace."""

    def __init__(self, mean):
        self.centre_ = np.asarray(mean, np.float64)

    @property
    def mean(self):
        return self.centre_

    def sample(self, rng, size):
        return self.centre_ + 0.6 * rng.standard_normal(size)

    def log_prob(self, value):
        return stats.norm.logpdf(value, self.centre_, 0.6)


def of_mine(expected, method, **functions):
    """Programs that sample from `Mine` with another method."""

    def program_of(kind):
        return lambda previous, y: seen(
            sample("x", kind(np.zeros(1) if previous is None else 0.9 * previous["x"])), y
        )

    for name, function in functions.items():
        program = program_of(type(name, (Mine,), {method: function}))
        program.__name__ = f"a_distribution_{name}"
        faulty(expected)(program)


of_mine(
    "draws of .* do not have its density",
    "log_prob",
    OtherSign=lambda self, value: -Mine.log_prob(self, value),
    Density=lambda self, value: np.exp(Mine.log_prob(self, value)),
    Unnormalised=lambda self, value: Mine.log_prob(self, value) + 0.92,
    Variance=lambda self, value: stats.norm.logpdf(value, self.centre_, 0.36),
)
of_mine(
    ALONE + "|density",
    "log_prob",
    SumOverParticles=lambda self, value: np.full(len(np.atleast_1d(value)), Mine.log_prob(self, value).sum()),
)
of_mine(REPEATED, "sample", GlobalDraws=lambda self, rng, size: self.centre_ + 0.6 * np.random.standard_normal(size))
of_mine(
    "do not have its density|" + ALONE,
    "sample",
    OneDrawForAll=lambda self, rng, size: np.full(size, self.centre_ + 0.6 * rng.standard_normal()),
)
of_mine("continuous", "sample", Integers=lambda self, rng, size: np.round(Mine.sample(self, rng, size)).astype(int))
of_mine("draw is NaN", "sample", NanDraws=lambda self, rng, size: np.log(Mine.sample(self, rng, size)))


# --- faults that no check of a step can see -----------------------------------------------------------------------
def narrow(previous, y):
    sample("x", Normal(0.3 if previous is None else 0.9 * previous["x"], 0.4))


@into(INHERENT, "the guide has lighter tails than the posterior: the evidence has infinite variance", guide=narrow)
def a_guide_with_light_tails(previous, y):
    seen(walk(previous), y, 2.0)


def cut(previous, y):
    m = 0.0 if previous is None else 0.9 * previous["x"]
    sample("x", Uniform(m - 5.0, m + 5.0))


@into(INHERENT, "the guide never draws values that hold less than a thousandth of the probability", guide=cut)
def a_guide_without_far_tails(previous, y):
    seen(walk(previous, 1.0), y)


# --- correct programs ---------------------------------------------------------------------------------------------
CORRECT["model"] = (Program(model).bootstrap(200), YS)
CORRECT["missing_observations"] = (Program(model).bootstrap(200), [0.3, None, None, 0.2])
CORRECT["one_particle"] = (Program(model).bootstrap(1), YS)
CORRECT["two_particles"] = (Program(model).bootstrap(2), YS)


@correct(n=3)
def three_particles_with_vectors_of_three(previous, y):
    v = sample("v", Normal(np.zeros((1, 3)) if previous is None else previous["v"], 1.0))
    observe("y", Normal(v, 1.0), [y, y, y])
    observe("sum", Normal(v.sum(axis=1), 1.0), y)


@correct(ys=[np.array([0.1, 0.2])] * 4)
def vectors_with_a_shared_covariance(previous, y):
    cov = np.array([[1.0, 0.3], [0.3, 0.5]])
    v = sample(
        "v", MultivariateNormal(np.zeros(2), cov) if previous is None else MultivariateNormal(previous["v"], cov)
    )
    observe("y", MultivariateNormal(v, 0.5 * cov), y)


WEIGHTS = np.random.default_rng(0).standard_normal((64, 64)).astype(np.float32) / 8


@correct(n=1000)
def a_network_in_single_precision(previous, y):
    v = sample("v", Normal(np.zeros((1, 64)) if previous is None else previous["v"], 1.0))
    h = np.tanh(v.astype(np.float32) @ WEIGHTS) @ WEIGHTS
    observe("y", Normal(10.0 + h[:, 0], 0.05), 10.0 + y)
    return {"features": h}


@correct()
def a_switch_with_probabilities_of_particles(previous, y):
    x = walk(previous)
    p = 1 / (1 + np.exp(-x))
    z = switch("s", np.stack([p, 1 - p], axis=1), [lambda v: {"z": v}, lambda v: {"z": v + sample("j", Normal())}], x)
    seen(z["z"], y)
    return z


def wide(previous, y):
    sample("x", Normal(0.7 * y if previous is None else 0.5 * y + 0.5 * previous["x"], 1.0))


CORRECT["a_guide"] = (Program(model).guided(wide, 200), [0.3, None, 0.5])
CORRECT["a_guide_with_options"] = (Program(model).guided(wide, 200, resampler=Residual()), YS)


def excludes(previous, y):
    sample("k", Categorical([0.0, 0.5, 0.5] if y else [1.0, 0.0, 0.0]))


@correct(guide=excludes, ys=[1, 0, 1])
def a_guide_excludes_what_the_observation_excludes(previous, y):
    k = sample("k", Categorical([0.2, 0.3, 0.5]))
    observe("y", Bernoulli(k > 0), y)


def bounded(previous, y):
    sample("x", Uniform(y - 0.5, y + 0.5))


@correct(guide=bounded)
def a_bounded_guide_of_a_bounded_likelihood(previous, y):
    x = walk(previous)
    observe("y", Uniform(x - 0.5, x + 0.5), y)


@correct()
def scipy_distributions(previous, y):
    x = sample("x", stats.norm(0.0 if previous is None else 0.9 * previous["x"], 0.6))
    k = sample("k", stats.binom(5, 1 / (1 + np.exp(-x))))
    v = sample("v", stats.multivariate_normal([0.0, 1.0], np.eye(2)))
    observe("y", stats.norm(x + 0.1 * k + v[:, 0], 0.5), y)


@correct(ys=[0, 1, 1, 0])
def discrete_sites(previous, y):
    k = sample(
        "k", Categorical([0.5, 0.5] if previous is None else np.array([[0.9, 0.1], [0.2, 0.8]])[previous["k"]])
    )
    n = sample("n", stats.poisson(1.0 + k))
    observe("y", Bernoulli(np.array([0.2, 0.8])[k] ** (1 + n)), y)
    return {"total": n if previous is None else previous["total"] + n}


@correct()
def a_value_that_marks_absence(previous, y):
    x = walk(previous)
    seen(x, y)
    last = np.full(len(x), np.nan) if previous is None else previous["last"]
    return {"last": np.where(x > 0, x, last)}


@correct()
def a_site_that_some_need(previous, y):
    x = walk(previous)
    far = x > 1.0
    if far.any():
        x = np.where(far, sample("back", Normal(0.0, 0.5)), x)
    seen(x, y)


@correct()
def equal_values_are_computed_once(previous, y):
    k = sample("k", stats.poisson(2.0))
    distinct, index = np.unique(k, return_inverse=True)
    seen(np.sqrt(distinct)[index], y)


@correct()
def a_shift_that_cancels(previous, y):
    v = sample("v", Normal(np.zeros((1, 3)), 1.0))
    w = np.exp(v - v.max())
    k = sample("k", Categorical(w))
    seen(v[np.arange(len(k)), k], y)


CALLS: list = []


@correct()
def a_log_of_calls(previous, y):
    CALLS.append(y)
    seen(walk(previous), y)


@correct()
def residuals_of_particles(previous, y):
    x = walk(previous)
    observe("residual", Normal(0.0, 0.5), y - x)
    observe("factor", Normal(x, 3.0), 0.0)


@correct()
def a_distribution_of_the_user(previous, y):
    seen(sample("x", Mine(np.zeros(1) if previous is None else 0.9 * previous["x"])), y)


class Clipped(Distribution):
    """A mixture of a point at 0 and a half normal would have no density; this is a count with a bound."""

    discrete = True
    mean = np.float64(1.2)

    def sample(self, rng, size):
        return np.minimum(rng.poisson(1.4, size), 3)

    def log_prob(self, value):
        p = np.append(stats.poisson.pmf([0, 1, 2], 1.4), stats.poisson.sf(2, 1.4))
        return np.log(p)[np.asarray(value, int)]


@correct()
def a_discrete_distribution_of_the_user(previous, y):
    seen(sample("k", Clipped()) * 1.0, y)


@correct(n=1000)
def an_image_of_each_particle(previous, y):
    c = sample("c", Normal(np.zeros((1, 2)), 1.0))
    grid = np.arange(5.0) - 2
    image = np.exp(-((c[:, :1, None] - grid[None, :, None]) ** 2) - (c[:, 1:, None] - grid[None, None, :]) ** 2)
    observe("y", Normal(image, 0.3), np.eye(5))
