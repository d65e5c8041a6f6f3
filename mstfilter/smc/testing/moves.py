"""Contracts of transitions, proposals, updates and rejuvenations."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product
from typing import Any
from unittest import SkipTest

import numpy as np

from mstfilter.smc import DensityTransition, Population, as_matrix, union
from mstfilter.smc.population import take
from mstfilter.smc.testing.contract import (
    ScaleContract,
    reports_errors,
    same,
    seeded,
    skip_unless_properly_weighted,
    statistical,
)
from mstfilter.smc.testing.copies import quantile
from mstfilter.smc.testing.exact import (
    SMALL,
    ExactContract,
    check_mean_weight,
    check_parents,
    check_same_law,
    check_uncorrelated,
    compare_factors,
)

_N = 6


class TransitionContract(ScaleContract, ExactContract):
    """The contract of every `Transition`. The two statistical tests have a false-alarm rate of at most 1e-6 each.

    One test needs a method ``exact(self, rng, n)`` that returns n rows x_{t-1}, draws of x_t from f(x_t | x_{t-1}),
    and the observation. For a guided move, `exact` also returns the function log p(y_t | x_t) of x_t. If the
    transition weights by the observation, the draws of x_t must carry the exact weights.
    """

    columns = "(x_t, x_t - x_{t-1})"

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.predict(rng, inputs["population"], inputs["observation"])

    def variants(self) -> list[dict[str, Any]]:
        return [{**inputs, **absent} for inputs in super().variants() for absent in ({}, {"observation": None})]

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n, old = len(inputs["population"]), inputs["population"].log_weights
        assert len(result) == n or "previous" in result.parents, (
            f'{n} particles became {len(result)}, and there are no parents "previous"'
        )
        check_parents(result, "previous", n)
        particles, old_particles = result.particles, inputs["population"].particles
        if all(isinstance(one, np.ndarray) and one.dtype.kind == "f" for one in (particles, old_particles)):
            wrong = np.flatnonzero(~np.isfinite(particles).reshape(len(result), -1).all(axis=1))
            assert not len(wrong) or not np.isfinite(old_particles).all(), (
                f"particle {wrong[0]} becomes {particles[wrong[0]]}"
            )
        if same(np.sort(result.log_weights), np.sort(old)):
            parents = result.parents.get("previous", np.arange(n))
            assert np.array_equal(result.log_weights, np.where(parents < 0, result.log_weights, old[parents])), (
                'the particles have another order than before, and parents "previous" do not state it'
            )

    @statistical
    def test_weighted_moves_are_those_of_the_model(self) -> None:
        """Weighted pairs (x_{t-1}, x_t) have the distribution of the model, and the mean weight is exact."""
        component = skip_unless_properly_weighted(self.make())

        def moved(n: int, missing: bool = False) -> tuple[Population, Population]:
            """Particles before and after their moves."""
            population, _, observation, *_ = self.exact_case(1, n)
            population = population.take(seeded(4).permutation(n)).reweighted(seeded(5).standard_normal(n))
            inputs = {"population": population, "observation": None if missing else observation}
            after = self.checked_call(component, inputs, seeded(2))
            return population.take(after.parents.get("previous", np.arange(len(after)))), after

        n = self.draws_in_time(moved)
        before, after = moved(n)
        other, fresh, _, *likelihood = self.exact_case(3, n)
        self._compare_moves(before, after, other, fresh, likelihood)
        guided = not same(after.log_weights, before.log_weights)
        if guided and not np.ptp(fresh.log_weights):
            self._compare_moves(*moved(n, missing=True), other, fresh, [])
        if len(after) == n:
            self.check_independent(_columns(before, after))

    def _compare_moves(
        self, before: Population, after: Population, other: Population, fresh: Population, likelihood: list[Any]
    ) -> None:
        """Compare moves and weight changes with exact moves. Both samples are weighted by `likelihood`."""
        lw, exact_lw = (
            new.log_weights - old.log_weights + sum(log_g(new.particles) for log_g in likelihood)
            for old, new in ((before, after), (other, fresh))
        )
        self.compare_weighted(_columns(before, after), lw, _columns(other, fresh), exact_lw)
        check_mean_weight(np.exp(lw), np.exp(exact_lw))

    @statistical
    def test_small_populations_are_exact(self) -> None:
        """Populations of three particles have the exact distribution, over many calls."""
        component = skip_unless_properly_weighted(self.make())
        old, _, observation, *likelihood = self.exact_case(1, 9000)
        other, fresh, *_ = self.exact_case(3, 50_000)

        def call(k: int) -> tuple[np.ndarray, np.ndarray]:
            before = old.take(np.arange(SMALL * k, SMALL * (k + 1)))
            after = self.checked_call(component, {"population": before, "observation": observation}, seeded(k))
            before = before.take(after.parents.get("previous", np.arange(len(after))))
            lw = after.log_weights - before.log_weights + sum(log_g(after.particles) for log_g in likelihood)
            return _columns(before, after), lw

        exact_lw = fresh.log_weights - other.log_weights + sum(log_g(fresh.particles) for log_g in likelihood)
        lw = self.compare_small(call, _columns(other, fresh), exact_lw)
        check_mean_weight(np.exp(lw), np.exp(exact_lw))

    @statistical
    def test_moves_do_not_depend_on_others(self) -> None:
        """A particle moves as it does beside other particles, unless the move is weighted."""
        component, inputs = skip_unless_properly_weighted(self.make()), self.inputs(_N)
        self._skip_objects(component, inputs)
        half = np.arange(_N // 2)
        population = inputs["population"]
        others = _joined(population.take(half), self.inputs(_N, 5)["population"].take(half))
        others = Population(others, population.log_weights)
        a, b = (self._moves(component, {**inputs, "population": given})[:, half] for given in (population, others))
        if np.ptp(np.concatenate([a, b])[..., -1]) > 1e-9:
            raise SkipTest("the moves are weighted, so that they may depend on all particles")
        # Both populations move with equal generators. If the laws are equal, every difference has mean 0.
        for power in (1, 2):
            difference = (a[..., :-1] ** power - b[..., :-1] ** power).reshape(len(a), -1)
            mean, sd = difference.mean(axis=0), difference.std(axis=0)
            bound = quantile(4 * difference.shape[1]) * sd / np.sqrt(len(a)) + 1e-6 * (1 + np.abs(a).max() ** power)
            assert (np.abs(mean) <= bound).all(), (
                "the same particle moves differently beside other particles: it uses their mean or spread, so "
                "declare properly_weighted = False or move each particle by itself"
            )

    @statistical
    def test_order_of_particles_is_irrelevant(self) -> None:
        """Particles move independently, and the order of the particles has no effect."""
        component, inputs = self.make(), self.inputs(_N)
        self._skip_objects(component, inputs)
        population, backwards = inputs["population"], np.arange(_N)[::-1]
        a = self._moves(component, inputs)
        b = self._moves(component, {**inputs, "population": population.take(backwards)}, 1000)[:, ::-1]
        drawn = np.flatnonzero(np.ptp(a, axis=0).max(axis=0)[:-1] > 1e-6)[:4]  # without the change of the log weight
        n_tests = 4 * _N**2 * max(1, len(drawn)) ** 2
        for c, d in product(drawn, drawn):
            x, y = (np.concatenate([a[:, :, axis], b[:, :, axis]]) for axis in (c, d))
            for i, k in permutations(range(_N), 2):
                if c < d or (c == d and i < k):
                    check_uncorrelated(x[:, i], y[:, k], n_tests, f"moves of particles {i} and {k}")
        for i in range(_N):
            check_same_law(a[:, i], b[:, i], 4 * _N, f"particle {i} moves differently as number {backwards[i]}")

    def _skip_objects(self, component: Any, inputs: dict[str, Any]) -> None:
        """Skip the test if particles are objects, or if their number changes."""
        if not isinstance(inputs["population"].particles, (np.ndarray, dict)):
            raise SkipTest("the particles are objects, whose moves are not compared")
        if len(self.checked_call(component, inputs)) != len(inputs["population"]):
            raise SkipTest("the number of particles changes")

    def _moves(self, component: Any, inputs: dict[str, Any], seed: int = 0) -> np.ndarray:
        """(300, n, d + 1) results of 300 calls: coordinates, and the change of the log weight.

        The results are rounded, because the order of summation changes the last bits.
        """
        given, moves = inputs["population"], []
        for k in range(300):
            moved = self.checked_call(component, inputs, seeded(seed + k))
            moves.append(np.column_stack([as_matrix(moved.particles), moved.log_weights - given.log_weights]))
        return np.round(np.array(moves), 9)


def _joined(a: Population, b: Population) -> Any:
    """The particles of both populations."""
    return union(a, b).particles


class DensityTransitionContract(TransitionContract):
    """The contract of every `DensityTransition`: the properties of `TransitionContract`, and those of `log_prob`."""

    def test_log_prob_is_of_each_move(self) -> None:
        """`log_prob` gives one finite number for each move of `predict`, independently of the other moves."""
        component, rows = self.make(), np.array([4, 0, 3])
        for n in (1, _N):
            inputs = self.inputs(n)
            moved = self.checked_call(component, inputs)
            found = self._log_prob(component, inputs, moved)
            assert found.shape == (n,), f"log densities of {n} moves have shape {found.shape}, expected ({n},)"
            assert np.isfinite(found).all(), f"log density of a move is {found[~np.isfinite(found)][0]}"
        fewer_inputs = {**inputs, "population": inputs["population"].take(rows)}
        fewer = self._log_prob(component, fewer_inputs, moved.take(rows))
        assert np.allclose(fewer, found[rows], atol=1e-9), "three of six moves have other log densities alone"

    @statistical
    def test_log_prob_is_the_density_of_its_moves(self) -> None:
        """The moves of `predict` have the density of `log_prob`, up to a constant factor.

        Let x' be a move from particle a or b, with probability 1/2 each. Then p = f(x' | a) / (f(x' | a) + f(x' | b))
        is the probability that x' was moved from a. With p computed for the true origin, (1 - p) h(log(p / (1 - p)))
        has mean 0 for every odd bounded function h; here it is linear up to 8. The particles a and b are 4, 8, ...
        or 8192 positions apart in the order of the first coordinate.
        """
        component, n = self.make(), 2**14
        if not isinstance(self.inputs(1)["population"].particles, (np.ndarray, dict)):
            raise SkipTest("the particles are objects")
        population, observation = self.example(seeded(1), n)
        given = Population(population.take(np.argsort(as_matrix(population.particles)[:, 0])).particles)
        inputs = {"population": given, "observation": observation}
        moved = self.checked_call(component, inputs, seeded(2))
        if np.ptp(moved.log_weights) > 0:
            raise SkipTest("moves are weighted: their density is another one")
        own = self._log_prob(component, inputs, moved)
        for shift in 2 ** np.arange(2, 14):
            self.check_time(what=f"out of time: compared up to {shift // 2} positions apart")
            other = {**inputs, "population": given.take(np.arange(n) ^ shift)}
            logit = own - self._log_prob(component, other, moved)
            with np.errstate(over="ignore"):
                found = np.clip(logit, -8, 8) / (1 + np.exp(logit))
            bound = quantile(40 * 12) * found.std() / np.sqrt(n) + 1e-9
            assert abs(found.mean()) <= bound, (
                "`log_prob` is not the density of the moves of `predict`: for moves from two particles it is too "
                f"{'certain' if found.mean() < 0 else 'uncertain'} which is from which"
            )

    @staticmethod
    def _log_prob(component: DensityTransition, inputs: dict[str, Any], moved: Population) -> np.ndarray:
        with reports_errors("log_prob"):
            old = inputs["population"].particles
            return np.asarray(component.log_prob(old, moved.particles, inputs["observation"]))


class ProposalContract(ExactContract):
    """The contract of every `Proposal`. The statistical test has a false-alarm rate of at most 1e-6.

    The statistical test needs a method ``exact(self, rng, n)`` that returns n exact draws from the distribution of
    the weighted particles, and the observation. For an initial proposal the exact draws are from p(x_0). An optional
    third item ``log_likelihood(particles) -> (n,)`` multiplies all weights, so that the weights vary less.
    """

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"observation": self.example(seeded(0), 2)[1], "n": n}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.sample(rng, inputs["observation"], inputs["n"])

    def variants(self) -> list[dict[str, Any]]:
        return [self.inputs(n) for n in (1, 2, 20)]

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        found, n = len(result), inputs["n"]
        assert found == n, f"asked for {n} particles it returns {found}: repeat some if needed"

    def check_unused_generator(self, own: bool) -> None:
        super().check_unused_generator(own)
        component = self.make()
        particles = self.checked_call(component, self.inputs(6)).realised().particles
        equal = all(same(take(particles, np.array([0])), take(particles, np.array([k]))) for k in range(1, 6))
        assert equal or not component.properly_weighted, (
            "it returns the same different particles at every call and never uses its generator: draw from `rng`, or "
            "declare draws = False and properly_weighted = False"
        )

    def _sampled(self, n: int, seed: int = 2) -> Population:
        observation = self.inputs(n)["observation"] if self.exact is None else self.exact_case(1, 1)[1]
        return self.checked_call(self.make(), {"observation": observation, "n": n}, seeded(seed))

    @statistical
    def test_draws_have_their_distribution(self) -> None:
        """Weighted draws have the exact distribution and mean weight."""
        self.exact_case(1, 1)
        n = self.draws_in_time(self._sampled)
        found, (fresh, _, *likelihood) = self._sampled(n), self.exact_case(3, n)
        lw, exact_lw = (p.log_weights + sum(log_g(p.particles) for log_g in likelihood) for p in (found, fresh))
        self.compare_weighted(as_matrix(found.particles), lw, as_matrix(fresh.particles), exact_lw)
        check_mean_weight(np.exp(lw), np.exp(exact_lw))

    @statistical
    def test_small_populations_are_exact(self) -> None:
        """Populations of three particles have the exact distribution, over many calls."""
        fresh, _, *likelihood = self.exact_case(3, 50_000)
        exact_lw = fresh.log_weights + sum(log_g(fresh.particles) for log_g in likelihood)

        def call(k: int) -> tuple[np.ndarray, np.ndarray]:
            found = self._sampled(SMALL, k)
            lw = found.log_weights + sum(log_g(found.particles) for log_g in likelihood)
            return as_matrix(found.particles), lw

        lw = self.compare_small(call, as_matrix(fresh.particles), exact_lw, independent=False)
        check_mean_weight(np.exp(lw), np.exp(exact_lw))

    @statistical
    def test_draws_vary_like_independent_ones(self) -> None:
        """Means of draws vary at most like means of independent draws."""
        skip_unless_properly_weighted(self.make())
        if not isinstance(self._sampled(2).particles, (np.ndarray, dict)):
            raise SkipTest("the particles are objects")
        calls = [as_matrix(self._sampled(100, seed).particles) for seed in range(100, 500)]
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = 100 * np.mean(calls, axis=1).var(axis=0) / np.concatenate(calls).var(axis=0)
        # Stratified and sorted draws pass. 1.45 is above the quantile 1 - 1e-7 of chi^2_399 / 399.
        assert not (ratio > 1.45).any(), (
            f"means of 100 draws have {np.nanmax(ratio):.3g} times the variance of independent ones: is a random "
            "number used for several particles?"
        )


class UpdateContract(ScaleContract, ExactContract):
    """The contract of every `Update`. The statistical test has a false-alarm rate of at most 1e-6.

    The statistical test needs a method ``exact(self, rng, n)`` that returns n predicted particles x ~ p(x), a second
    population, and y. The second population holds exact draws of p(x | y), or the predicted particles with exact
    weights p(y | x). Exact weights are compared one by one, including a constant factor. For exact draws, the
    evidence is tested only if a fourth item of `exact` is log p(y).
    """

    weighted = "predicted"

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        predicted, observation = self.example(seeded(seed), n)
        predicted = replace(predicted, parents={"previous": np.arange(n)})
        proposed = self.example(seeded(seed + 1), 4)[0]
        proposed = replace(proposed, log_weights=np.zeros(4), parents={"proposed": np.arange(4)})
        return {"predicted": predicted, "proposed": proposed, "observation": observation}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.update(rng, inputs["predicted"], inputs["proposed"], inputs["observation"])

    def variants(self) -> list[dict[str, Any]]:
        """Inputs with predicted particles, with proposed particles, and with predicted and proposed particles."""
        return [{**self.inputs(_N), **absent} for absent in ({"proposed": None}, {"predicted": None}, {})]

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        for name, given in (("previous", inputs["predicted"]), ("proposed", inputs["proposed"])):
            if given is not None:
                check_parents(result, name, len(given))

    def test_parents_belong_to_their_particles(self) -> None:
        """A particle of the result that equals a predicted particle has its index as parent "previous"."""
        inputs = {**self.inputs(_N), "proposed": None}
        out = self.checked_call(self.make(), inputs).realised()
        index = out.parents.get("previous", np.arange(len(out)))
        old = [take(inputs["predicted"].particles, np.array([i])) for i in range(_N)]
        for k in range(len(out)):
            copies = [i for i in range(_N) if same(take(out.particles, np.array([k])), old[i])]
            assert not copies or index[k] in copies or index[k] < 0, (
                f'particle {k} is predicted particle {copies[0]}, and its parent "previous" is {int(index[k])}'
            )

    def test_weight_of_a_particle_does_not_depend_on_others(self) -> None:
        """The factor by which the weight of a particle changes does not depend on the other particles."""
        component, inputs = skip_unless_properly_weighted(self.make()), {**self.inputs(_N), "proposed": None}
        every = self._factors(component, inputs, np.arange(_N))
        if every is None:
            raise SkipTest("it makes other particles than the predicted ones")
        if not same(every, self._factors(component, inputs, np.arange(_N), seed=4)):
            raise SkipTest("its weights are random")
        rows = np.argsort(-every)[:3]  # the heaviest, since no population is without weight
        some = self._factors(component, inputs, rows)
        assert some is None or np.allclose(some, every[rows], rtol=1e-9, atol=1e-9), (
            f"the log weights of particles change by {every[rows]} among six particles, and by {some} among three: "
            "likelihoods are not normalised or ranked"
        )

    def _factors(self, component: Any, inputs: dict[str, Any], rows: np.ndarray, seed: int = 3) -> np.ndarray | None:
        """Changes of the log weights of some of the predicted particles; None if the result has other particles."""
        given = inputs["predicted"].take(rows).labelled({"previous": np.arange(len(rows))})
        out = self.checked_call(component, {**inputs, "predicted": given}, seeded(seed))
        kept = len(out) == len(given) and same(out.realised().particles, given.realised().particles)
        return out.log_weights - given.log_weights if kept else None

    def test_order_of_particles_is_irrelevant(self) -> None:
        """Predicted particles in another order get the same weights, if the update keeps the particles."""
        component, inputs = self.make(), {**self.inputs(_N), "proposed": None}
        every = self._factors(component, inputs, np.arange(_N))
        if every is None or not same(every, self._factors(component, inputs, np.arange(_N), seed=4)):
            raise SkipTest("it makes other particles than the predicted ones, or its weights are random")
        for rows in (np.arange(_N)[::-1], np.roll(np.arange(_N), 1)):
            found = self._factors(component, inputs, rows)
            assert found is None or np.allclose(found, every[rows], rtol=1e-6, atol=1e-6), (
                f"the log weights of particles change by {every[rows]}, and in another order by {found}: a weight "
                "depends on the place in the array"
            )

    def test_weights_of_distant_particles_are_numbers(self) -> None:
        """Particles far from the observation get a small weight or none, but not NaN."""
        if not self.on_numbers:
            raise SkipTest("the particles have an example of their own")
        inputs = {**self.inputs(_N), "proposed": None}
        predicted = inputs["predicted"]
        far = predicted.moved(np.where(np.arange(_N) < 3, 1.0, 20.0) * predicted.particles)
        with np.errstate(all="ignore"), reports_errors("three of six particles are far from the observation"):
            self.check_result(self.call(self.make(), seeded(3), {**inputs, "predicted": far}), inputs)

    @statistical
    def test_weights_are_those_of_the_posterior(self) -> None:
        """Weighted predicted particles have the distribution p(x | y), and the exact evidence if it is given."""
        component = skip_unless_properly_weighted(self.make())

        def updated(n: int, seed: int = 2) -> tuple[Population, Population]:
            predicted, _, observation, *_ = self.exact_case(1, n)
            inputs = {"predicted": predicted, "proposed": None, "observation": observation}
            return predicted, self.checked_call(component, inputs, seeded(seed))

        n = self.draws_in_time(updated)
        predicted, out = updated(n)
        _, weighted, _, *evidence = self.exact_case(1, n)
        if as_matrix(out.particles).shape[1] != as_matrix(weighted.particles).shape[1]:
            raise SkipTest("its particles have another dimension than the exact ones")
        if same(out.particles, predicted.particles) and same(weighted.particles, predicted.particles):
            if same(out.log_weights, updated(n, seed=5)[1].log_weights):
                compare_factors(out.log_weights, weighted.log_weights)
            evidence = [weighted.log_mean_weight]
        _, exact, *_ = self.exact_case(3, n)
        x, lw = _merged(as_matrix(out.particles), out.log_weights)
        self.compare_weighted(x, lw, as_matrix(exact.particles), exact.log_weights)
        for log_evidence in evidence:
            w = np.exp(out.log_weights - predicted.log_mean_weight - log_evidence)
            v = np.exp(exact.log_weights - log_evidence) if np.ptp(exact.log_weights) else np.ones(n)
            check_mean_weight(w, v)


def _merged(x: np.ndarray, log_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows without copies, and the log of the sum of the weights of each row."""
    rows, index = np.unique(x, axis=0, return_inverse=True)
    if len(rows) == len(x):
        return x, log_weights
    top = log_weights.max()
    return rows, np.log(np.bincount(index.ravel(), np.exp(log_weights - top))) + top


class RejuvenationContract(ExactContract):
    """The contract of every `Rejuvenation`. The statistical test has a false-alarm rate of at most 1e-6.

    The statistical test needs a method ``exact(self, rng, n)`` that returns three values: n rows x_{t-1}, exact
    draws of x_t given x_{t-1} and y_t, and the observation y_t. At the first step x_{t-1} is None.
    """

    columns = "(x_t, x_t - x_{t-1})"

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {**super().inputs(n, seed), "previous": self.example(seeded(seed + 1), n)[0]}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.move(rng, inputs["population"], inputs["previous"], inputs["observation"])

    def variants(self) -> list[dict[str, Any]]:
        missing: tuple[dict[str, Any], ...] = ({}, {"previous": None}, {"observation": None})
        return [{**inputs, **absent} for inputs in super().variants() for absent in missing]

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n, log_weights = len(inputs["population"]), inputs["population"].log_weights
        assert len(result) == n, f"{n} particles became {len(result)}"
        assert same(result.log_weights, log_weights), (
            "it changes log weights: a kernel that keeps the distribution leaves them unchanged"
        )

    @statistical
    def test_keeps_the_distribution(self) -> None:
        """Moves leave p(x_t | x_{t-1}, y_t) invariant, and particles move independently."""
        component = skip_unless_properly_weighted(self.make())

        def moved(n: int) -> np.ndarray:
            """x_t, and x_t - x_{t-1}, of exact draws after five moves."""
            previous, population, observation = self.exact_case(1, n)
            rows, rng = seeded(4).permutation(n), seeded(2)
            previous, population = None if previous is None else previous.take(rows), population.take(rows)
            for _ in range(5):
                inputs = {"population": population, "previous": previous, "observation": observation}
                population = self.checked_call(component, inputs, rng)
            return _columns(previous, population)

        n = self.draws_in_time(moved)
        found, exact = moved(n), _columns(*self.exact_case(3, n)[:2])
        try:
            self.compare_weighted(found, np.zeros(n), exact, np.zeros(n))
        except AssertionError as error:
            raise AssertionError(f"exact draws are no longer exact after five moves: {error}") from error
        self.check_independent(found)

    @statistical
    def test_small_populations_are_exact(self) -> None:
        """Moves of populations of three particles keep the distribution too, over many calls."""
        component = skip_unless_properly_weighted(self.make())
        old, now, observation = self.exact_case(1, 9000)
        previous, fresh, _ = self.exact_case(3, 50_000)

        def call(k: int) -> tuple[np.ndarray, np.ndarray]:
            rows = np.arange(SMALL * k, SMALL * (k + 1))
            past, inputs = None if old is None else old.take(rows), {"population": now.take(rows)}
            moved = self.checked_call(component, {**inputs, "previous": past, "observation": observation}, seeded(k))
            return _columns(past, moved), np.zeros(SMALL)

        self.compare_small(call, _columns(previous, fresh), np.zeros(50_000))


def _columns(previous: Population | None, population: Population) -> np.ndarray:
    """Columns x_t, and x_t - x_{t-1} if x_t and x_{t-1} have the same shape."""
    x = as_matrix(population.particles)
    if previous is None:
        return x
    old = as_matrix(previous.particles)
    return np.concatenate([x, x - old], axis=1) if old.shape == x.shape else x
