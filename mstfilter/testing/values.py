"""Contracts without random numbers: triggers, sizes, lookaheads, similarities, equivalences, codecs, evidence."""

from __future__ import annotations

import copy
import io
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mstfilter.scene import Hypothesis
from mstfilter.smc import Population
from mstfilter.testing.contract import Contract, prerequisite, reports_errors, same
from mstfilter.testing.scenes import scene_example

_SIZES = (1, 2, 9)


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


class _DecisionContract(Contract):
    """Properties of triggers and sizes, which give one answer per population."""

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"population": self.example(_rng(seed), n)[0], "t": 2}

    def populations(self) -> list[Population]:
        """1, 2 and 12 particles with unequal weights; 12 with equal weights, and with a single dominant one."""
        rng = _rng()
        populations = [self.example(rng, n)[0] for n in (1, 2, 12)]
        particles = populations[-1].particles
        peaked = np.where(np.arange(12) == 5, 0.0, -80.0)
        return [*populations, Population(particles, np.zeros(12)), Population(particles, peaked)]

    def test_answers(self) -> None:
        """It answers for any population and time: a trigger True or False, a size an integer of at least 1."""
        component = self.make()
        for population in self.populations():
            for t in (0, 1, 7):
                self.checked_call(component, {"population": population, "t": t})

    def test_ignores_scale_and_order(self) -> None:
        """It does not depend on a common factor of the weights, nor on the order of the particles."""
        component = self.make()
        for population in self.populations():
            n = len(population)
            answer = self.checked_call(component, {"population": population, "t": 3})
            for shift in (1000.0, -1000.0):
                shifted = population.reweighted(np.full(n, shift))
                assert self.checked_call(component, {"population": shifted, "t": 3}) == answer, (
                    f"adding {shift:g} to all log weights changes its answer"
                )
            reordered = population.take(np.arange(n)[::-1])
            assert self.checked_call(component, {"population": reordered, "t": 3}) == answer, (
                "another order of the particles changes its answer"
            )


class TriggerContract(_DecisionContract):
    """The contract of every `Trigger`."""

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

    def test_ignores_scale(self) -> None:
        """It does not depend on a common factor of the weights."""
        component, inputs = self.make(), self.inputs(6)
        scores = self.checked_call(component, inputs)
        for shift in (1000.0, -1000.0):
            shifted = inputs["population"].reweighted(np.full(6, shift))
            assert _close(self.checked_call(component, {**inputs, "population": shifted}), scores), (
                f"adding {shift:g} to all log weights changes the priorities"
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
        component, inputs = self.make(), self.inputs(9)
        rows = np.array([8, 1, 5, 2, 0])
        every = self.relation(self.checked_call(component, inputs))
        some = self.relation(self.checked_call(component, {"population": inputs["population"].take(rows)}))
        assert np.allclose(some, every[np.ix_(rows, rows)], atol=1e-9), (
            "five of nine particles have another similarity or other classes if only these are given"
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
        for n in _SIZES:
            population = self.inputs(n)["population"]
            with_copy = population.take(np.repeat(np.arange(n), 2)[: n + 1])  # a resampling leaves copies
            for stored in (population, with_copy):
                fresh = copy.deepcopy(component)  # as in a new process, which has encoded nothing
                arrays = _from_file(self.checked_call(component, {"population": stored}))
                with reports_errors(f"decode {n} particles"):
                    found = Population(fresh.decode(arrays))
                again = self.checked_call(fresh, {"population": found})
                assert same(found.particles, stored.particles) and same(dict(again), arrays), (
                    f"{n} particles that were encoded and decoded are not the same"
                )


def _from_file(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays that were written to an npz file and read again."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{f"particles/{name}": array for name, array in arrays.items()})
    file.seek(0)
    with np.load(file, allow_pickle=False) as data:
        return {name.removeprefix("particles/"): data[name] for name in data.files}


def _close(a: np.ndarray, b: np.ndarray) -> bool:
    return np.allclose(a, b, rtol=1e-9, atol=2e-9)
