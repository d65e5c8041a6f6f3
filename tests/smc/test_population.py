"""Populations: validation, selection, lazy candidates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mstfilter.base.errors import InputError, LostRunError
from mstfilter.smc import Always, Candidates, Population, WeightResampler, bootstrap, log_mean_exp
from mstfilter.smc.population import take, union
from tests.smc.models import AR1


@pytest.mark.parametrize(
    "particles",
    [np.arange(12.0).reshape(4, 3), {"a": np.arange(4), "b": np.ones((4, 2))}, ("w", "x", "y", "z")],
    ids=["array", "mapping", "objects"],
)
def test_take_selects_from_every_kind(particles):
    population = Population(particles, np.log([1.0, 2.0, 3.0, 4.0]), {"previous": np.arange(4)})
    chosen = population.take(np.array([3, 3, 0]))
    assert len(chosen) == 3
    np.testing.assert_allclose(chosen.weights, [4 / 9, 4 / 9, 1 / 9])
    np.testing.assert_array_equal(chosen.parents["previous"], [3, 3, 0])
    if isinstance(particles, tuple):
        assert chosen.particles == ("z", "z", "w")
        assert population.best == "z"
    elif isinstance(particles, dict):
        np.testing.assert_array_equal(chosen.particles["a"], [3, 3, 0])
        assert population.best["a"] == 3
    else:
        np.testing.assert_array_equal(chosen.particles[:, 0], [9, 9, 0])


def test_different_particles_of_equal_weight_have_no_best_one():
    """After resampling, the first particle is a random draw. Copies of one particle are that particle."""
    for particles in (np.arange(3.0), {"x": np.arange(3.0), "y": np.zeros(3)}, ("a", "b", "c"), Candidates(str, 3)):
        with pytest.raises(InputError, match="2 of 3 particles share the largest weight") as raised:
            _ = Population(particles, np.log([2.0, 1.0, 2.0])).best
        assert "estimate" in raised.value.hints[0]
        copies = Population(particles).take(np.array([2, 2, 0]), np.log([2.0, 2.0, 1.0]))
        assert copies.best == Population(take(particles, np.array([2]))).best
    assert Population({"x": np.array([5, 5]), "y": np.array([1, 1])}).best == {"x": 5, "y": 1}


def test_a_selection_without_weight_is_named():
    """It is the choice of the caller, and no lost run."""
    population = Population(np.arange(3.0), np.array([0, -np.inf, -np.inf]))
    with pytest.raises(InputError, match="all 2 selected particles have weight 0") as raised:
        population.take(np.array([1, 2]))
    assert not isinstance(raised.value, LostRunError)
    with pytest.raises(InputError, match="no particle is selected"):
        population.take(np.array([], int))
    with pytest.raises(LostRunError, match="no particle explains"):
        population.reweighted(np.full(3, -np.inf))


@pytest.mark.parametrize("variables", [("a", "b"), ("b", "a")])
def test_populations_of_other_variables_are_not_joined(variables):
    """The variable that one population lacks would be lost."""
    one, both = Population({"x": np.zeros(2)}), Population({"x": np.ones(3), "y": np.ones(3)})
    pair = (one, both) if variables == ("a", "b") else (both, one)
    with pytest.raises(InputError, match=r"particles have the variables \['x'.*\] and \['x'"):
        union(*pair)
    assert union(both, both).particles["y"].shape == (6,)


def test_populations_cannot_be_written_to():
    population = Population(np.arange(3.0), np.zeros(3))
    with pytest.raises(ValueError, match="read-only"):
        population.particles[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        population.log_weights[0] = 1
    parents = Population(np.arange(3.0), None, {"previous": np.arange(3)}).parents
    with pytest.raises(ValueError, match="read-only"):
        parents["previous"][0] = 1


def test_arrays_are_shared_and_selections_of_them_are_copies():
    """What is handed in is viewed, not copied; who writes to the original writes to the population."""
    x, lw, named, thing = np.arange(3.0), np.zeros(3), {"a": np.arange(3)}, object()
    population, mapping = Population(x, lw), Population(named)
    chosen = population.take(np.array([0, 0, 1]))
    x[0], lw[0], named["a"][0] = 7.0, -1.0, 7
    assert population.particles[0] == 7.0
    assert population.log_weights[0] == -1.0
    assert mapping.particles["a"][0] == 7
    named["b"] = np.arange(3)
    assert list(mapping.particles) == ["a"]
    np.testing.assert_array_equal(chosen.particles, [0.0, 0.0, 1.0])
    assert x.flags.writeable and lw.flags.writeable, "the original stays yours"
    objects = Population((thing, "b")).take(np.array([0, 0]))
    assert objects.particles[0] is objects.particles[1] is thing


@pytest.mark.parametrize(
    ("lw", "message"),
    [
        ([0.0, np.nan], "particle 1 is nan"),
        ([np.inf, 0.0], "particle 0 is inf"),
        ([-np.inf, -np.inf], "all 2 log weights"),
        ([0.0], "expected .2,."),
    ],
)
def test_bad_weights_are_named(lw, message):
    with pytest.raises(InputError, match=message):
        Population(np.zeros(2), np.array(lw))


def test_no_particles_and_unequal_lengths():
    with pytest.raises(InputError, match="no particles"):
        Population(())
    with pytest.raises(InputError, match="different lengths"):
        Population({"a": np.zeros(2), "b": np.zeros(3)})


def test_weights_survive_extreme_offsets():
    for offset in (-1e4, 0.0, 1e4):
        lw = np.log([1.0, 2.0, 5.0]) + offset
        np.testing.assert_allclose(Population(np.zeros(3), lw).weights, [0.125, 0.25, 0.625])
        assert log_mean_exp(lw) == pytest.approx(np.log(8 / 3) + offset)
        assert Population(np.zeros(3), lw).ess == pytest.approx(64 / 30)


def test_candidates_are_built_once_and_only_when_looked_at():
    built = []

    def build(i):
        built.append(i)
        return f"candidate {i}"

    candidates = Candidates(build, 1000)
    population = Population(candidates, np.zeros(1000)).take(np.array([7, 7, 500]))
    assert built == []
    realised = population.realised()
    assert realised.particles == ("candidate 7", "candidate 7", "candidate 500")
    assert built == [7, 500]
    assert candidates[7] == "candidate 7"
    assert built == [7, 500]
    assert candidates.n_built == 2


def test_a_function_of_candidates_is_computed_on_access():
    candidates = Candidates(lambda i: 10 * i, np.array([4, 2]))
    mapped = candidates.map(str)
    assert candidates.n_built == 0
    assert tuple(mapped.take(np.array([1]))) == ("20",)
    assert (candidates.n_built, tuple(mapped)) == (1, ("40", "20"))


def test_moved_particles_keep_weights_and_parents():
    population = Population(np.zeros(3), np.log([1.0, 2.0, 3.0]), {"previous": np.arange(3)}, {"note": 1})
    moved = population.moved(np.ones((3, 2)))
    assert moved.ess == population.ess and moved.notes == {} and moved.parents is population.parents
    with pytest.raises(ValueError, match="read-only"):
        moved.particles[0] = 2
    with pytest.raises(InputError, match="3 particles became 2"):
        population.moved(np.zeros(2))


@dataclass(frozen=True)
class WrongAncestors(WeightResampler):
    ancestors: tuple

    def select(self, rng, log_weights, n):
        return np.array(self.ancestors), None


@pytest.mark.parametrize(
    ("ancestors", "message"),
    [
        ((0, -1, 2), "index 1 of the selected particles is -1, expected 0 to 2"),
        ((0, 1, 99), "index 2 of the selected particles is 99, expected 0 to 2"),
        ((0.0, 1.0, 2.0), "indices are of type float64, expected integers"),
    ],
)
def test_wrong_ancestors_are_a_named_error(ancestors, message):
    with pytest.raises(InputError, match=message):
        Population(np.zeros(3)).take(np.array(ancestors))
    filter = bootstrap(AR1, 3, WrongAncestors(ancestors), Always())
    with pytest.raises(InputError, match=f"step 1, resampler: {message}"):
        filter.run([0.1, 0.2], 0)


def test_parents_are_integers():
    with pytest.raises(InputError, match='parents "previous" are of type float64, expected integers'):
        Population(np.zeros(2), parents={"previous": np.array([0.0, 1.7])})


def test_arrays_of_other_libraries_are_named_with_the_cure():
    """The elements of a tensor would otherwise be the particles: objects, which no function of numpy understands."""
    torch = pytest.importorskip("torch")
    needs_grad = torch.zeros(3, requires_grad=True)
    jax_array = type("ArrayImpl", (), {"__module__": "jaxlib._jax", "__dlpack__": None, "__len__": lambda self: 3})
    for array, named in ((torch.zeros(3), "Tensor of torch"), (needs_grad, "Tensor of torch")):
        for particles, what in ((array, "particles"), ({"x": array}, "variable 'x'")):
            with pytest.raises(InputError, match=f"{what}: found {named}, expected a NumPy array") as found:
                Population(particles)
            assert "x.detach().cpu().numpy()" in found.value.hints[0]
    with pytest.raises(InputError, match=r"found ArrayImpl of jax,"):
        Population(jax_array())
    with pytest.raises(InputError, match="found Tensor of torch"):
        Population(np.zeros(3)).moved(torch.zeros(3))
    assert Population({"x": [1.0, 2.0]}).particles["x"].tolist() == [1.0, 2.0]
    assert len(Population([torch.zeros(3), torch.zeros(3)])) == 2  # two objects
