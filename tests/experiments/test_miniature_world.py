"""The miniature world: probabilities sum to one, the samplers follow them, the exact filter equals a sum over paths.

Statistical tests reject a right sampler with probability 1e-4 each.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from miniature_filters import exact_filter
from miniature_world import Miniature, Observation, States
from scipy import stats

from mstfilter.scene import Hypothesis

FALSE_ALARM = 1e-4
WORLDS = [Miniature((3, 2)), Miniature((6, 1))]
ids = pytest.mark.parametrize("world", WORLDS, ids=lambda w: f"{w.shape[0]}x{w.shape[1]}")


def state_of(world, rows):
    """The state of a picture: each string holds the digits of one column of cells."""
    return world.states.index_of_labels(np.array([[int(k) for k in row] for row in rows], np.uint16))


def observations_of(world):
    X, Y = world.shape
    for depth in product(range(Y + 1), repeat=X):
        for joined in product((False, True), repeat=X - 1):
            yield Observation(np.array(depth), np.array(joined, dtype=bool))


@pytest.mark.parametrize(("shape", "bell"), [((1, 1), 2), ((2, 2), 52), ((5, 1), 203), ((3, 2), 877), ((7, 1), 4140)])
def test_states_are_the_partitions_of_the_cells_and_free_space(shape, bell):
    states = States(shape)
    assert len(states) == bell
    assert len({row.tobytes() for row in states.labels}) == bell


def test_names_of_objects_do_not_matter():
    rng = np.random.default_rng(0)
    states = States((3, 2))
    for s in rng.integers(len(states), size=50):
        renamed = np.concatenate([[0], 1 + rng.permutation(60)])[states.labels[s]].astype(np.uint16)
        assert states.index([Hypothesis.from_labels(renamed.reshape(3, 2, 1), states.hypotheses[s].grid)])[0] == s
    np.testing.assert_array_equal(states.index(states.hypotheses), np.arange(len(states)))


@ids
def test_prior_and_motion_probabilities_sum_to_one(world):
    S = len(world.states)
    assert world.prior.sum() == pytest.approx(1)
    rng = np.random.default_rng(1)
    for old, action, rearranged in zip(rng.integers(S, size=12), [*range(11), None], [True, False] * 6, strict=True):
        assert world.predict(np.eye(S)[old], action, rearranged).sum() == pytest.approx(1)


@ids
def test_sensor_probabilities_sum_to_one(world):
    total = sum(np.exp(world.log_likelihood(g)) for g in observations_of(world))
    np.testing.assert_allclose(total, 1.0, rtol=1e-10)


def test_pushes_of_known_states():
    """x downwards, y (away from the camera) to the right."""
    world = Miniature((3, 2))
    cases = [
        (["10", "10", "00"], (0, (0, 1)), ["01", "01", "00"]),  # both cells of the object move back
        (["10", "20", "00"], (2, (1, 0)), ["10", "00", "20"]),
        (["10", "20", "00"], (0, (1, 0)), ["10", "20", "00"]),  # the other object is in the way
        (["10", "10", "10"], (0, (1, 0)), ["10", "10", "10"]),  # the rim is in the way
        (["10", "11", "00"], (2, (1, 0)), ["00", "10", "11"]),  # whichever of its cells is pushed
        (["10", "00", "02"], (3, (0, -1)), ["10", "00", "02"]),  # an empty cell
    ]
    for before, (cell, step), after in cases:
        action = world.actions.index((cell, step))
        assert world.pushed[action, state_of(world, before)] == state_of(world, after)


def test_hidden_cells_do_not_change_the_observation():
    world = Miniature((3, 2))
    a, b = state_of(world, ["10", "02", "00"]), state_of(world, ["13", "02", "00"])
    assert world.surface[a].tolist() == world.surface[b].tolist() == [0, 1, 2]
    assert world.same_surface[a].tolist() == [False, False]
    one = state_of(world, ["10", "11", "00"])
    assert world.same_surface[one].tolist() == [True, False]
    for g in list(observations_of(world))[::7]:
        assert world.log_likelihood(g)[a] == world.log_likelihood(g)[b]


def test_sensor_and_motion_follow_their_probabilities():
    world = Miniature((3, 2))
    rng = np.random.default_rng(2)
    state, n = state_of(world, ["10", "11", "02"]), 4000
    observations = list(observations_of(world))
    number = {(tuple(g.depth), tuple(g.joined)): k for k, g in enumerate(observations)}
    p = np.exp([world.log_likelihood(g)[state] for g in observations])
    drawn = [world.observe(rng, state) for _ in range(n)]
    assert chi_square([number[tuple(g.depth), tuple(g.joined)] for g in drawn], p) > FALSE_ALARM
    for action in (4, None):
        f = world.predict(np.eye(len(world.states))[state], action)
        assert chi_square(world.move(rng, np.full(n, state), action), f) > FALSE_ALARM


def chi_square(drawn, p):
    """p value; rare classes are merged."""
    counts, expected = np.bincount(drawn, minlength=len(p)), p * len(drawn)
    rare = expected < 5
    observed = np.append(counts[~rare], counts[rare].sum())
    wanted = np.append(expected[~rare], expected[rare].sum())
    return stats.chisquare(observed, wanted * observed.sum() / wanted.sum()).pvalue


# --- the exact filter against a sum over all paths, from the world's description alone ---------------------------
SMALL = Miniature((2, 2), slip=0.2, rearranged=0.1, miss=0.12, false_alarm=0.07, split=0.3, merge=0.1)


def naive_seen(grid):
    """Surface and label at each pixel of a label grid (X, Y)."""
    out = []
    for column in grid:
        hits = [y for y, k in enumerate(column) if k]
        out.append((hits[0], column[hits[0]]) if hits else (len(column), 0))
    return out


def naive_likelihood(world, grid, observation):
    p, Y, seen = 1.0, world.shape[1], naive_seen(grid)
    for (d, _), r in zip(seen, observation.depth, strict=True):
        near = world.false_alarm if d > 0 else 0.0
        far = world.miss if d < Y else 0.0
        p *= 1 - near - far if r == d else near / d if r < d else far / (Y - d)
    for (_, a), (_, b), joined in zip(seen[:-1], seen[1:], observation.joined, strict=True):
        q = 1 - world.split if a == b else world.merge
        p *= q if joined else 1 - q
    return p


def naive_push(grid, cell, step):
    X, Y = len(grid), len(grid[0])
    label = grid[cell // Y][cell % Y]
    if label == 0:
        return grid
    out = [[0 if k == label else k for k in column] for column in grid]
    for x, y in product(range(X), range(Y)):
        if grid[x][y] == label:
            u, v = x + step[0], y + step[1]
            if not (0 <= u < X and 0 <= v < Y) or out[u][v] not in (0, label):
                return grid
            out[u][v] = label
    return out


def naive_name(grid):
    names = {0: 0}
    return tuple(names.setdefault(k, len(names)) for column in grid for k in column)


def test_the_exact_filter_is_the_sum_over_all_paths():
    world = SMALL
    grids = [row.reshape(2, 2).tolist() for row in world.states.labels]
    number = {naive_name(g): s for s, g in enumerate(grids)}
    prior, S = world.prior, len(grids)
    _, observations = world.simulate(np.random.default_rng(5), 3)
    joint = prior * [naive_likelihood(world, g, observations[0]) for g in grids]
    for y in observations[1:]:
        cell, step = world.actions[y.action]
        f = np.tile(world.rearranged * prior, (S, 1))
        for s, grid in enumerate(grids):
            f[s, s] += (1 - world.rearranged) * world.slip
            f[s, number[naive_name(naive_push(grid, cell, step))]] += (1 - world.rearranged) * (1 - world.slip)
        g = np.array([naive_likelihood(world, grid, y) for grid in grids])
        joint = joint[..., :, None] * f * g  # one axis per step: one entry per path
    exact = exact_filter(world, observations)
    assert joint.shape == (S, S, S)
    assert exact.log_evidence[-1] == pytest.approx(np.log(joint.sum()), abs=1e-12)
    np.testing.assert_allclose(exact.posterior[-1], joint.sum(axis=(0, 1)) / joint.sum(), atol=1e-14)


def test_a_missing_observation_is_marginalised():
    """Its push is unknown too: the mean over all pushes."""
    world = SMALL
    _, observations = world.simulate(np.random.default_rng(6), 3)
    total = 0.0
    for y in observations_of(world):
        for action in range(len(world.actions)):
            whole = [observations[0], Observation(y.depth, y.joined, action), observations[2]]
            total += np.exp(exact_filter(world, whole).log_evidence[-1]) / len(world.actions)
    exact = exact_filter(world, [observations[0], None, observations[2]])
    assert np.exp(exact.log_evidence[-1]) == pytest.approx(total, rel=1e-10)
