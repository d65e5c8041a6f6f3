"""Every use of random numbers in a run has a stream of its own."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from mstfilter import preset
from mstfilter.smc import (
    Always,
    Branching,
    ClusterStratified,
    Coalesced,
    FearnheadClifford,
    Key,
    Kld,
    Never,
    Normal,
    Program,
    RandomWalkMove,
    Sized,
    auxiliary,
    bootstrap,
    guided,
    key_of,
    observe,
    resample_move,
    sample,
)
from mstfilter.smc.first_steps import unexamined
from tests.lab.baselines.scenes import slide
from tests.smc.models import AR1, ar1_observations, optimal, predictive

YS = ar1_observations(6)


def branching(filter, branches=2, **fields):
    return replace(filter, transition=Branching(filter.transition, branches), **fields)


def walk(previous, y):
    x = sample("x", Normal(0.0 if previous is None else previous["x"], 1.0))
    observe("y", Normal(x, 1.0), y)


def guide(previous, y):
    sample("x", Normal(0.0 if previous is None else previous["x"], 2.0))


ASSEMBLIES = {
    "bootstrap": branching(bootstrap(AR1, 8, trigger=Always())),
    "after": branching(bootstrap(AR1, 8, trigger=Always()), resample="after"),
    "without duplicates": branching(bootstrap(AR1, 8, Coalesced(FearnheadClifford()), Always())),
    "only the excess": branching(bootstrap(AR1, 8, trigger=Never())),
    "guided": branching(guided(AR1, optimal, 8, trigger=Always())),
    "auxiliary": branching(auxiliary(AR1, predictive, 8, trigger=Always())),
    "resample-move": branching(resample_move(AR1, RandomWalkMove(AR1, 0.5), 8, trigger=Always())),
    "clusters": branching(bootstrap(AR1, 8, ClusterStratified(), Always())),
    "KLD size": branching(bootstrap(AR1, 8, Sized(size=Kld(n_min=2, n_max=9)), Always())),
    "program": branching(Program(walk).guided(guide, 8, trigger=Always())),
}


def used_twice(monkeypatch, filter, observations) -> list[Key]:
    """Keys from which a run makes more than one generator."""
    made: Counter[Key] = Counter()

    def recorded(make):
        def spy(*args):
            rng = make(*args)
            made[key_of(rng)] += 1
            return rng

        return spy

    monkeypatch.setattr(Key, "generator", recorded(Key.generator))
    filter.run(observations, 3)
    assert len(made) >= len(observations)
    return [key for key, times in made.items() if times > 1]


@pytest.mark.parametrize("name", ASSEMBLIES)
def test_no_stream_is_used_twice(monkeypatch, name):
    with unexamined():  # an examination repeats calls with their streams
        assert not used_twice(monkeypatch, ASSEMBLIES[name], YS)


@pytest.mark.parametrize("name", ["mst", "paper", "authors"])
def test_no_stream_of_a_preset_is_used_twice(monkeypatch, tmp_path, name):
    assert not used_twice(monkeypatch, preset(name), list(slide(tmp_path / "recording").clips())[:3])
