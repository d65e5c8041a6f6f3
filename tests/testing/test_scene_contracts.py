"""Results of parts of scenes are checked in a run and by the contract, with one message."""

from __future__ import annotations

import functools
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from mstfilter import results
from mstfilter.completion import Completer
from mstfilter.errors import InputError, InputWarning
from mstfilter.partition import PartitionUpdate
from mstfilter.presets import REGISTRY
from mstfilter.scene import component_key, scene_cache
from mstfilter.segmentation import TreeCutProposal
from mstfilter.testing import STAGE_OWNERS, run_contract, scene_example
from mstfilter.tracking import StaticTest, TrackingTransition
from tests.testing import scene_faults as faults

OTHER_EVIDENCE = faults.Scores()


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
    return " ".join(r.failure for r in run_contract(component, example=scene_example) if r.failure)


@pytest.mark.parametrize("kind", [faults.Completes, faults.CompletesMany, faults.CompletesEach])
@pytest.mark.parametrize("fault", faults.PROBABILITIES)
def test_faulty_probabilities_are_errors(kind, fault):
    change, words = faults.PROBABILITIES[fault]
    message = message_of(kind(change=change))
    if kind is faults.CompletesEach and fault in ("axes", "one more axis", "flat", "one for the object"):
        words = "returns shape"
    assert words in message
    if fault != "exception":
        assert f"{kind.__name__}." in message and "scene_faults.py, line " in message


@pytest.mark.parametrize("fault", faults.PROBABILITIES)
def test_the_contract_reports_faulty_probabilities(fault):
    change, words = faults.PROBABILITIES[fault]
    assert words in failures_of(faults.Completes(change=change))


@pytest.mark.parametrize("kind", [faults.Completes, faults.CompletesMany])
@pytest.mark.parametrize("good", faults.GOOD_PROBABILITIES)
def test_other_types_of_probabilities_are_correct(kind, good):
    component = kind(change=faults.GOOD_PROBABILITIES[good])
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        step(component)
    assert failures_of(component) == ""


@pytest.mark.parametrize("fault", faults.STRANGE_PROBABILITIES)
def test_a_completer_that_ignores_what_is_seen_is_warned_of_once(fault):
    change, words = faults.STRANGE_PROBABILITIES[fault]
    with pytest.warns(InputWarning) as caught:
        for _ in range(3):
            scene_cache.clear()
            step(faults.Completes(change=change))
    assert len(caught) == 1
    assert words in str(caught[0].message) and "scene_faults.py, line " in str(caught[0].message)


@pytest.mark.parametrize("fault", faults.COMPLETERS)
def test_the_contract_reports_faulty_completers(fault):
    component, words = faults.COMPLETERS[fault]
    assert words in failures_of(component)


@pytest.mark.parametrize("fault", ["writes", "draws"])
def test_faulty_completers_are_errors(fault):
    component, words = faults.COMPLETERS[fault]
    assert words in message_of(component)


@pytest.mark.parametrize("fault", faults.MOTIONS)
def test_faulty_candidates_are_errors(fault):
    change, words = faults.MOTIONS[fault]
    component = faults.Moves(change=change)
    message = message_of(component)
    assert words in message and words in failures_of(component)
    if fault != "exception":
        assert "Moves.candidates (" in message and "scene_faults.py, line " in message


@pytest.mark.parametrize("fault", faults.CHOICES)
def test_faulty_choices_are_errors(fault):
    change, words = faults.CHOICES[fault]
    component = faults.Chooses(change=change)
    message = message_of(component)
    assert words in message and words in failures_of(component)
    assert "Chooses.choose (" in message and "scene_faults.py, line " in message


def test_a_rule_that_moves_objects_out_of_the_workspace_is_warned_of_once():
    component = faults.Moves(change=faults.TOO_FAR)
    with pytest.warns(InputWarning) as caught:
        step(component)
        step(component)
    assert len(caught) == 1
    assert "motions are in metres" in str(caught[0].message)


@pytest.mark.parametrize("fault", faults.RULES)
def test_the_contract_reports_faulty_rules(fault):
    component, words = faults.RULES[fault]
    assert words in failures_of(component)


def test_a_rule_that_changes_the_track_is_an_error():
    assert "in place" in message_of(faults.WritesIntoTheTrack())


@pytest.mark.parametrize("fault", faults.SCORES)
def test_faulty_scores_are_errors(fault):
    change, words = faults.SCORES[fault]
    component = faults.Scores(change=change)
    message = message_of(component)
    assert words in message and words in failures_of(component)
    if fault != "exception":
        assert "Scores.log_score (" in message and "scene_faults.py, line " in message


@pytest.mark.parametrize("good", faults.GOOD_SCORES)
def test_other_types_of_scores_are_correct(good):
    component = faults.Scores(change=faults.GOOD_SCORES[good])
    step(component)
    assert failures_of(component) == ""
    population, clip = scene_example(np.random.default_rng(1), 4)
    assert component.log_score(population.particles, clip).dtype == np.float64


@pytest.mark.parametrize("fault", faults.OTHERS)
def test_faults_of_other_parts_are_errors(fault):
    *definition, words = faults.OTHERS[fault]
    component = faults.faulty(*definition)
    message = message_of(component)
    assert words in message and f"Faulty.{definition[1]} (" in message
    assert words in failures_of(component)


@pytest.mark.parametrize("component", faults.CORRECT, ids=lambda c: type(c).__name__)
def test_correct_components_pass(component):
    assert failures_of(component) == ""
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        step(component)


@pytest.mark.parametrize("kind", ["completer", "rule"])
def test_completers_and_rules_of_the_package_keep_their_contract(kind):
    for name, where in REGISTRY.known(kind).items():
        if not where.startswith(("mstfilter.oracles:", "mstfilter.frontends:")):
            assert failures_of(REGISTRY.build(kind, name)) == "", name


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


def test_the_key_of_a_component_depends_on_its_checked_methods():
    def of(value):
        source = f"class Mine(Completer):\n def fill(self, rng, seen):\n  return seen.surface * {value}"
        namespace: dict[str, Any] = {"Completer": Completer, "__name__": "mine"}
        exec(source, namespace)
        return component_key(dataclass(frozen=True)(namespace["Mine"])())

    assert of(0.5) == of(0.5) != of(0.6)
