"""Contracts without random numbers: triggers, sizes, lookaheads, similarities, equivalences, codecs, evidence."""

from __future__ import annotations

import copy
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from mstfilter.fusion import Evidence
from mstfilter.scene import Hypothesis
from mstfilter.smc import Codec, Equivalence, Lookahead, Population, Similarity, Size, Trigger
from mstfilter.testing.contract import Contract, prerequisite, reports_errors, same
from mstfilter.testing.scenes import scene_example


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


class _DecisionContract(Contract):
    """What triggers and sizes share: a plain answer for a population."""

    def answer(self, component: Any, population: Population, t: int) -> Any:
        """The answer of the component."""
        raise NotImplementedError

    def populations(self) -> list[Population]:
        """1, 2 and 12 particles with unequal weights; 12 with equal weights, and with a single dominant one."""
        rng = _rng()
        populations = [self.example(rng, n)[0] for n in (1, 2, 12)]
        particles = populations[-1].particles
        peaked = np.where(np.arange(12) == 5, 0.0, -80.0)
        return [*populations, Population(particles, np.zeros(12)), Population(particles, peaked)]

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        """A population."""
        return {"population": self.example(_rng(seed), n)[0]}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """Ask for the answer at time 2."""
        return self.answer(component, inputs["population"], 2)

    def test_ignores_scale_and_order(self) -> None:
        """It does not depend on a common factor of the weights, nor on the order of the particles."""
        component = self.make()
        for population in self.populations():
            n = len(population)
            with reports_errors(f"{n} particles"):
                answer = self.answer(component, population, 3)
                for shift in (1000.0, -1000.0):
                    shifted = self.answer(component, population.reweighted(np.full(n, shift)), 3)
                    assert shifted == answer, f"adding {shift:g} to all log weights changes its answer"
                reversed_ = self.answer(component, population.take(np.arange(n)[::-1]), 3)
            assert reversed_ == answer, "another order of the particles changes its answer"


class TriggerContract(_DecisionContract):
    """The contract of every `Trigger`."""

    def answer(self, component: Trigger, population: Population, t: int) -> bool:
        """Whether to resample."""
        return bool(component.wants(population, t))

    def test_answers_yes_or_no(self) -> None:
        """It returns True or False for any population and time."""
        component = self.make()
        for population in self.populations():
            for t in (0, 1, 7):
                with reports_errors(f"{len(population)} particles at time {t}"):
                    answer = component.wants(population, t)
                assert isinstance(answer, (bool, np.bool_)), f"its answer is {answer!r}, expected True or False"


class SizeContract(_DecisionContract):
    """The contract of every `Size`."""

    def answer(self, component: Size, population: Population, t: int) -> int:
        """The number of particles."""
        return component.choose(population)

    def test_answers_a_number(self) -> None:
        """It returns an integer of at least 1."""
        component = self.make()
        for population in self.populations():
            with reports_errors(f"{len(population)} particles"):
                n = component.choose(population)
            valid = isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n >= 1
            assert valid, f"for {len(population)} particles its answer is {n!r}, expected an int of at least 1"


class LookaheadContract(Contract):
    """The contract of every `Lookahead`."""

    def call(self, component: Lookahead, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """Log priorities."""
        return component.log_priority(inputs["population"], inputs["observation"])

    def priority(self, component: Lookahead, population: Population, observation: Any) -> np.ndarray:
        """Log priorities, whose shape is checked."""
        n = len(population)
        with reports_errors(f"{n} particles"):
            found = np.asarray(component.log_priority(population, observation), dtype=np.float64)
        assert found.shape == (n,), f"log priorities of {n} particles have shape {found.shape}, expected ({n},)"
        return found

    @prerequisite
    def test_priorities_are_finite(self) -> None:
        """It gives one finite number per particle."""
        component = self.make()
        for n in (1, 2, 40):
            found = self.priority(component, *self.example(_rng(), n))
            wrong = found[~np.isfinite(found)]
            assert not len(wrong), f"a log priority is {wrong[0]}: it would bias the filter, bound it from below"

    def test_ignores_scale_and_order(self) -> None:
        """It does not depend on a common factor of the weights, nor on the order of the particles."""
        component = self.make()
        population, observation = self.example(_rng(), 6)
        found = self.priority(component, population, observation)
        for shift in (1000.0, -1000.0):
            shifted = self.priority(component, population.reweighted(np.full(6, shift)), observation)
            assert np.allclose(shifted, found, atol=1e-9), (
                f"adding {shift:g} to all log weights changes the priorities"
            )
        order = np.array([3, 0, 5, 1, 4, 2])
        reordered = self.priority(component, population.take(order), observation)
        assert np.allclose(reordered, found[order], atol=1e-9), "in another order the particles have other priorities"


class _ParticlesContract(Contract):
    """What contracts share whose components take particles only."""

    def particles(self, n: int, seed: int = 0) -> Any:
        """Particles of the example."""
        return self.example(_rng(seed), n)[0].realised().particles

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        """Particles."""
        return {"particles": self.particles(n, seed)}


class SimilarityContract(_ParticlesContract):
    """The contract of every `Similarity`."""

    def call(self, component: Similarity, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """The matrix of similarities."""
        return component.matrix(inputs["particles"])

    def matrix(self, component: Similarity, particles: Any, n: int) -> np.ndarray:
        """The matrix, whose shape is checked."""
        with reports_errors(f"{n} particles"):
            found = np.asarray(component.matrix(particles))
        assert found.shape == (n, n), f"similarities of {n} particles have shape {found.shape}, expected ({n}, {n})"
        return found

    def test_similarities_are_shares(self) -> None:
        """It gives an (n, n) matrix of finite numbers in [0, 1], 1 on the diagonal."""
        component = self.make()
        for n in (1, 2, 9):
            S = self.matrix(component, self.particles(n), n)
            assert np.isfinite(S).all() and S.min() >= -1e-9 and S.max() <= 1 + 1e-9, (
                f"similarities are in [{np.min(S):.3g}, {np.max(S):.3g}], expected finite ones in [0, 1]"
            )
            assert np.allclose(np.diag(S), 1.0, atol=1e-9), (
                f"a particle has similarity {np.diag(S).min():.3g} to itself, expected 1"
            )

    def test_is_symmetric(self) -> None:
        """It is symmetric."""
        S = self.matrix(self.make(), self.particles(9), 9)
        i, j = np.unravel_index(np.argmax(np.abs(S - S.T)), S.shape)
        assert abs(S[i, j] - S[j, i]) <= 1e-9, (
            f"the similarity of particles {i} and {j} is {S[i, j]:.4g}, that of {j} and {i} is {S[j, i]:.4g}"
        )

    def test_pairs_do_not_depend_on_others(self) -> None:
        """The similarity of two particles does not depend on the others, nor on their order."""
        component, population = self.make(), self.example(_rng(), 9)[0].realised()
        S = self.matrix(component, population.particles, 9)
        rows = np.array([7, 2, 4, 0])
        found = self.matrix(component, population.take(rows).particles, 4)
        assert np.allclose(found, S[np.ix_(rows, rows)], atol=1e-9), (
            "the similarities of four of nine particles change if only these are given"
        )


class EquivalenceContract(_ParticlesContract):
    """The contract of every `Equivalence`."""

    def call(self, component: Equivalence, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """Classes of particles."""
        return component.classes(inputs["particles"])

    def classes(self, component: Equivalence, particles: Any, n: int) -> np.ndarray:
        """The classes, whose shape and type are checked."""
        with reports_errors(f"{n} particles"):
            found = np.asarray(component.classes(particles))
        assert found.shape == (n,) and np.issubdtype(found.dtype, np.integer), (
            f"classes of {n} particles are {found.dtype} {found.shape}, expected int ({n},)"
        )
        return found

    def test_classes_are_numbered(self) -> None:
        """Classes are numbered 0, 1, ... in the order of their first particle."""
        component = self.make()
        for n in (1, 2, 9):
            found = self.classes(component, self.particles(n), n)
            highest = np.maximum.accumulate(np.concatenate([[-1], found]))
            assert (found >= 0).all() and (found <= highest[:-1] + 1).all(), f"classes are {found.tolist()}"

    def test_copies_are_equal(self) -> None:
        """A particle equals its copy."""
        population = self.example(_rng(), 5)[0].realised()
        twice = population.take(np.repeat(np.arange(5), 2)).particles
        found = self.classes(self.make(), twice, 10)
        assert (found[::2] == found[1::2]).all(), "a particle and its copy are in different classes"

    def test_pairs_do_not_depend_on_others(self) -> None:
        """Whether two particles are equal does not depend on the others, nor on their order."""
        component, population = self.make(), self.example(_rng(), 9)[0].realised()
        rows = np.array([8, 1, 5, 2, 0])
        expected = self.classes(component, population.particles, 9)[rows]
        found = self.classes(component, population.take(rows).particles, 5)
        assert ((found[:, None] == found) == (expected[:, None] == expected)).all(), (
            "five of nine particles are in other classes if only these are given"
        )


class CodecContract(_ParticlesContract):
    """The contract of every `Codec`."""

    def call(self, component: Codec, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """Encode."""
        return dict(component.encode(inputs["particles"]))

    def encode(self, component: Codec, particles: Any, n: int) -> dict[str, np.ndarray]:
        """Encode, and check that the result can be stored."""
        with reports_errors(f"encode {n} particles"):
            arrays = component.encode(particles)
        kind = type(arrays).__name__
        assert isinstance(arrays, Mapping), f"encode returns {kind}, expected a mapping of names to arrays"
        for name, array in arrays.items():
            assert isinstance(name, str), f"encode names an array {name!r}, expected a str"
            kind = type(array).__name__
            assert isinstance(array, np.ndarray), f"encode returns a {kind} as {name!r}, expected an array"
            assert not array.dtype.hasobject, f"{name!r} is an array of Python objects, which needs pickle"
        return dict(arrays)

    @prerequisite
    def test_encodes_as_arrays(self) -> None:
        """It encodes particles as named arrays without Python objects."""
        component = self.make()
        for n in (1, 2, 6):
            self.encode(component, self.particles(n), n)

    def test_particles_come_back(self) -> None:
        """Particles read from a file equal the stored ones bit by bit."""
        component = self.make()
        for n in (1, 2, 6):
            population = self.example(_rng(), n)[0].realised()
            with_copy = population.take(np.repeat(np.arange(n), 2)[: n + 1])  # a resampling leaves copies
            for particles in (population.particles, with_copy.particles):
                fresh = copy.deepcopy(component)  # as in a new process, which has encoded nothing
                arrays = _from_file(self.encode(component, particles, n))
                with reports_errors(f"decode {n} particles"):
                    found = Population(fresh.decode(arrays)).particles
                again = self.encode(fresh, found, n)
                assert same(found, Population(particles).particles) and same(again, arrays), (
                    f"{n} particles that were encoded and decoded are not the same"
                )


def _from_file(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays that were written to an npz file and read again."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{f"particles/{name}": array for name, array in arrays.items()})
    file.seek(0)
    with np.load(file, allow_pickle=False) as data:
        return {name.removeprefix("particles/"): data[name] for name in data.files}


class EvidenceContract(Contract):
    """The contract of every `Evidence`. The default example is a scene."""

    def example(self, rng: np.random.Generator, n: int) -> tuple[Population, Any]:
        """`n` hypotheses and a clip."""
        return scene_example(rng, n)

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        """Hypotheses and a clip."""
        population, clip = self.example(_rng(seed), n)
        return {"hypotheses": tuple(population.realised().particles), "clip": clip}

    def call(self, component: Evidence, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """Log scores, rounded to 9 digits."""
        return np.round(component.log_score(**inputs), 9)

    def score(self, component: Evidence, hypotheses: tuple[Hypothesis, ...], clip: Any) -> np.ndarray:
        """Log scores, whose shape is checked."""
        n = len(hypotheses)
        with reports_errors(f"{n} hypotheses"):
            found = np.asarray(component.log_score(hypotheses, clip))
        assert found.shape == (n,), f"scores of {n} hypotheses have shape {found.shape}, expected ({n},)"
        return found

    @prerequisite
    def test_scores_are_finite(self) -> None:
        """It gives one finite number per hypothesis."""
        component = self.make()
        for n in (1, 2, 9):
            scores = self.score(component, **self.inputs(n))
            wrong = scores[~np.isfinite(scores)]
            assert not len(wrong), f"a score is {wrong[0]}: no hypothesis may be ruled out for certain"

    def test_copies_score_the_same(self) -> None:
        """Equal hypotheses have equal scores."""
        inputs = self.inputs(5)
        hypotheses = inputs["hypotheses"]
        copies = tuple(Hypothesis.from_labels(h.labels.copy(), h.grid) for h in hypotheses)
        scores = self.score(self.make(), hypotheses + copies, inputs["clip"])
        assert _close(scores[:5], scores[5:]), "a hypothesis and its copy have different scores"

    def test_order_of_hypotheses_is_irrelevant(self) -> None:
        """The order of the hypotheses does not matter."""
        component, inputs = self.make(), self.inputs(9)
        hypotheses, order = inputs["hypotheses"], _rng(1).permutation(9)
        shuffled = self.score(component, tuple(hypotheses[k] for k in order), inputs["clip"])
        assert _close(shuffled, self.score(component, **inputs)[order]), (
            "the same hypotheses in another order have other scores"
        )

    def test_names_of_labels_are_irrelevant(self) -> None:
        """The numbers of the labels do not matter."""
        component, inputs = self.make(), self.inputs(9)
        rng, renamed = _rng(2), []
        for hypothesis in inputs["hypotheses"]:
            n = int(hypothesis.labels.max())
            table = np.concatenate([[0], 3 + 5 * rng.permutation(n)]).astype(np.uint16)
            renamed.append(Hypothesis.from_labels(table[hypothesis.labels], hypothesis.grid))
        scores = self.score(component, tuple(renamed), inputs["clip"])
        assert _close(scores, self.score(component, **inputs)), "other numbers for the same labels give other scores"


def _close(a: np.ndarray, b: np.ndarray) -> bool:
    return np.allclose(a, b, rtol=1e-9, atol=1e-9)
