"""Fields out of range and parts of the wrong kind are one clear error, when the component is made."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.base.fields import Bounded
from mstfilter.smc import (
    Coalesced,
    EssBelow,
    Gaussian,
    Kld,
    Normal,
    ParticleFilter,
    Population,
    Program,
    RandomWalkMove,
    StateSpaceModel,
    Student,
    Systematic,
    Tempered,
    Uniform,
    bootstrap,
    linear_gaussian,
    observe,
    sample,
)
from tests.smc.models import AR1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: EssBelow(2), "share is 2, expected a finite number above 0 and of at most 1"),
        (lambda: EssBelow(True), "share is True"),
        (lambda: Kld(n_min=7, n_max=6), "n_max is 6, expected an integer of at least 7"),
        (lambda: Tempered(Systematic, 0.5), "scheme is the class Systematic, expected a Resampler"),
        (lambda: Coalesced(equivalence=Gaussian()), "expected an Equivalence"),
        (lambda: RandomWalkMove(AR1, steps=0), "steps is 0"),
        (lambda: RandomWalkMove(AR1, scale=-1.0), "scale is -1"),
        (lambda: RandomWalkMove(AR1, scale=[1.0, np.nan]), "scale is"),
        (lambda: bootstrap(AR1, 2.0), r"n is 2\.0"),
        (lambda: replace(bootstrap(AR1, 2), n_proposed=-1), "n_proposed is -1"),
        (lambda: bootstrap(AR1, 5, Systematic), "resampler is the class Systematic"),
        (lambda: replace(bootstrap(AR1, 5), trigger=0.5), r"trigger is 0\.5, expected a Trigger"),
        (lambda: replace(bootstrap(AR1, 5), resampler=None), "resampler is None"),
        (lambda: ParticleFilter(initial=AR1), "initial is StateSpaceModel"),
        (lambda: StateSpaceModel.of(Normal(0, 1), Normal(0, 1), lambda x: Normal(x, 1)), "transition is Normal"),
    ],
)
def test_nonsense_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


LG = {"F": [[0.9]], "Q": [[0.5]], "H": [[1.0]], "R": [[1.0]], "m0": [0.0], "P0": [[1.0]]}


def first_steps(**changes):
    """Two steps of a bootstrap filter of a changed AR(1) model."""
    return bootstrap(replace(AR1, **changes), 5).run([0.1, 0.2], 0)


def decides(previous, y):
    x = sample("x", Normal(0.0, 1.0))
    if x > 0:
        observe("y", Normal(x, 1.0), y)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Normal(0.0, -1.0), r"scale of a Normal is -1\.0, expected a positive number"),
        (lambda: Student(0.0), "df of a Student"),
        (lambda: Uniform(1.0, 1.0), r"high of a Uniform is 1\.0, expected a finite number above low"),
        (
            lambda: Program(decides).bootstrap(5).run([0.1], 0),
            "step 0, initial: an array .* decides",
        ),
        (lambda: linear_gaussian(**{**LG, "Q": [[-1.0]]}), "Q is .*positive semidefinite"),
        (lambda: linear_gaussian(**{**LG, "F": np.eye(2)}), r"F has shape \(2, 2\), expected \(1, 1\)"),
        (lambda: linear_gaussian(**{**LG, "m0": 0.0}), "m0 has shape"),
        (lambda: first_steps(log_likelihood=lambda x, y: -1.0), r"log likelihood has shape \(\), expected \(5,\)"),
        (lambda: first_steps(log_likelihood=lambda x, y: x[:, None]), r"log likelihood has shape \(5, 1\)"),
        (
            lambda: first_steps(sample_initial=lambda rng, n: np.zeros(n + 1)),
            "step 0, initial: asked for 5 .* returned 6",
        ),
        (lambda: first_steps(sample_transition=lambda rng, x: x[:3]), "step 1, transition: 5 particles became 3"),
        (lambda: Systematic().select(np.random.default_rng(0), np.zeros(3), 2.5), r"resampling to 2\.5 particles"),
    ],
)
def test_faults_of_models_are_named(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_hints_say_what_was_meant():
    with pytest.raises(InputError) as raised:
        Population(np.zeros(2), np.full(2, np.nan))
    assert raised.value.hints == (
        "is a parameter of a distribution out of range, such as a scale of 0?",
        "is the observation NaN? one that is missing is None",
    )

    with pytest.raises(InputError) as raised:
        EssBelow(50)
    assert "share is relative to the number of particles" in raised.value.hints[0]
    with pytest.raises(InputError) as raised:
        bootstrap(AR1, 5, Systematic)
    assert raised.value.hints == ("pass an instance: resampler=Systematic(...)",)


def test_a_class_whose_annotations_are_unknown_is_named():
    @dataclass(frozen=True)
    class Local(Bounded):
        n: "Unknown" = 1  # noqa: F821, UP037

    with pytest.warns(InputWarning, match="fields of .*Local are not checked.*'Unknown' is not defined"):
        Local(n=-1)
