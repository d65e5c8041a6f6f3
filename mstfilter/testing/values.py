"""Contracts without random numbers: triggers, sizes, lookaheads, similarities, equivalences, codecs, evidence."""

from __future__ import annotations

import copy
import io
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mstfilter.scene import Hypothesis
from mstfilter.smc import Population
from mstfilter.testing.contract import Contract, check_batched, prerequisite, reports_errors, same
from mstfilter.testing.scenes import scene_example

_SIZES = (1, 2, 9)


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


class _DecisionContract(Contract):
    """Properties of triggers and sizes, which give one answer per population."""

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"population": self.example(_rng(seed), n)[0], "t": 2}

    def populations(self) -> list[Population]:
        """1, 2 and 12 particles with unequal weights; 12 with equal ones, a dominant one, zeros, and copies."""
        rng = _rng()
        populations = [self.example(rng, n)[0] for n in (1, 2, 12)]
        particles = populations[-1].particles
        peaked = np.where(np.arange(12) == 5, 0.0, -80.0)
        zeros = np.where(np.arange(12) < 5, -np.inf, 0.0)
        weighted = [Population(particles, lw) for lw in (np.zeros(12), peaked, zeros)]
        copies = populations[-1].take(np.repeat(np.arange(4), 3))
        return [*populations, *weighted, copies]

    def test_answers(self) -> None:
        """It answers for any population and time: a trigger True or False, a size an integer of at least 1."""
        component = self.make()
        for population in self.populations():
            for t in (0, 1, 7, 10_000):
                self.checked_call(component, {"population": population, "t": t})

    def test_keeps_no_count(self) -> None:
        """Its answer does not change when it is asked again."""
        component = self.make()
        for population in self.populations():
            for t in (0, 3):
                answers = [self.checked_call(component, {"population": population, "t": t}) for _ in range(12)]
                assert all(answer == answers[0] for answer in answers), (
                    f"asked twelve times about the same particles it answers {answers}: it keeps state, or draws"
                )

    def test_ignores_scale_and_order(self) -> None:
        """It does not depend on a common factor of the weights, nor on the order of the particles."""
        component = self.make()
        for population in self.populations():
            n = len(population)
            answer = self.checked_call(component, {"population": population, "t": 3})
            for shift in (3.0, -3.0, 1000.0, -1000.0, 1e5, -1e5):
                shifted = population.reweighted(np.full(n, shift))
                assert self.checked_call(component, {"population": shifted, "t": 3}) == answer, (
                    f"adding {shift:g} to all log weights changes its answer"
                )
            for order in (np.arange(n)[::-1], np.roll(np.arange(n), 1), _rng(1).permutation(n)):
                reordered = population.take(order)
                assert self.checked_call(component, {"population": reordered, "t": 3}) == answer, (
                    "another order of the particles changes its answer"
                )


class TriggerContract(_DecisionContract):
    """The contract of every `Trigger`."""

    def test_batched_runs_equal_single_runs(self) -> None:
        """If it declares ``batched = True``, every run of a batch equals the run alone."""
        check_batched("trigger", self.make(), self.example)

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        return component.wants(inputs["population"], inputs["t"])

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert isinstance(result, (bool, np.bool_)), f"its answer is {result!r}, expected True or False"


class SizeContract(_DecisionContract):
    """The contract of every `Size`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        return component.choose(inputs["population"])

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        valid = isinstance(result, (int, np.integer)) and not isinstance(result, bool) and result >= 1
        assert valid, f"its answer is {result!r}, expected an int of at least 1"

    def test_keeps_its_largest_number(self) -> None:
        """A filter accepts its answer: it is at most `n_max`, or the largest number for such particles."""
        component = self.make()
        for population in self.populations():
            with reports_errors("the size is checked by the filter"):
                component.checked(population)


class _ScoreContract(Contract):
    """Properties of lookaheads and evidence, which give one number per particle."""

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
        component, inputs = self.make(), self.inputs(9)
        order = _rng(1).permutation(9)
        shuffled = self.checked_call(component, {**inputs, "population": inputs["population"].take(order)})
        assert _close(shuffled, self.checked_call(component, inputs)[order]), (
            "the same particles in another order have other scores"
        )


class LookaheadContract(_ScoreContract):
    """The contract of every `Lookahead`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        return np.asarray(component.log_priority(inputs["population"], inputs["observation"]), dtype=np.float64)

    def test_copies_have_one_score(self) -> None:
        """A particle and its copy have the same score."""
        component, inputs = self.make(), self.inputs(5)
        twice = inputs["population"].take(np.repeat(np.arange(5), 2))
        scores = self.checked_call(component, {**inputs, "population": twice})
        assert _close(scores[::2], scores[1::2]), "a particle and its copy have different scores"

    def test_ignores_scale(self) -> None:
        """It does not depend on a common factor of the weights."""
        component, inputs = self.make(), self.inputs(6)
        scores = self.checked_call(component, inputs)
        for shift in (3.0, 1000.0, -1000.0):
            shifted = inputs["population"].reweighted(np.full(6, shift))
            assert _close(self.checked_call(component, {**inputs, "population": shifted}), scores), (
                f"adding {shift:g} to all log weights changes the priorities"
            )

    def test_ignores_weights(self) -> None:
        """It does not depend on the weights, which the filter multiplies by the priorities."""
        component, inputs = self.make(), self.inputs(6)
        other = inputs["population"].reweighted(np.linspace(0, 2, 6))
        scores = self.checked_call(component, inputs)
        assert _close(self.checked_call(component, {**inputs, "population": other}), scores), (
            "other log weights of the same particles change the priorities: the weights would count twice"
        )

    def test_uses_the_observation(self) -> None:
        """Priorities that differ between particles depend on the observation, if that is an array of numbers."""
        component, inputs = self.make(), self.inputs(9)
        y, scores = np.asarray(inputs["observation"]), self.checked_call(component, inputs)
        if y.dtype.kind != "f" or np.ptp(scores) < 1e-9:
            return
        others = [self.checked_call(component, {**inputs, "observation": y + step}) for step in (1.0, -1.0, 0.1)]
        assert not all(_close(scores, other) for other in others), (
            "the priorities are the same for other observations: it ignores the observation"
        )


class EvidenceContract(_ScoreContract):
    """The contract of every `Evidence`. The default example is a scene."""

    def example(self, rng: np.random.Generator, n: int) -> tuple[Population, Any]:
        """`n` hypotheses and a clip."""
        return scene_example(rng, n)

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        """Log scores, rounded to 9 digits."""
        hypotheses = tuple(inputs["population"].realised().particles)
        return np.round(component.log_score(hypotheses, inputs["observation"]), 9)

    def test_copies_score_the_same(self) -> None:
        """Equal hypotheses have equal scores."""
        fault = "a hypothesis and its copy have different scores"
        self._check_copies(lambda labels: labels.copy(), fault)

    def test_names_of_labels_are_irrelevant(self) -> None:
        """The numbers of the labels do not matter."""
        rng = _rng(2)

        def renamed(labels: np.ndarray) -> np.ndarray:
            table = np.concatenate([[0], 3 + 5 * rng.permutation(int(labels.max()))])
            return table.astype(np.uint16)[labels]

        self._check_copies(renamed, "other numbers for the same labels give other scores")

    def _check_copies(self, change: Callable[[np.ndarray], np.ndarray], fault: str) -> None:
        """Check that hypotheses and copies with changed labels have the same scores."""
        inputs = self.inputs(9)
        hypotheses = tuple(inputs["population"].realised().particles)
        copies = tuple(Hypothesis.from_labels(change(h.labels), h.grid) for h in hypotheses)
        scores = self.checked_call(self.make(), {**inputs, "population": Population(hypotheses + copies)})
        assert _close(scores[:9], scores[9:]), fault


class _ParticlesContract(Contract):
    """Properties of components that take particles without weights."""

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"population": self.example(_rng(seed), n)[0].realised()}


class _PairsContract(_ParticlesContract):
    """Properties of similarities and equivalences, which relate pairs of particles."""

    def relation(self, result: np.ndarray) -> np.ndarray:
        """(n, n) relation of all pairs."""
        raise NotImplementedError

    def test_pairs_do_not_depend_on_others(self) -> None:
        """The relation of two particles does not depend on the others, nor on their order."""
        component, rng = self.make(), _rng(4)
        for seed in range(4):
            population = self.inputs(9, seed)["population"].take(np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 3, 0]))
            every = self.relation(self.checked_call(component, {"population": population}))
            for k in (5, 2, 11):
                rows = rng.permutation(11)[:k]
                some = self.relation(self.checked_call(component, {"population": population.take(rows)}))
                assert np.allclose(some, every[np.ix_(rows, rows)], atol=1e-9), (
                    f"{k} of eleven particles have other similarities or classes if only these are given"
                )


class SimilarityContract(_PairsContract):
    """The contract of every `Similarity`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        return np.asarray(component.matrix(inputs["population"].particles))

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n = len(inputs["population"])
        assert result.shape == (n, n), f"similarities of {n} particles have shape {result.shape}, expected ({n}, {n})"

    def relation(self, result: np.ndarray) -> np.ndarray:
        return result

    def test_similarities_are_shares(self) -> None:
        """It gives an (n, n) matrix of finite numbers in [0, 1], 1 on the diagonal."""
        component = self.make()
        for n in _SIZES:
            S = self.checked_call(component, self.inputs(n))
            assert np.isfinite(S).all() and S.min() >= -1e-9 and S.max() <= 1 + 1e-9, (
                f"similarities are in [{np.min(S):.3g}, {np.max(S):.3g}], expected finite ones in [0, 1]"
            )
            assert np.allclose(np.diag(S), 1.0, atol=1e-9), (
                f"a particle has similarity {np.diag(S).min():.3g} to itself, expected 1"
            )

    def test_copies_are_equal(self) -> None:
        """A particle and its copy have similarity 1, and the same similarity to others."""
        twice = self.inputs(5)["population"].take(np.repeat(np.arange(5), 2))
        S = self.checked_call(self.make(), {"population": twice})
        own = np.diag(S[::2, 1::2])
        assert np.allclose(own, 1.0, atol=1e-6), f"a particle has similarity {own.min():.4g} to its copy, expected 1"
        assert np.allclose(S[::2], S[1::2], atol=1e-6), (
            "a particle and its copy have other similarities to a third one"
        )

    def test_is_symmetric(self) -> None:
        """It is symmetric."""
        S = self.checked_call(self.make(), self.inputs(9))
        i, j = np.unravel_index(np.argmax(np.abs(S - S.T)), S.shape)
        assert abs(S[i, j] - S[j, i]) <= 1e-9, (
            f"the similarity of particles {i} and {j} is {S[i, j]:.4g}, that of {j} and {i} is {S[j, i]:.4g}"
        )


class EquivalenceContract(_PairsContract):
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

    def test_copies_are_equal(self) -> None:
        """A particle equals its copy."""
        twice = self.inputs(5)["population"].take(np.repeat(np.arange(5), 2))
        found = self.checked_call(self.make(), {"population": twice})
        assert (found[::2] == found[1::2]).all(), "a particle and its copy are in different classes"


class CodecContract(_ParticlesContract):
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
    def test_encodes_as_arrays(self) -> None:
        """It encodes particles as named arrays without Python objects."""
        component = self.make()
        for n in _SIZES:
            self.checked_call(component, self.inputs(n))

    def test_decoded_particles_are_equal(self) -> None:
        """Particles read from a file equal the stored ones bit by bit."""
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


def _close(a: np.ndarray, b: np.ndarray) -> bool:
    return np.allclose(a, b, rtol=1e-9, atol=2e-9)
