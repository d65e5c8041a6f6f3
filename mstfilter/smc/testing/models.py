"""The contract of models: state-space models, programs, and filters made of them.

A model is used as if each particle were alone, and as if its densities were those of its draws. The contract asks for
both: particles must get the same moves and weights in other company, and draws must have the density that the model
states, for its transition, its initial distribution and its observations.

>>> from mstfilter.smc import Normal, StateSpaceModel
>>> from mstfilter.smc.testing import ModelContract, check_properties
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> all(result.failure is None for result in check_properties(model, ModelContract))
True

A filter examines a model only at the first steps of a run, since a run may not become slow
(`mstfilter.smc.first_steps`). This contract has time. It examines each step, with all particles and several groups of
them, and compares draws with densities. ``mstfilter check ./model.py:model`` runs it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar
from unittest import SkipTest

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import copied
from mstfilter.smc import (
    Distribution,
    Dynamics,
    Key,
    ParticleFilter,
    Population,
    Prior,
    Program,
    StateSpaceModel,
    as_matrix,
    bootstrap,
    child,
    log_mean_exp,
    normalise,
)
from mstfilter.smc.first_steps import Few, compare_alone, is_numeric, recorded, unexamined
from mstfilter.smc.inputs import split_input
from mstfilter.smc.models.programs.examination import examine_program
from mstfilter.smc.models.programs.filters import ProgramInitial, ProgramTransition, program_step, run_once
from mstfilter.smc.population import Particles, count_particles, take
from mstfilter.smc.testing.contract import FALSE_ALARM, prerequisite, same, seeded, statistical
from mstfilter.smc.testing.exact import ExactContract, check_same_law

_STEPS, _PARTICLES, _SEED = 20, 200, 1


class ModelContract(ExactContract):
    """The contract of a `StateSpaceModel`, a `Program`, the function of a program, or a filter made of one of them.

    `observations` are the observations of a run. Without them, they are drawn from the model by its
    method `simulate`.
    """

    observations: ClassVar[Sequence[Any] | None] = None
    columns = "x"

    def filter(self, component: Any = None) -> ParticleFilter:
        """A filter with 200 particles."""
        component = self.make() if component is None else component
        if isinstance(component, ParticleFilter):
            return replace(component, n=_PARTICLES)
        if isinstance(component, StateSpaceModel):
            return bootstrap(component, _PARTICLES)
        return (component if isinstance(component, Program) else Program(component)).bootstrap(_PARTICLES)

    def data(self) -> list[Any]:
        """The observations of a run."""
        given = self.observations
        return list(given) if given is not None else simulated(self.filter(), _STEPS)

    def steps(self) -> Iterator[tuple[ParticleFilter, Population | None, Any, Population, np.random.Generator]]:
        """Each step of a run: its filter, the particles before, the observation, those after, and a generator."""
        filter, before, ys = self.filter(), None, self.data()
        with unexamined():
            for t, (given, (state, _)) in enumerate(zip(ys, filter.iterate(ys, _SEED), strict=False)):
                self.check_time()
                y, u = split_input(given)
                stream = Key(_SEED).child("transition" if t else "initial", t)  # as the filter made it
                after = state.population
                assert after is not None
                yield filter.at_step(t, u), before, y, after, stream.generator()
                before = after

    @prerequisite
    def test_result_is_valid(self) -> None:
        """A filter of the model runs on the observations."""
        self.filter().run(self.data(), 0)

    @prerequisite
    def test_does_not_change_input(self) -> None:
        """A run leaves the observations unchanged."""
        ys = self.data()
        before = copy.deepcopy(ys)
        with unexamined():
            self.filter().run(ys, 0)
        for t, (y, old) in enumerate(zip(ys, before, strict=True)):
            assert same(y, old), f"observation {t} is changed in place: make a copy first"

    @prerequisite
    def test_depends_on_its_arguments_only(self) -> None:
        """Two runs with the same seed give the same particles: no other generator, and nothing kept in between."""
        ys, found = self.data(), []
        for component in (copied(self.fresh()), self.make(), self.make()):
            with unexamined():
                state = self.filter(component).run(ys, 5)[0]
            found.append((state.population.particles, state.population.log_weights))  # type: ignore[union-attr]
        assert all(same(found[0], other) for other in found[1:]), (
            "two runs with the same seed differ: draw from the generator that the function gets, and keep nothing in "
            "global variables, closures or objects"
        )

    @prerequisite
    def test_each_particle_is_alone(self) -> None:
        """At every step, each particle is processed as if it were alone, and has its own noise."""
        for filter, before, y, after, rng in self.steps():
            component: Any = filter.initial if before is None else filter.transition
            if isinstance(component, ProgramInitial | ProgramTransition):
                guide = None if y is None else component.guide
                examine_program(run_once, rng, component.model, guide, before, y, after, thorough=True)
            else:
                component.examine(rng, before, y, after)
                self._examine_densities(component, before, after)
            if filter.update is not None and y is not None:
                filter.update.examine(rng, after, y, after)
                for few in _groups(after.particles):
                    compare_alone("the log likelihood", lambda x, y=y, f=filter: f.update.log_likelihood(x, y), few)
            if filter.lookahead is not None and y is not None and before is not None:
                filter.lookahead.examine(rng, before, y, before)

    def _examine_densities(self, component: Any, before: Population | None, after: Population) -> None:
        """Examine the densities of a model with several groups, also those that the filter does not use."""
        model = component.model
        if before is None:
            if model.log_initial is not None:
                for few in _groups(after.particles):
                    compare_alone("the initial density", model.log_initial, few)
        elif model.log_transition is not None:
            for few in _groups(before.particles):
                compare_alone("the transition density", model.log_transition, few, take(after.particles, few.rows))

    @statistical
    def test_copies_move_independently(self) -> None:
        """Copies of a particle move independently, and with the same law at every place in the array."""
        filter, before, y, *_ = self._step(2)
        transition: Any = filter.transition
        if before is None or transition is None or not is_numeric(before.particles):
            raise SkipTest("the particles are objects, whose moves are not compared")
        n = 20_000
        copies = Population(take(before.particles, np.full(n, len(before) // 2)))
        moved, again = (_matrix(transition.predict(seeded(k), copies, y).particles) for k in (6, 7))
        random = np.ptp(moved, axis=0) > 0
        assert not (random & (moved == again).all(axis=0)).any(), (
            "copies of a particle get the same random numbers from every generator: draw from the one that is given"
        )
        for part in np.array_split(np.arange(n), 4):
            rest = np.setdiff1d(np.arange(n), part)
            check_same_law(moved[part], moved[rest], 4, f"copies of a particle move differently at place {part[0]}")
        self.check_independent(moved)
        if isinstance(transition, ProgramTransition):
            return  # the densities of its sites have been compared
        among = Population(take(before.particles, np.arange(0, len(before), 10)))
        row = len(among) // 2
        two = Population(take(among.particles, np.array([row, row])))
        pairs = [
            (transition.predict(child(seeded(8), k), two, y), transition.predict(child(seeded(9), k), among, y))
            for k in range(1000)
        ]
        a, b = (
            np.concatenate([_matrix(population.particles)[rows] for population in side])
            for side, rows in zip(zip(*pairs, strict=True), ([0], [row]), strict=True)
        )
        check_same_law(a, b, 1, "a particle moves differently with a copy and among others")

    def _step(self, t: int) -> Any:
        """Step t, or the last one if there are fewer."""
        last = None
        for k, step in enumerate(self.steps()):
            last = step
            if k == t:
                break
        return last

    @statistical
    def test_draws_have_the_density(self) -> None:
        """Draws of the model, of a proposal and of the distributions of a program have the density that it states."""
        filter, before, y, after, _ = self._step(2)
        initial: Any = filter.initial
        if isinstance(initial, ProgramInitial):
            self._compare_sites(filter, before, y, after)
            return
        model, n = initial.model, self.n_draws // 4
        if model.log_initial is None and model.log_transition is None:
            raise SkipTest("the model has no densities")
        if model.log_initial is not None:
            self._compare("x_0", model.sample_initial(seeded(7), n), model.log_initial)
        if model.log_transition is not None and before is not None:
            for row in (0, len(before) // 2):
                old = take(before.particles, np.full(n, row))
                new = model.sample_transition(seeded(8), old)
                self._compare("x_t", new, lambda x, old=old: model.log_transition(take(old, np.arange(len(x))), x))

    def _compare(self, what: str, draws: Particles, log_density: Any) -> None:
        """Compare draws of one distribution with its density, by importance weights of draws from a wider one."""
        if not isinstance(draws, np.ndarray) or draws.dtype == object:
            raise SkipTest("the density is compared for arrays only")
        n, found = len(draws), _matrix(draws)
        if draws.dtype.kind in "iub":
            if found.shape[1] > 1:
                return
            values, counts = np.unique(found[:, 0], return_counts=True)
            p = np.exp(log_density(values.astype(draws.dtype).reshape(-1, *draws.shape[1:])))
            wrong = np.abs(counts / n - p) > 6 * np.sqrt(p * (1 - np.minimum(p, 1)) / n) + 10 / n
            k = int(np.argmax(wrong))
            assert not wrong.any(), (
                f"draws of {what} do not have its density: {values[k]} is drawn with frequency {counts[k] / n:.4g}, "
                f"expected {p[k]:.4g}"
            )
            return
        sd = found.std(axis=0)
        if not (sd > 1e-9 * (1 + np.abs(found).max(axis=0))).all() or found.shape[1] > 6:
            return  # a part of the state is not random: there is no density on the space of all entries
        from scipy.stats import multivariate_normal, multivariate_t

        def ratio(x: np.ndarray, other: Any) -> np.ndarray:
            """(n,) density of the model over that of another distribution; 0 for NaN."""
            with np.errstate(all="ignore"):
                lw = np.asarray(log_density(x.reshape(draws.shape).astype(draws.dtype)), float) - other.logpdf(x)
            return np.exp(np.where(np.isnan(lw), -np.inf, lw))

        cov = np.atleast_2d(np.cov(found.T))
        wider = multivariate_t(found.mean(axis=0), 2 * cov, df=4, allow_singular=True)
        z = np.asarray(wider.rvs(n, random_state=seeded(9))).reshape(n, -1)
        w, fault = ratio(z, wider), f"draws of {what} do not have its density"
        if w.max() > 0.01 * w.sum():  # tails heavier than those of `wider`, or a fault: compare the other way round
            middle, half = np.quantile(found, [0.5, 0.75], axis=0)
            narrow = multivariate_normal(middle, np.diag((half - middle) ** 2 + 1e-300))
            with np.errstate(divide="ignore"):
                _check_integral(1 / ratio(found, narrow), fault)
            return
        _check_integral(w, fault)
        try:
            self.compare_weighted(z, np.log(np.maximum(w, 1e-300)), found, np.zeros(n))
        except AssertionError as error:
            raise AssertionError(f"{fault}: {error}") from None

    def _compare_sites(self, filter: ParticleFilter, before: Population | None, y: Any, after: Population) -> None:
        component: Any = filter.initial if before is None else filter.transition
        guide = None if y is None else component.guide
        with recorded() as runs:
            previous = None if before is None else before.particles
            program_step(seeded(3), component.model, guide, previous, y, len(after))
        for call in (call for run in runs for call in run.calls or ()):
            if call.distribution is not None:
                check_density(call.what, call.distribution, seeded(4))

    @statistical
    def test_a_proposal_agrees_with_the_model(self) -> None:
        """A proposal or guide gives the evidence that the model gives."""
        if not _has_proposal(self.filter()):
            raise SkipTest("the particles are drawn from the model")
        for filter, before, y, _, rng in self.steps():
            if y is not None:
                _compare_evidence(filter, before, y, rng)


def _check_integral(w: np.ndarray, fault: str) -> None:
    """Assert that the mean of importance weights is 1, up to the bound of Bernstein's inequality."""
    log_p = np.log(2 / FALSE_ALARM)
    bound = np.sqrt(2 * log_p * w.var() / len(w)) + log_p * w.max() / len(w)
    assert abs(w.mean() - 1) <= bound, f"{fault}: the integral of the density is {w.mean():.4g}, expected 1"


def simulated(filter: ParticleFilter, n_steps: int, seed: int = 0) -> list[Any]:
    """Observations drawn from the model of a filter."""
    initial: Any = filter.initial
    model = Program(initial.model) if isinstance(initial, ProgramInitial) else initial.model
    try:
        return [y.item() if np.ndim(y) == 0 else y for y in model.simulate(n_steps, seed)[1]]
    except Exception as error:
        what = error.message if isinstance(error, InputError) else f"the model cannot be simulated ({error})"
        hint = "give observations (mstfilter check ./model.py:model --observations ./model.py:ys)"
        raise InputError(f"{what}: {hint}") from error


def _groups(particles: Particles) -> list[Few]:
    """All particles, with two of middle, of small and of large values."""
    few = Few.of(particles, count_particles(particles))
    column = as_matrix(few.particles)[:, 0] if is_numeric(particles) else np.arange(len(few))
    order = np.argsort(column, kind="stable")
    return [few, *(replace(few, pair=pair) for pair in (order[[1, 0]], order[[-1, -2]]))] if len(few) > 3 else [few]


def _matrix(particles: Particles) -> np.ndarray:
    return np.nan_to_num(as_matrix(particles))


def _has_proposal(filter: ParticleFilter) -> bool:
    initial, transition = filter.initial, filter.transition
    if isinstance(initial, ProgramInitial):
        return initial.guide is not None
    return any(isinstance(c, Prior | Dynamics) and c.proposal is not None for c in (initial, transition))


def _compare_evidence(filter: ParticleFilter, before: Population | None, y: Any, rng: np.random.Generator) -> None:
    """Assert that proposal and model give the same estimate of p(y_t | y_0 .. y_{t-1}), if both are accurate."""
    n = 20_000
    component: Any = filter.initial if before is None else filter.transition
    plain = replace(
        component, **{"guide" if isinstance(component, ProgramInitial | ProgramTransition) else "proposal": None}
    )
    found = []
    past = None
    if before is not None:
        past = Population(take(before.particles, seeded(4).choice(len(before), n, p=before.weights)))
    for c, stream in ((component, "proposal"), (plain, "model")):
        generator = child(rng, stream)
        moved = c.sample(generator, y, n) if past is None else c.predict(generator, past, y)
        if filter.update is not None:
            moved = filter.update.update(generator, moved, None, y)
        found.append(moved.log_weights)
    by_guide, by_model = found
    spread, spread_guide = (float((normalise(lw) ** 2).sum()) - 1 / n for lw in (by_model, by_guide))
    gap, both = log_mean_exp(by_guide) - log_mean_exp(by_model), spread + spread_guide
    assert not (spread < 0.005 and gap < -0.5 - 6 * np.sqrt(spread)), (
        f"the proposal gives an evidence that is {-gap:.3g} nats too small: it is narrower than the posterior and "
        "loses a part of it"
    )
    assert not (both < 0.005 and abs(gap) > 0.02 + 6 * np.sqrt(both)), (
        f"the proposal and the model give estimates of the evidence that differ by {gap:.3g} nats: is a density "
        "wrong?"
    )


def check_density(what: str, distribution: Distribution, rng: np.random.Generator) -> None:
    """Assert that the draws of a user's scalar distribution have its density.

    For 1000 sorted draws, the integral of the density from the least draw may differ from the empirical distribution
    function by less than .12. If the bounds of the integral hold, the false-alarm rate is 1e-12 (Dvoretzky, Kiefer,
    Wolfowitz). A part of the density that no draw reaches is not tested, nor is a pole.
    """
    kind = type(distribution)
    if kind.__module__.startswith("mstfilter.") or distribution.event_shape:
        return
    n = (distribution.parameter_shape or (1,))[0]
    if n == 0:
        return
    generator, row = child(rng, "density"), n // 2
    # Draws of one row; a distribution that all particles share draws them in one call.
    calls, size = (1000, n) if n > 1 else (1, 1000)
    draws = np.array([distribution.sample(generator, size) for _ in range(calls)])
    x = np.sort(draws[:, row] if n > 1 else draws[0])

    def density(values: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            found = [np.broadcast_to(distribution.log_prob(np.full(n, v, x.dtype)), n)[row] for v in values]
        return np.exp(found)

    if distribution.discrete:
        values, counts = np.unique(x, return_counts=True)
        p = density(values)
        distance, total = float(abs(counts / len(x) - p).max()), float(p.sum())
    else:
        draws_below, f = np.arange(len(x)) / len(x), density(x)
        x, draws_below, f = x[f < np.inf], draws_below[f < np.inf], f[f < np.inf]  # without poles
        for rounds in range(21):
            # The harmonic and the arithmetic mean of the ends bound a monotone convex density.
            width, ends = np.diff(x), np.maximum(f[:-1] + f[1:], 1e-300)
            low, high = 2 * width * f[:-1] * (f[1:] / ends), width * ends / 2
            unclear = np.maximum(high - low - 1e-3, high - 0.01)
            coarse = np.argsort(unclear)[-100:]
            coarse = coarse[unclear[coarse] > 0]
            if rounds == 20 or not len(coarse):
                break
            middle = x[coarse] + np.diff(x)[coarse] / 2
            x, f = np.insert(x, coarse + 1, middle), np.insert(f, coarse + 1, density(middle))
            draws_below = np.insert(draws_below, coarse + 1, draws_below[coarse + 1])
        below = np.append(0.0, np.cumsum(low)), np.append(0.0, np.cumsum(high))
        draws_below = draws_below - draws_below[:1]
        distance = float(np.maximum(below[0] - draws_below, draws_below - below[1]).max(initial=0.0))
        total = float(below[0][-1])
    assert distance < 0.12, (
        f"{what}: draws of {kind.__qualname__} do not have its density: they differ by {distance:.2g}, and "
        f"the density has the total {total:.3g}; log_prob is the log of a normalised density"
    )
