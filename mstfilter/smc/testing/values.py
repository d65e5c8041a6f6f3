"""Contracts of triggers, sizes, lookaheads, similarities, equivalences and codecs.

These components return values, not particles. What they say about a population, a particle or a pair of particles
must not depend on the order of the particles, on the scale of the weights, or on copies:

>>> from dataclasses import dataclass
>>> from mstfilter.smc import Trigger
>>> from mstfilter.smc.testing import TriggerContract, check_properties
>>> @dataclass(frozen=True)
... class Heavy(Trigger):
...     def wants(self, population, t):
...         return bool(population.log_weights.max() > 0.0)                           # of unnormalised weights
>>> [result.name for result in check_properties(Heavy(), TriggerContract) if result.failure]
['scale_of_weights_is_irrelevant']
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, ClassVar
from unittest import SkipTest

import numpy as np

from mstfilter.smc import Population
from mstfilter.smc.testing.contract import (
    Contract,
    ScaleContract,
    close,
    prerequisite,
    reports_errors,
    same,
    seeded,
    skips_errors,
)

_SIZES = (1, 2, 9)
#: Selections of nine particles.
_SELECTIONS: dict[str, tuple[np.ndarray, ...]] = {
    "in another order": (np.arange(9)[::-1], seeded(1).permutation(9)),
    "if there are copies": (np.repeat(np.arange(9), 2), np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 3, 0])),
    "if only these are given": (np.array([7, 2, 4, 0, 8]), np.array([5, 1])),
}


class RowsContract(Contract):
    """Properties of components whose result does not depend on the order of the particles."""

    compared: ClassVar[tuple[str, ...]] = ("in another order", "if there are copies")  #: keys of the selections

    def relation(self, result: Any) -> np.ndarray:
        """The part of a result that the tests compare."""
        return np.asarray(result)

    def of_rows(self, relation: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """The part of a result that belongs to `rows` of the nine particles. Results are (), (9,) or pairs (9, 9)."""
        return relation[np.ix_(*[rows] * relation.ndim)]

    def test_order_of_particles_is_irrelevant(self) -> None:
        """The result for a particle or pair depends neither on the order of the particles nor on copies."""
        component = self.make()
        for seed in range(3):
            inputs = self.inputs(9, seed)
            every = self.relation(self.checked_call(component, inputs))
            for when in self.compared:
                for rows in _SELECTIONS[when]:
                    given = inputs["population"].take(rows)
                    found = self.relation(self.checked_call(component, {**inputs, "population": given}))
                    assert np.allclose(found, self.of_rows(every, rows), rtol=1e-6, atol=1e-6), (
                        f"the same particles have another result {when}"
                    )


class DecisionContract(ScaleContract, RowsContract):
    """Properties of triggers and sizes, which give one answer per population."""

    compared = ("in another order",)


class TriggerContract(DecisionContract):
    """The contract of every `Trigger`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        return component.wants(inputs["population"], 2)

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert isinstance(result, (bool, np.bool_)), f"it returns {result!r}, expected True or False"

    def test_weights_of_zero_count_like_tiny_ones(self) -> None:
        """It does not stop to resample if a particle has the weight 0: 0 log 0 is 0, not NaN."""
        component, answers = self.make(), []
        for seed in range(6):
            population = self.inputs(9, seed)["population"]
            steep = np.linspace(0.0, -6.0 * seed, 9)
            for least in (-np.inf, -700.0):
                given = Population(population.particles, np.append(steep[:-1], least))
                with np.errstate(all="ignore"):
                    answers.append(bool(self.checked_call(component, {"population": given})))
        with_zero, with_tiny = answers[::2], answers[1::2]
        assert any(with_zero) or not any(with_tiny), (
            "with a particle of weight 0 it never resamples, and with a weight of 1e-304 instead it does: is 0 log 0 "
            "NaN?"
        )


class SizeContract(DecisionContract):
    """The contract of every `Size`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        return component.choose(inputs["population"])

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        valid = isinstance(result, (int, np.integer)) and not isinstance(result, bool) and result >= 1
        assert valid, f"it returns {result!r}, expected an int of at least 1"


class ScoreContract(RowsContract):
    """Properties of components that return one number per particle."""

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n = len(inputs["population"])
        assert np.shape(result) == (n,), f"scores of {n} particles have shape {np.shape(result)}, expected ({n},)"
        wrong = result[~np.isfinite(result)]
        assert not len(wrong), f"a score is {wrong[0]}: it rules the particle out, bound it from below"


class LookaheadContract(ScoreContract):
    """The contract of every `Lookahead`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        return np.asarray(component.log_priority(inputs["population"], inputs["observation"]), dtype=np.float64)

    def test_ignores_weights(self) -> None:
        """The priorities do not depend on the weights. The filter multiplies priorities and weights."""
        component, inputs = self.make(), self.inputs(6)
        scores = self.checked_call(component, inputs)
        for log_weights in (np.linspace(0, 2, 6), np.full(6, 1000.0), np.full(6, -1000.0)):
            population = Population(inputs["population"].particles, log_weights)
            assert close(self.checked_call(component, {**inputs, "population": population}), scores), (
                "other log weights of the same particles change the priorities: the weights would count twice"
            )


class PairsContract(RowsContract):
    """Properties of similarities and equivalences, which relate pairs of particles."""

    compared = tuple(_SELECTIONS)


class SimilarityContract(PairsContract):
    """The contract of every `Similarity`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        found = np.asarray(component.matrix(inputs["population"].particles))
        return found.astype(np.float64) if found.dtype == bool else found

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n = len(inputs["population"])
        assert result.shape == (n, n), f"similarities of {n} particles have shape {result.shape}, expected ({n}, {n})"
        assert np.isfinite(result).all() and result.min() >= -1e-9 and result.max() <= 1 + 1e-9, (
            f"similarities are in [{np.min(result):.3g}, {np.max(result):.3g}], expected finite ones in [0, 1]"
        )
        assert np.allclose(np.diag(result), 1.0, atol=1e-9), (
            f"a particle has similarity {np.diag(result).min():.3g} to itself, expected 1"
        )
        i, j = np.unravel_index(np.argmax(np.abs(result - result.T)), result.shape)
        assert abs(result[i, j] - result[j, i]) <= 1e-9, (
            f"the similarity of particles {i} and {j} is {result[i, j]:.4g}, and of {j} and {i} {result[j, i]:.4g}"
        )

    def test_works_for_vectors_anywhere(self) -> None:
        """Vectors at the origin, equal ones, and ones far from the origin have valid similarities."""
        if not self.on_numbers:
            raise SkipTest("the particles have an example of their own")
        rows = seeded(2).standard_normal((9, 3))
        for what, x in (
            ("a particle is 0", np.where(np.arange(9) == 4, 0.0, rows[:, 0])),
            ("all particles are equal", np.full(9, 0.7)),
            ("a vector is 0", np.where(np.arange(9)[:, None] == 4, 0.0, rows)),
            ("vectors are far from the origin", 1000.0 + rows),
        ):
            if x.ndim == 2:
                with skips_errors():
                    self.call(self.make(), seeded(), {"population": Population(rows)})
            try:
                with np.errstate(all="ignore"):
                    self.checked_call(self.make(), {"population": Population(x)})
            except AssertionError as error:
                raise AssertionError(f"if {what}: {error}") from error


class EquivalenceContract(PairsContract):
    """The contract of every `Equivalence`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        return np.asarray(component.classes(inputs["population"].particles))

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n = len(inputs["population"])
        assert result.shape == (n,) and np.issubdtype(result.dtype, np.integer), (
            f"classes of {n} particles are {result.dtype} {result.shape}, expected int ({n},)"
        )
        highest = np.maximum.accumulate(np.concatenate([[-1], result]))
        assert (result >= 0).all() and (result <= highest[:-1] + 1).all(), (
            f"classes are {result.tolist()}, expected numbers 0, 1, ... in the order of the first particles"
        )

    def relation(self, result: np.ndarray) -> np.ndarray:
        return result[:, None] == result


class CodecContract(Contract):
    """The contract of every `Codec`."""

    returns = Mapping

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        return component.encode(inputs["population"].particles)

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        for name, array in result.items():
            assert isinstance(name, str), f"encode names an array {name!r}, expected a str"
            kind = type(array).__name__
            assert isinstance(array, np.ndarray), f"encode returns a {kind} as {name!r}, expected an array"
            assert not array.dtype.hasobject, f"{name!r} is an array of Python objects, which needs pickle"

    @prerequisite
    def test_decoded_particles_are_equal(self) -> None:
        """Particles are encoded as named arrays, and decoded particles equal the encoded particles bit by bit."""
        component = self.make()
        for n in (*_SIZES, 300):
            population = self.inputs(n)["population"]
            with_copy = population.take(np.repeat(np.arange(n), 2)[: n + 1])  # a resampling leaves copies
            for stored in (population, with_copy):
                fresh = copy.deepcopy(component)  # as in a new process, which has encoded nothing
                arrays = self.checked_call(component, {"population": stored})
                with reports_errors(f"decode {n} particles"):
                    found = Population(fresh.decode(arrays))
                again = self.checked_call(fresh, {"population": found})
                assert same(found.particles, stored.particles) and same(dict(again), dict(arrays)), (
                    f"{n} particles that were encoded and decoded are not the same"
                )
