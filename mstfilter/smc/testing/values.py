"""Contracts without random numbers: triggers, sizes, lookaheads, similarities, equivalences and codecs."""

from __future__ import annotations

import copy
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from mstfilter.smc import Population
from mstfilter.smc.testing.contract import (
    BatchedContract,
    Contract,
    close,
    prerequisite,
    reports_errors,
    same,
    seeded,
)

_SIZES = (1, 2, 9)


class DecisionContract(Contract):
    """Properties of triggers and sizes, which give one answer per population."""

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"population": self.example(seeded(seed), n)[0], "t": 2}

    def populations(self) -> list[Population]:
        """1, 2 and 12 particles with unequal weights; 12 with equal ones, a dominant one, zeros, and copies."""
        rng = seeded()
        populations = [self.example(rng, n)[0] for n in (1, 2, 12)]
        particles = populations[-1].particles
        peaked = np.where(np.arange(12) == 5, 0.0, -80.0)
        zeros = np.where(np.arange(12) < 5, -np.inf, 0.0)
        weighted = [Population(particles, lw) for lw in (np.zeros(12), peaked, zeros)]
        copies = populations[-1].take(np.repeat(np.arange(4), 3))
        return [*populations, *weighted, copies]

    def test_answers(self) -> None:
        """It gives one answer for any population and time: a trigger True or False, a size an integer above 0."""
        component = self.make()
        for population in self.populations():
            for t in (0, 1, 7, 10_000):
                answers = [self.checked_call(component, {"population": population, "t": t}) for _ in range(12)]
                assert all(answer == answers[0] for answer in answers), (
                    f"asked twelve times about the same particles it answers {answers}: it keeps state, or draws"
                )

    def test_ignores_scale_and_order(self) -> None:
        """It does not depend on a common factor of the weights, nor on the order of the particles."""
        for population in self.populations():
            n, inputs = len(population), {"population": population, "t": 3}
            for shift in (3.0, -3.0, 1000.0, -1000.0, 1e5, -1e5):
                shifted = population.reweighted(np.full(n, shift))
                self.check_relation(
                    inputs, {"population": shifted}, f"adding {shift:g} to all log weights changes its answer"
                )
            for order in (np.arange(n)[::-1], np.roll(np.arange(n), 1), seeded(1).permutation(n)):
                self.check_relation(
                    inputs,
                    {"population": population.take(order)},
                    "another order of the particles changes its answer",
                )


class TriggerContract(BatchedContract, DecisionContract):
    """The contract of every `Trigger`."""

    slot = "trigger"

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        return component.wants(inputs["population"], inputs["t"])

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert isinstance(result, (bool, np.bool_)), f"its answer is {result!r}, expected True or False"


class SizeContract(DecisionContract):
    """The contract of every `Size`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        return component.choose(inputs["population"])

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        valid = isinstance(result, (int, np.integer)) and not isinstance(result, bool) and result >= 1
        assert valid, f"its answer is {result!r}, expected an int of at least 1"


class ScoreContract(Contract):
    """Properties of components that give one number per particle."""

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n = len(inputs["population"])
        assert np.shape(result) == (n,), f"scores of {n} particles have shape {np.shape(result)}, expected ({n},)"

    @prerequisite
    def test_scores_are_finite(self) -> None:
        """It gives one finite number per particle."""
        component = self.make()
        for n in _SIZES:
            scores = self.checked_call(component, self.inputs(n))
            wrong = scores[~np.isfinite(scores)]
            assert not len(wrong), f"a score is {wrong[0]}: it rules the particle out, bound it from below"

    def test_order_of_particles_is_irrelevant(self) -> None:
        """The order of the particles does not matter."""
        inputs, order = self.inputs(9), seeded(1).permutation(9)
        fault = "the same particles in another order have other scores"
        self.check_relation(
            inputs, {"population": inputs["population"].take(order)}, fault, lambda scores: scores[order]
        )


class LookaheadContract(ScoreContract):
    """The contract of every `Lookahead`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        return np.asarray(component.log_priority(inputs["population"], inputs["observation"]), dtype=np.float64)

    def test_copies_have_one_score(self) -> None:
        """A particle and its copy have the same score."""
        twice = self.inputs(5)["population"].take(np.repeat(np.arange(5), 2))
        scores = self.checked_call(self.make(), {**self.inputs(5), "population": twice})
        assert close(scores[::2], scores[1::2]), "a particle and its copy have different scores"

    def test_ignores_weights(self) -> None:
        """It does not depend on the weights, which the filter multiplies by the priorities."""
        inputs = self.inputs(6)
        for shift in (3.0, 1000.0, -1000.0):
            shifted = inputs["population"].reweighted(np.full(6, shift))
            fault = f"adding {shift:g} to all log weights changes the priorities"
            self.check_relation(inputs, {"population": shifted}, fault)
        other = inputs["population"].reweighted(np.linspace(0, 2, 6))
        fault = "other log weights of the same particles change the priorities: the weights would count twice"
        self.check_relation(inputs, {"population": other}, fault)

    def test_uses_the_observation(self) -> None:
        """Priorities that differ between particles depend on the observation, if that is an array of numbers."""
        component, inputs = self.make(), self.inputs(9)
        y, scores = np.asarray(inputs["observation"]), self.checked_call(component, inputs)
        if y.dtype.kind != "f" or np.ptp(scores) < 1e-9:
            return
        others = [self.checked_call(component, {**inputs, "observation": y + step}) for step in (1.0, -1.0, 0.1)]
        assert not all(close(scores, other) for other in others), (
            "the priorities are the same for other observations: it ignores the observation"
        )


class ParticlesContract(Contract):
    """Properties of components that take particles without weights."""

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"population": self.example(seeded(seed), n)[0].realised()}


class PairsContract(ParticlesContract):
    """Properties of similarities and equivalences, which relate pairs of particles."""

    def relation(self, result: np.ndarray) -> np.ndarray:
        """(n, n) relation of all pairs."""
        return result

    def test_pairs_do_not_depend_on_others(self) -> None:
        """The relation of two particles does not depend on the others, nor on their order; copies are equal."""
        component, rng = self.make(), seeded(4)
        selections = {
            "if only these are given": [rng.permutation(9)[:k] for k in (5, 2)],
            "in another order": [rng.permutation(9)],
            "if there are copies": [np.repeat(np.arange(9), 2), np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 3, 0])],
        }
        for seed in range(4):
            population = self.inputs(9, seed)["population"]
            every = self.relation(self.checked_call(component, {"population": population}))
            for when, selected in selections.items():
                for rows in selected:
                    some = self.relation(self.checked_call(component, {"population": population.take(rows)}))
                    assert np.allclose(some, every[np.ix_(rows, rows)], atol=1e-6), (
                        f"of nine particles, {len(set(rows.tolist()))} have other similarities or classes {when}"
                    )


class SimilarityContract(PairsContract):
    """The contract of every `Similarity`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        return np.asarray(component.matrix(inputs["population"].particles))

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n = len(inputs["population"])
        assert result.shape == (n, n), f"similarities of {n} particles have shape {result.shape}, expected ({n}, {n})"

    def test_similarities_are_shares(self) -> None:
        """It gives a symmetric (n, n) matrix of finite numbers in [0, 1], 1 on the diagonal."""
        component = self.make()
        for n in _SIZES:
            S = self.checked_call(component, self.inputs(n))
            assert np.isfinite(S).all() and S.min() >= -1e-9 and S.max() <= 1 + 1e-9, (
                f"similarities are in [{np.min(S):.3g}, {np.max(S):.3g}], expected finite ones in [0, 1]"
            )
            assert np.allclose(np.diag(S), 1.0, atol=1e-9), (
                f"a particle has similarity {np.diag(S).min():.3g} to itself, expected 1"
            )
            i, j = np.unravel_index(np.argmax(np.abs(S - S.T)), S.shape)
            assert abs(S[i, j] - S[j, i]) <= 1e-9, (
                f"the similarity of particles {i} and {j} is {S[i, j]:.4g}, that of {j} and {i} is {S[j, i]:.4g}"
            )


class EquivalenceContract(PairsContract):
    """The contract of every `Equivalence`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        return np.asarray(component.classes(inputs["population"].particles))

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n = len(inputs["population"])
        assert result.shape == (n,) and np.issubdtype(result.dtype, np.integer), (
            f"classes of {n} particles are {result.dtype} {result.shape}, expected int ({n},)"
        )

    def relation(self, result: np.ndarray) -> np.ndarray:
        return result[:, None] == result

    def test_classes_are_numbered(self) -> None:
        """Classes are numbered 0, 1, ... in the order of their first particle."""
        component = self.make()
        for n in _SIZES:
            found = self.checked_call(component, self.inputs(n))
            highest = np.maximum.accumulate(np.concatenate([[-1], found]))
            assert (found >= 0).all() and (found <= highest[:-1] + 1).all(), f"classes are {found.tolist()}"


class CodecContract(ParticlesContract):
    """The contract of every `Codec`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        return component.encode(inputs["population"].particles)

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        kind = type(result).__name__
        assert isinstance(result, Mapping), f"encode returns {kind}, expected a mapping of names to arrays"
        for name, array in result.items():
            assert isinstance(name, str), f"encode names an array {name!r}, expected a str"
            kind = type(array).__name__
            assert isinstance(array, np.ndarray), f"encode returns a {kind} as {name!r}, expected an array"
            assert not array.dtype.hasobject, f"{name!r} is an array of Python objects, which needs pickle"

    @prerequisite
    def test_decoded_particles_are_equal(self) -> None:
        """It encodes particles as named arrays; those read from a file equal the stored ones bit by bit."""
        component = self.make()
        for n in (*_SIZES, 300):
            population = self.inputs(n)["population"]
            with_copy = population.take(np.repeat(np.arange(n), 2)[: n + 1])  # a resampling leaves copies
            for stored in (population, with_copy, Population(_with_special_values(population.particles))):
                fresh = copy.deepcopy(component)  # as in a new process, which has encoded nothing
                arrays = _from_file(self.checked_call(component, {"population": stored}))
                with reports_errors(f"decode {n} particles"):
                    found = Population(fresh.decode(arrays))
                again = self.checked_call(fresh, {"population": found})
                assert same(found.particles, stored.particles) and same(dict(again), arrays), (
                    f"{n} particles that were encoded and decoded are not the same"
                )


def _with_special_values(particles: Any) -> Any:
    """The same particles with NaN, infinity, -0.0 and the smallest number in arrays of floats."""
    if isinstance(particles, Mapping):
        return {name: _with_special_values(array) for name, array in particles.items()}
    if not isinstance(particles, np.ndarray) or particles.dtype.kind != "f":
        return particles
    changed = particles.copy()
    special = np.array([np.nan, -0.0, np.inf, -np.inf, np.finfo(changed.dtype).smallest_subnormal], changed.dtype)
    flat = changed.reshape(-1)
    flat[: len(special)] = special[: len(flat)]
    return changed


def _from_file(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays that were written to an npz file and read again."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{f"particles/{name}": array for name, array in arrays.items()})
    file.seek(0)
    with np.load(file, allow_pickle=False) as data:
        return {name.removeprefix("particles/"): data[name] for name in data.files}
