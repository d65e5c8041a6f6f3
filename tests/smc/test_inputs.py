"""Models whose functions take the index of the step and an input."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.smc import (
    Branching,
    Dynamics,
    Normal,
    Reweight,
    StateSpaceModel,
    Transition,
    WithInput,
    auxiliary,
    backward_paths,
    batch,
    bootstrap,
    conditional_path,
    guided,
    keep,
    paris,
    path_log_prob,
)
from mstfilter.smc.inputs import step_parameters

YS = [0.3, -0.2, None, 1.1, 0.4]
US = [0.5, 1.0, -1.0, 0.25, 2.0]
WITH = [WithInput(y, u) for y, u in zip(YS, US, strict=True)]
SEEN: list = []


def moving(x, t, u):
    SEEN.append((t, u))
    return Normal(0.9 * x + u, 0.5 + 0.1 * t)


MODEL = StateSpaceModel.of(Normal(0.0, 1.0), moving, lambda x, *, t: Normal(x, 1.0 + 0.1 * t))


def by_hand(t, u):
    """The model of step t."""
    return StateSpaceModel.of(
        Normal(0.0, 1.0), lambda x: Normal(0.9 * x + u, 0.5 + 0.1 * t), lambda x: Normal(x, 1.0 + 0.1 * t)
    )


def stepped(filter_of, seed=3):
    """A run in which each step has the filter of its own model."""
    state = filter_of(by_hand(0, US[0])).start(seed)
    for t, y in enumerate(YS):
        state, _ = filter_of(by_hand(t, US[t])).step(state, y)
    return state


FILTERS = {
    "bootstrap": lambda model: bootstrap(model, 30),
    "guided": lambda model: guided(model, lambda x, y: Normal(0.5 * (x + y), 1.0), 30),
    "auxiliary": lambda model: auxiliary(model, lambda x, y: -0.1 * (x - y) ** 2, 30),
    "branching": lambda model: replace(
        bootstrap(model, 30), transition=Branching(Dynamics(model), 2), resample="after"
    ),
}


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_equals_the_one_whose_model_is_made_anew_for_each_step(name):
    state, _ = FILTERS[name](MODEL).run(WITH, 3)
    expected = stepped(FILTERS[name])
    np.testing.assert_array_equal(state.population.particles, expected.population.particles)
    np.testing.assert_array_equal(state.population.log_weights, expected.population.log_weights)


def test_the_first_transition_is_called_with_the_second_step():
    SEEN.clear()
    bootstrap(MODEL, 3).run(WITH)
    assert list(enumerate(US))[1:] == SEEN


def test_batches_smoothing_and_conditional_paths_take_inputs():
    filter = bootstrap(MODEL, 20)
    for paired, data in ((False, WITH), (True, [WITH, WITH[::-1]])):
        runs = batch(filter, data, [3, 4], paired)
        single = [filter.run(data[r] if paired else data, seed)[0] for r, seed in enumerate((3, 4))]
        assert [state.log_evidence for state in single] == runs.log_evidence[:, -1].tolist()
    path = conditional_path(filter, WITH, 1)
    total = MODEL.log_initial(path[:1])[0]
    for t, y in enumerate(YS):
        model = by_hand(t, US[t])
        total += model.log_transition(path[t - 1 : t], path[t : t + 1])[0] if t else 0.0
        total += 0.0 if y is None else model.log_likelihood(path[t : t + 1], y)[0]
    assert path_log_prob(filter, WITH, path) == pytest.approx(total, abs=1e-12)
    paths = backward_paths(np.random.default_rng(0), keep(filter, WITH, 0), Dynamics(MODEL), 50)
    assert len(paths) == len(WITH)
    assert len(list(paris(filter, WITH, lambda t, old, new: new, Dynamics(MODEL)))) == len(WITH)


def test_a_checkpoint_resumes_with_inputs(tmp_path):
    filter, path = bootstrap(MODEL, 20), tmp_path / "run.npz"
    filter.run(WITH[:3], 5, checkpoint=path)
    resumed, _ = filter.run(WITH, 5, checkpoint=path)
    assert resumed.log_evidence == filter.run(WITH, 5)[0].log_evidence
    other = [WithInput(YS[0], 9.0), *WITH[1:]]
    with pytest.raises(InputError, match="observations differ"):
        filter.run(other, 5, checkpoint=path)


def test_an_input_that_is_not_given_is_named():
    with pytest.raises(InputError, match=r"step 1, transition: .* parameter u, and step 1 has no input"):
        bootstrap(MODEL, 5).run(YS)
    default = StateSpaceModel.of(Normal(0.0, 1.0), lambda x, u=0.0: Normal(x + u, 1.0), lambda x: Normal(x, 1.0))
    without = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(x, 1.0), lambda x: Normal(x, 1.0))
    assert bootstrap(default, 5).run(YS)[0].log_evidence == bootstrap(without, 5).run(YS)[0].log_evidence


def test_parameters_of_the_step_follow_the_other_arguments():
    assert step_parameters(lambda u: 0, 1) == {} == step_parameters(max, 1)
    assert step_parameters(lambda u, t: 0, 1) == {"t": True}
    assert step_parameters(lambda x, *, u=None, t: 0, 1) == {"u": False, "t": True}
    assert step_parameters(lambda x, *t, **u: 0, 1) == {}


@dataclass(frozen=True)
class Drift(Transition):
    rate: float = 0.0

    def at(self, t, u=None):
        return replace(self, rate=t * u)

    def predict(self, rng, population, observation):
        return population.moved(population.particles + self.rate)


def test_components_that_override_at_are_bound_also_inside_another():
    start = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(x, 1.0), lambda x: Normal(x, 1.0))
    filter = replace(bootstrap(start, 4), transition=Drift(), update=Reweight(lambda x, y: np.zeros(len(x))))
    first = filter.run(WITH[:1])[0].population.particles
    expected = first + sum(t * u for t, u in enumerate(US))
    np.testing.assert_allclose(filter.run(WITH)[0].population.particles, expected)
    branching = replace(filter, transition=Branching(Drift(), 1))
    np.testing.assert_allclose(branching.run(WITH)[0].population.particles, expected)


def test_components_without_time_are_used_as_they_are():
    filter = bootstrap(by_hand(0, 1.0), 5)
    assert filter.at(3, 1.0) is filter
