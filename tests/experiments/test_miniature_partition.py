"""The update of ``mst`` on the miniature world: motion and level sets against enumeration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from miniature_filters import level_sets, state_weights
from miniature_partition import (
    BEHIND,
    FREE,
    HIDDEN,
    OTHER,
    OWN,
    CellView,
    KnownPush,
    TableCompleter,
    fit,
    partition_filter,
)
from miniature_world import Miniature, Observation

from mstfilter.mst.partition import PairEvidence
from mstfilter.scene import Occupancy
from mstfilter.smc import Population
from tests.experiments.test_miniature_world import ids

QUIET = {"miss": 1e-9, "false_alarm": 1e-9}


@ids
def test_a_certain_hypothesis_moves_as_the_world_does(world):
    world = replace(world, slip=0.0)
    states = np.arange(len(world.states))
    everything = Population(world.states.take(states))
    for action in range(len(world.actions)):
        observation = Observation(np.zeros(world.shape[0], int), np.ones(world.shape[0] - 1, bool), action)
        moved = KnownPush(world).predict(np.random.default_rng(0), everything, observation)
        np.testing.assert_array_equal(world.states.index(moved.particles), world.pushed[action])
        occupied = np.stack([h.shares.probability.ravel() for h in moved.particles])
        np.testing.assert_array_equal(occupied, world.states.occupied[world.pushed[action]])


def test_level_sets_have_the_probabilities_of_cells_and_the_smaller_one_of_pairs():
    owner = np.array([1, 1, 2, 2, 1, 0]).reshape(6, 1, 1)
    p = np.array([1.0, 0.5, 0.75, 0.25, 0.0, 0.0]).reshape(6, 1, 1)
    sets = level_sets(Occupancy(owner, p))
    assert sum(share for _, share in sets) == pytest.approx(1)
    flat = [(labels.ravel(), share) for labels, share in sets]
    for a in range(6):
        for b in range(6):
            same = sum(share for labels, share in flat if labels[a] == labels[b] > 0)
            expected = min(p.ravel()[[a, b]]) if owner.ravel()[a] == owner.ravel()[b] else 0
            assert same == pytest.approx(expected)


def test_readings_without_noise_give_the_occupied_cells():
    world = Miniature((6, 1), **QUIET)
    completer, pairs = (
        TableCompleter(np.array([[1.0] * 4, [0.0] * 4, [0.5] * 4, [0.0] * 4, [0.0] * 4])),
        PairEvidence(),
    )
    truth, observations = world.simulate(np.random.default_rng(3), 6)
    for k, (state, _) in enumerate(partition_filter(world, 5, completer, pairs).iterate(observations, 0)):
        p = state_weights(world, state.population)
        assert p.sum() == pytest.approx(1)
        np.testing.assert_allclose(p @ world.states.occupied, world.states.occupied[truth[k]], atol=1e-9)


def test_the_table_is_asked_about_what_the_observation_and_the_latest_view_show():
    world = Miniature((3, 2))
    grid = world.states.hypotheses[0].grid
    completer = TableCompleter(np.arange(20).reshape(5, 4) / 20, [])
    observation = Observation(np.array([0, 1, 0]), np.ones(2, bool))
    frame = type("Frame", (), {"observation": observation})()
    old = CellView(np.full(grid.shape, FREE))
    views = (old, CellView(np.where(np.arange(3)[:, None, None] == 0, OWN, 3) * np.ones(grid.shape, int)))
    [completion] = completer.complete_each([], frame, [np.array([[True, True, False]])], grid, [views])
    view = completion.views[-1]
    now = np.array([[OWN, BEHIND], [FREE, OWN], [OTHER, HIDDEN]])[:, :, None]
    past = np.array([[OWN, OWN], [FREE, FREE], [FREE, FREE]])[:, :, None]
    expected = np.where(now == FREE, 0, completer.table[now, past])
    np.testing.assert_allclose(completion.probability, expected, rtol=1e-6)
    np.testing.assert_array_equal(view.cells, np.where(now <= BEHIND, now, 3))
    np.testing.assert_array_equal(completer.log[0][1], np.stack([now, past]))


@pytest.mark.nightly
def test_a_fit_learns_that_surface_is_occupied_and_is_the_same_again():
    world = Miniature((3, 2))
    completer, pairs = fit(world, range(12), n=5)
    assert ((completer.table > 0) & (completer.table < 1)).all()
    assert completer.table[OWN, 3] > 0.7 > 0.3 > completer.table[OTHER, 3]
    assert np.isfinite(list(vars(pairs).values())).all()
    (completer, pairs), again = (fit(world, range(3), n=3) for _ in range(2))
    np.testing.assert_array_equal(completer.table, again[0].table)
    assert pairs == again[1]
