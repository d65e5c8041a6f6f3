"""Models of named variables, and guides that draw some of the sites.

A switching process of a discrete regime k and a position x, whose exact answers are sums over all regimes of Gaussian
evidences. Evidences by 40 runs at 5 standard errors: false alarm below 1e-4 for the file.
"""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Bernoulli,
    Categorical,
    Dynamics,
    Joint,
    Normal,
    Program,
    StateSpaceModel,
    backward_paths,
    bootstrap,
    conditional_path,
    guided,
    kalman_filter,
    keep,
    observe,
    sample,
    switch,
)

P0, MOVES = np.array([0.7, 0.3]), np.array([[0.9, 0.1], [0.4, 0.6]])
SD = np.array([0.2, 1.5])
YS = [
    {"seen": 0.3, "flag": True},
    {"seen": None, "flag": False},
    {"seen": 1.9, "flag": True},
    {"seen": 1.5, "flag": None},
]
FLAG = np.array([0.2, 0.7])

MODEL = StateSpaceModel.of(
    {"k": Categorical(P0), "x": Normal(0.0, 1.0)},
    lambda p: {"k": Categorical(MOVES[p["k"]]), "x": lambda new: Normal(0.9 * p["x"], SD[new["k"]])},
    lambda p: {"seen": Normal(p["x"], 0.5), "flag": Bernoulli(FLAG[p["k"]])},
)


def exact():
    """Log evidence, and the probability that the last regime is 1."""
    total, one = 0.0, 0.0
    for ks in product(range(2), repeat=4):
        p = P0[ks[0]] * np.prod([MOVES[a, b] for a, b in pairwise(ks)])
        p *= np.prod(
            [FLAG[k] if y["flag"] else 1 - FLAG[k] for k, y in zip(ks, YS, strict=True) if y["flag"] is not None]
        )
        Q = SD[list(ks)][:, None, None] ** 2
        p *= np.exp(
            kalman_filter([[0.9]], Q, [[1.0]], [[0.25]], [0.0], [[1.0]], [y["seen"] for y in YS]).log_evidence[-1]
        )
        total, one = total + p, one + p * ks[-1]
    return np.log(total), one / total


def program(previous, y):
    k = sample("k", Categorical(P0 if previous is None else MOVES[previous["k"]]))
    x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], SD[k]))
    observe("seen", Normal(x, 0.5), y["seen"])
    observe("flag", Bernoulli(FLAG[k]), y["flag"])


def look_at_x(previous, y):
    """Draws x alone, from a wide distribution around what is seen."""
    sample("x", Normal(0.0 if y["seen"] is None else y["seen"], 1.5 if previous is None else 2.0))


def look_at_k(previous, y):
    p = np.array([0.5, 0.5]) if y["flag"] is None else np.array([0.6, 0.4])
    sample("k", Categorical(p))


def reverse(p, y):
    """A proposal of both variables by name."""
    return {"k": Categorical(0.5 * MOVES[p["k"]] + 0.25), "x": lambda new: Normal(0.9 * p["x"], 1.2 * SD[new["k"]])}


FILTERS = {
    "model": bootstrap(MODEL, 200),
    "proposal": guided(MODEL, reverse, 200),
    "guide of x": Program(program).guided(look_at_x, 400),
    "guide of k": Program(program).guided(look_at_k, 200),
    "nothing guided": Program(program).guided(lambda previous, y: None, 200),
}


@pytest.mark.parametrize("name", FILTERS)
def test_the_evidence_is_exact(name):
    z, one = exact()
    runs = [FILTERS[name].run(YS, seed)[0] for seed in range(40)]
    ratio = np.exp([state.log_evidence - z for state in runs])
    assert abs(ratio.mean() - 1) < 5 * ratio.std(ddof=1) / np.sqrt(40)
    # The mean of an unnormalised estimate is unbiased.
    found = [r * (s.population.weights @ s.population.particles["k"]) for r, s in zip(ratio, runs, strict=True)]
    assert abs(np.mean(found) - one) < 5 * np.std(found, ddof=1) / np.sqrt(40)


def test_a_guide_of_nothing_is_the_bootstrap_filter():
    ours, plain = FILTERS["nothing guided"].run(YS, 1)[0], Program(program).bootstrap(200).run(YS, 1)[0]
    assert ours.log_evidence == plain.log_evidence


def test_a_guide_may_draw_a_site_in_one_branch_only():
    """y ~ N(x, 1) with x in two branches: the guide knows where the second is; against the exact mixture."""

    def model(previous, y):
        x = switch("s", [0.5, 0.5], [lambda: sample("x", Normal(0.0, 1.0)), lambda: sample("x", Normal(4.0, 0.5))])
        observe("y", Normal(x, 1.0), y)

    def guide(previous, y):
        def second():
            sample("x", Normal(3.5, 0.8))

        switch("s", [0.3, 0.7], [lambda: None, second])

    from scipy.stats import norm

    z = 0.5 * norm.pdf(3.0, 0.0, np.sqrt(2.0)) + 0.5 * norm.pdf(3.0, 4.0, np.sqrt(1.25))
    found = np.exp([Program(model).guided(guide, 300).run([3.0], seed)[0].log_evidence for seed in range(40)])
    assert abs(found.mean() - z) < 5 * found.std(ddof=1) / np.sqrt(40)


def test_conditional_smc_weighs_what_the_guide_draws():
    """Chains of paths from a guide of x alone: the share of regime 1 at the end, at 5 errors with autocorrelation."""
    filter, one = Program(program).guided(look_at_x, 12), exact()[1]
    path, found = None, []
    for seed in range(400):
        path = conditional_path(filter, YS, seed, path)
        found.append(path["k"][-1])
    blocks = np.reshape(found, (20, 20)).mean(axis=1)
    assert abs(np.mean(found) - one) < 5 * blocks.std(ddof=1) / np.sqrt(20)


def test_smoothing_and_simulation_have_the_variables():
    record = keep(bootstrap(MODEL, 50), YS, 0)
    paths = backward_paths(np.random.default_rng(0), record, Dynamics(MODEL), 20)
    assert sorted(paths[0].particles) == ["k", "x"] and len(paths[0]) == 20
    drawn = MODEL.sample_observation(np.random.default_rng(0), paths[0].particles)
    assert sorted(drawn) == ["flag", "seen"] and drawn["seen"].shape == (20,)


def test_a_joint_is_the_product_of_its_parts():
    joint = Joint({"a": Normal(1.0, 2.0), "b": lambda drawn: Normal(drawn["a"], 0.5)})
    value = joint.sample(np.random.default_rng(0), 5)
    wanted = Normal(1.0, 2.0).log_prob(value["a"]) + Normal(value["a"], 0.5).log_prob(value["b"])
    np.testing.assert_allclose(joint.log_prob(value), wanted)
    assert joint.mean == {"a": 1.0, "b": 1.0}


def test_what_is_refused():
    joint = Joint({"a": Normal(), "b": Normal()})
    with pytest.raises(InputError, match=r"the values have the variables \['a'\], expected \['a', 'b'\]"):
        joint.log_prob({"a": 1.0})
    with pytest.raises(InputError, match="expected .* found a ndarray|a ndarray, expected"):
        joint.log_prob(np.zeros(3))
    with pytest.raises(InputError, match=r"variable 'b' has shape \(3, 2\)"):
        joint.log_prob({"a": np.zeros(3), "b": np.zeros((3, 2))})
    with pytest.raises(InputError, match="which have no shape"):
        _ = joint.parameter_shape
    other = StateSpaceModel.of({"a": Normal()}, lambda p: {"b": Normal(p["a"], 1.0)}, lambda p: Normal(p["a"], 1.0))
    with pytest.raises(InputError, match="the transition returned shape {'b'"):
        bootstrap(other, 20).run([0.1, 0.2], 0)
    with pytest.raises(InputError, match="a site has one variable"):
        Program(lambda previous, y: sample("x", {"a": Normal()}) and None).bootstrap(20).run([0.1], 0)
