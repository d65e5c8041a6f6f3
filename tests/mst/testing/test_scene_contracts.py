"""Results of parts of scenes are checked in a run and by the contract, with one message."""

from __future__ import annotations

import functools
import re
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from mstfilter.base import results
from mstfilter.base.errors import InputError, InputWarning
from mstfilter.mst.completion import Completer
from mstfilter.mst.partition import PartitionUpdate
from mstfilter.mst.segmentation import TreeCutProposal
from mstfilter.mst.testing import STAGE_OWNERS, run_contract, scene_example
from mstfilter.mst.tracking import StaticTest, TrackingTransition
from mstfilter.scene import scene_cache
from tests.mst.testing import scene_faults as faults


@pytest.fixture(autouse=True)
def nothing_known():
    """Results and warnings of earlier tests are forgotten."""
    scene_cache.clear()
    results._WARNED.clear()


def step(component: Any) -> None:
    """Use a component in a filter's step."""
    population, clip = scene_example(np.random.default_rng(1), 4)
    rng = np.random.default_rng(0)
    if isinstance(component, faults.Evidence):
        update = PartitionUpdate(evidence=(component,))
        update.update(rng, population, population, clip).realised()
        return
    owner = next(use for interface, use in STAGE_OWNERS.items() if isinstance(component, interface))(component)
    if isinstance(owner, TrackingTransition):
        replace(owner, static=StaticTest(enabled=False)).predict(rng, population, clip)
    elif isinstance(owner, TreeCutProposal):
        owner.sample(rng, clip, 4)
    else:
        owner.update(rng, population, population, clip).realised()


def message_of(component: Any) -> str:
    """Message and hints of the error of a step."""
    with pytest.raises(Exception) as caught:
        step(component)
    error = caught.value
    if isinstance(error, InputError):
        return " ".join([error.message, *error.hints])
    assert "my own fault" in str(error), error
    return str(error)


def failures_of(component: Any) -> str:
    return " ".join(r.failure for r in run_contract(component, scene_example) if r.failure)


@pytest.mark.parametrize("name", faults.ERRORS)
def test_faults_are_errors_of_a_run_and_of_the_contract(name):
    component, method, words = faults.ERRORS[name]
    message = message_of(component)
    assert words in message and words in failures_of(component)
    if "my own fault" not in words:
        assert f"{type(component).__name__}.{method} (" in message and "scene_faults.py, line " in message


@pytest.mark.parametrize("kind", [faults.CompletesMany, faults.CompletesEach])
@pytest.mark.parametrize("fault", ["one nan", "axes", "none", "exception"])
def test_faulty_probabilities_of_other_methods_are_errors(kind, fault):
    change, words = faults.PROBABILITIES[fault]
    if kind is faults.CompletesEach and fault == "axes":
        words = "returns shape"
    message = message_of(kind(change=change))
    assert words in message and (f"{kind.__name__}." in message or fault == "exception")


@pytest.mark.parametrize("name", faults.ONLY_BROKEN)
def test_the_contract_reports_what_a_run_cannot_know(name):
    component, words = faults.ONLY_BROKEN[name]
    assert words in failures_of(component)


@pytest.mark.parametrize(
    "component", [faults.WritesIntoTheBox(), faults.DrawsUndeclared(), faults.WritesIntoTheTrack()]
)
def test_changed_arguments_and_undeclared_draws_are_errors(component):
    assert re.search("in place|`stochastic` is False", message_of(component))


@pytest.mark.parametrize("name", faults.WARNINGS)
def test_strange_results_are_warned_of_once(name):
    component, words = faults.WARNINGS[name]
    with pytest.warns(InputWarning) as caught:
        for _ in range(3):
            scene_cache.clear()
            step(component)
    assert len(caught) == 1
    assert words in str(caught[0].message) and "scene_faults.py, line " in str(caught[0].message)


@pytest.mark.parametrize("component", [*faults.CORRECT, *faults.OTHER_TYPES], ids=lambda c: type(c).__name__)
def test_correct_components_pass(component):
    assert failures_of(component) == ""
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        step(component)


def test_methods_of_any_form_are_checked():
    """Methods of other base classes, static and decorated ones are checked; base methods are not checked twice."""

    class Mixin:
        def fill(self, rng, seen):
            return None

    @dataclass(frozen=True)
    class OfMixin(Mixin, Completer):
        pass

    @dataclass(frozen=True)
    class Static(Completer):
        @staticmethod
        def fill(rng, seen):
            return None

    @dataclass(frozen=True)
    class Cached(Completer):
        @functools.cache  # noqa: B019 (one instance)
        def fill(self, rng, seen):
            return None

    for cls in (OfMixin, Static, Cached):
        assert f"{cls.__name__}.fill (" in message_of(cls()), cls

    @dataclass(frozen=True)
    class Repairs(faults.Completes):
        """Its base class returns percent."""

        def fill(self, rng, seen):
            return super().fill(rng, seen) / 100

    step(Repairs(change=lambda p: 100 * p))
