"""State-space models, the components made from them, and the textbook filters.

The state is a Markov chain, x_0 ~ p(x_0) and x_t ~ f(x_t | x_{t-1}), and each observation depends on the present
state, y_t ~ p(y_t | x_t). Three distributions are a model:

>>> from mstfilter.smc import Normal, RandomWalkMove, StateSpaceModel, auxiliary, bootstrap, guided, resample_move
>>> model = StateSpaceModel.of(
...     initial=Normal(0.0, 1.0),
...     transition=lambda x: Normal(0.9 * x, 0.5),
...     observation=lambda x: Normal(x, 1.0),
... )
>>> states, observations = model.simulate(100, seed=1)
>>> state, infos = bootstrap(model, n=1000).run(observations, seed=0)           # Gordon, Salmond, Smith 1993

The bootstrap filter moves particles by f, and so without regard to y_t. If the likelihood is narrow, few of them
land where it is large. A guided filter draws them from a proposal q(x_t | x_{t-1}, y_t) and multiplies the weights by
f / q. An auxiliary filter selects the particles with an eye on y_t before it moves them, by weight times a priority
near p(y_t | x_{t-1}). A resample-move filter makes copies of a particle differ again by a Markov kernel:

>>> def proposal(x, y):                                                         # the product of two Gaussians
...     return Normal(0.9 * x + 0.2 * (y - 0.9 * x), 0.2**0.5)
>>> def log_priority(x, y):
...     return Normal(0.9 * x, 1.25**0.5).log_prob(y)
>>> filters = [
...     guided(model, proposal, n=100),                                         # Doucet, Godsill, Andrieu 2000
...     auxiliary(model, log_priority, n=100, proposal=proposal),               # Pitt and Shephard 1999
...     resample_move(model, RandomWalkMove(model, 0.5), n=100),                # Gilks and Berzuini 2001
... ]
>>> all(abs(f.run(observations, seed=0)[0].log_evidence - state.log_evidence) < 2 for f in filters)
True

Each filter is a `ParticleFilter`, so any component can be replaced: ``replace(bootstrap(model, 100),
resampler=...)``. The first observation updates the initial state before any prediction. Reference: Chopin and
Papaspiliopoulos (2020), chapter 10.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.components import EssBelow, Reweight
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.first_steps import (
    DRAWS,
    MOST,
    REPEATED,
    Few,
    check_draws,
    check_own_noise,
    check_reach,
    compare_alone,
    first_difference,
    spread_rows,
)
from mstfilter.smc.inputs import AtStep, check_signature
from mstfilter.smc.interfaces import (
    DensityTransition,
    Distribution,
    Lookahead,
    Proposal,
    Rejuvenation,
    Resampler,
    Trigger,
)
from mstfilter.smc.models.distributions import Joint, as_distribution
from mstfilter.smc.models.simulation import first_row, simulate_steps
from mstfilter.smc.population import Particles, Population, count_particles, take
from mstfilter.smc.resampling import Systematic


@dataclass(frozen=True)
class StateSpaceModel(AtStep):
    """A hidden Markov model on any state space.

    The functions process each particle as if it were alone; a filter examines this at the first steps
    (`mstfilter.smc.first_steps`). They may have further parameters: ``t`` gets the index of the step, and ``u`` gets
    its input (see `mstfilter.smc.inputs`).

    Parameters
    ----------
    sample_initial : callable
        ``(rng, n) -> particles`` draws x_0.
    sample_transition : callable
        ``(rng, particles) -> particles`` draws x_t given x_{t-1}.
    log_likelihood : callable
        ``(particles, y) -> (n,)`` log p(y_t | x_t).
    log_initial : callable, optional
        ``(particles) -> (n,)`` log p(x_0), for guided filters and moves.
    log_transition : callable, optional
        ``(previous, new) -> (n,)`` log f(x_t | x_{t-1}) of paired rows, for guided filters and moves.
    sample_observation : callable, optional
        ``(rng, particles) -> (n, ...)`` draws y_t given x_t, for `simulate`.
    """

    sample_initial: Callable[[np.random.Generator, int], Any]
    sample_transition: Callable[[np.random.Generator, Any], Any]
    log_likelihood: Callable[[Any, Any], np.ndarray]
    log_initial: Callable[[Any], np.ndarray] | None = None
    log_transition: Callable[[Any, Any], np.ndarray] | None = None
    sample_observation: Callable[[np.random.Generator, Any], Any] | None = None

    step_functions: ClassVar = {
        "sample_observation": 2,
        "sample_initial": 2,
        "sample_transition": 2,
        "log_likelihood": 2,
        "log_initial": 1,
        "log_transition": 2,
    }

    @classmethod
    def of(cls, initial: Any, transition: Callable[..., Any], observation: Callable[..., Any]) -> StateSpaceModel:
        """Make a model from distributions of this package, or frozen distributions of scipy.stats.

        `initial` is the distribution of x_0. ``transition(particles)`` and ``observation(particles)`` return the
        distributions of x_t and y_t, with one row per particle. The functions may also have the parameters ``t`` and
        ``u``.

        A mapping from names to distributions stands for several variables, drawn in its order. A function of the
        variables drawn so far can replace a distribution (`Joint`). Particles, or observations, are then mappings.
        """
        first = as_distribution(initial)
        for name, function in (("transition", transition), ("observation", observation)):
            if not callable(function):
                raise InputError(
                    f"{name} is {function!r}, expected a function of the particles that returns a distribution"
                )
            check_signature(name, function, 1)

        model = _Densities(transition, observation)
        return cls(
            first.sample,
            model.sample_transition,
            model.log_likelihood,
            partial(_log_state, first),
            model.log_transition,
            model.sample_observation,
        )

    def simulate(self, n_steps: int, seed: int = 0, inputs: Iterable[Any] | None = None) -> tuple[Particles, Any]:
        """Draw states x_0 .. x_{T-1} and observations y_0 .. y_{T-1} from the model.

        Parameters
        ----------
        n_steps : int
            Number of steps T.
        seed : int
        inputs : iterable of length T, optional
            The input of each step, for functions with a parameter ``u``.

        Returns
        -------
        states : (T, ...) array, mapping of arrays (T, ...), or tuple of T objects
            As the particles of the model.
        observations : (T, ...) array or list of T observations
            What a filter takes: with inputs, a list of `WithInput`.

        Raises
        ------
        InputError
            If the model has no `sample_observation`.
        """

        def step(rng: np.random.Generator, t: int, u: Any, x: Any) -> tuple[Any, Any]:
            at = self.at_step(t, u)
            if at.sample_observation is None:
                raise InputError(
                    "the model has no sample_observation to draw observations",
                    "give StateSpaceModel a function sample_observation(rng, particles), or use .of()",
                )
            x = at.sample_initial(rng, 2) if x is None else at.sample_transition(rng, x)
            return x, first_row(at.sample_observation(rng, x))

        return simulate_steps(step, n_steps, seed, inputs)

    def density(self, which: str) -> Callable[..., np.ndarray]:
        """The function ``log_initial`` or ``log_transition``.

        Raises InputError if the model was made without this density.
        """
        found = self.log_initial if which == "log_initial" else self.log_transition
        if found is None:
            raise InputError(
                f"the model has no {which}",
                "give StateSpaceModel its log densities, or use .of(); a singular covariance has none",
            )
        return found


@dataclass(frozen=True)
class _Densities(AtStep):
    """The functions of a model whose x_t and y_t have distributions given the particles."""

    transition: Callable[..., Any]
    observation: Callable[..., Any]
    step_functions: ClassVar = {"transition": 1, "observation": 1}

    def sample_transition(self, rng: np.random.Generator, x: Any) -> np.ndarray:
        new = as_distribution(self.transition(x)).sample(rng, count_particles(x))
        return _of_shape("transition", new, x)

    def log_transition(self, previous: Any, new: Any) -> np.ndarray:
        return _log_state(as_distribution(self.transition(previous)), new)

    def log_likelihood(self, x: Any, y: Any) -> np.ndarray:
        return _log_likelihood(as_distribution(self.observation(x)), y)

    def sample_observation(self, rng: np.random.Generator, x: Any) -> np.ndarray:
        return as_distribution(self.observation(x)).sample(rng, count_particles(x))


def _of_shape(what: str, new: Any, old: Any) -> Any:
    """The new particles. Raises InputError if their shape differs, because numpy might broadcast them."""
    found, expected = _shape(new), _shape(old)
    if expected is not None and found != expected:
        raise InputError(
            f"the {what} returned shape {found}, expected {expected} as the particles before",
            "x[:, None] makes (n, 1) of (n,)",
        )
    return new


def _shape(particles: Any) -> Any:
    """The shape of an array, or the shapes of a mapping by name; None for objects."""
    if isinstance(particles, np.ndarray):
        return particles.shape
    return {name: np.shape(a) for name, a in particles.items()} if isinstance(particles, Mapping) else None


def _log_state(distribution: Distribution, x: Any) -> np.ndarray:
    """(n,) log density of states. Checks the shape of the particles, which a proposal may have drawn."""
    if not isinstance(distribution, Joint) and np.shape(x)[1:] != distribution.event_shape:
        raise InputError(f"particles have shape {np.shape(x)}, expected the event shape {distribution.event_shape}")
    return distribution.log_prob(x)


def _log_likelihood(distribution: Distribution, y: Any) -> np.ndarray:
    """(n,) log p(y | x). Checks the shape of y, because numpy would broadcast entries of y against particles."""
    if isinstance(distribution, Joint):
        return distribution.log_prob(y)
    found, event = () if isinstance(y, float) else np.shape(y), distribution.event_shape
    if found not in (event, (1, *event)) and (found, event) != ((), (1,)):
        raise InputError(
            f"the observation has shape {found}, expected the event shape {event}",
            "a vector of d entries needs parameters (n, d) or (1, d), such as Normal(x[:, None], 1.0)",
        )
    return distribution.log_prob(y)


@dataclass(frozen=True)
class Prior(Proposal):
    """Draws the first particles from p(x_0), or from a proposal q(x_0 | y_0) with weights p(x_0) / q.

    Parameters
    ----------
    model : StateSpaceModel
        The model, with `log_initial` if there is a proposal.
    proposal : callable, optional
        ``y -> distribution`` q. If y_0 is missing, particles are drawn from p(x_0).
    """

    model: StateSpaceModel
    proposal: Callable[..., Any] | None = None
    alone: ClassVar[bool] = True
    step_functions: ClassVar = {"model": None, "proposal": 1}

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        if self.proposal is None or observation is None:
            return Population(self.model.sample_initial(rng, n))
        q = as_distribution(self.proposal(observation))
        x = q.sample(rng, n)
        return Population(x, self.model.density("log_initial")(x) - q.log_prob(x))

    def log_weight(self, new: Any, observation: Any) -> np.ndarray:
        """(n,) log p(x_0) - log q(x_0 | y_0) of given particles; 0 without a proposal or observation."""
        if self.proposal is None or observation is None:
            return np.zeros(count_particles(new))
        return self.model.density("log_initial")(new) - as_distribution(self.proposal(observation)).log_prob(new)

    def examine(
        self, rng: np.random.Generator, before: Population | None, observation: Any, after: Population
    ) -> bool:
        n, model = len(after), self.model
        if self.proposal is None or observation is None:
            again = model.sample_initial(rng, n)
            different = first_difference(after.particles, again)
            if different:
                raise InputError(
                    f"the initial distribution: {different} differ when it is drawn again with the same generator",
                    *REPEATED,
                )
            with suppress(IndexError):  # fewer than 64 stored particles
                many = again if n >= 16 else model.sample_initial(rng, MOST)
                check_own_noise("the initial distribution", many, lambda: model.sample_initial(rng, max(n, MOST)))
        else:
            q = as_distribution(self.proposal(observation))
            with np.errstate(all="ignore"):
                x, own = q.sample(rng, DRAWS), model.sample_initial(rng, DRAWS)
                gain = self.log_weight(x, observation) + model.log_likelihood(x, observation)
                check_reach("the proposal", model.log_likelihood(own, observation), q.log_prob(own), gain)
            compare_alone("the initial density", model.density("log_initial"), Few.of(after.particles))
        return True


@dataclass(frozen=True)
class Dynamics(DensityTransition):
    """Moves particles by f(x_t | x_{t-1}), or by a proposal q(x_t | x_{t-1}, y_t) with weights f / q.

    Parameters
    ----------
    model : StateSpaceModel
        The model, with `log_transition` if there is a proposal.
    proposal : callable, optional
        ``(particles, y) -> distribution`` of x_t, one row per particle. The tails of the distribution must not be
        lighter than the tails of f(x_t | x_{t-1}) p(y_t | x_t). If y_t is missing, particles move by f.
    """

    model: StateSpaceModel
    proposal: Callable[..., Any] | None = None
    alone: ClassVar[bool] = True
    step_functions: ClassVar = {"model": None, "proposal": 2}

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        old = population.particles
        if self.proposal is None or observation is None:
            return population.moved(self.model.sample_transition(rng, old))
        q = as_distribution(self.proposal(old, observation))
        new = _of_shape("proposal", q.sample(rng, len(population)), old)
        gain = self.model.density("log_transition")(old, new) - q.log_prob(new)
        return Population(new, population.log_weights + gain, population.parents)

    def log_prob(self, previous: Any, new: Any, observation: Any) -> np.ndarray:
        """(n,) log density of the move: log q, or log f if there is no proposal or no observation."""
        if self.proposal is None or observation is None:
            return self.model.density("log_transition")(previous, new)
        return as_distribution(self.proposal(previous, observation)).log_prob(new)

    def log_weight(self, previous: Any, new: Any, observation: Any) -> np.ndarray:
        """(n,) log f - log q of given moves; 0 if there is no proposal or no observation."""
        if self.proposal is None or observation is None:
            return np.zeros(count_particles(new))
        return self.model.density("log_transition")(previous, new) - self.log_prob(previous, new, observation)

    def examine(
        self, rng: np.random.Generator, before: Population | None, observation: Any, after: Population
    ) -> bool:
        assert before is not None
        few, model = Few.of(before.particles), self.model
        if self.proposal is None or observation is None:
            new = check_draws("the transition", model.sample_transition, few, rng)
        else:
            new = check_draws("the proposal", lambda rng, x: self._propose(rng, x, observation), few, rng)
            if new is not None:
                density = partial(self.log_prob, observation=observation)
                compare_alone("the density of the proposal", density, few, new)
            self._check_reach(rng, before, observation)
        if model.log_transition is not None and new is not None:
            compare_alone("the transition density", model.log_transition, few, new)
        return few.differ

    def _check_reach(self, rng: np.random.Generator, before: Population, observation: Any) -> None:
        model = self.model
        rows = spread_rows(len(before), DRAWS)
        old, lw = take(before.particles, rows), before.log_weights[rows]
        with np.errstate(all="ignore"):
            x, own = self._propose(rng, old, observation), model.sample_transition(rng, old)
            gain = self.log_weight(old, x, observation) + model.log_likelihood(x, observation)
            log_q = self.log_prob(old, own, observation)
            check_reach("the proposal", lw + model.log_likelihood(own, observation), log_q, lw + gain)

    def _propose(self, rng: np.random.Generator, old: Particles, observation: Any) -> Particles:
        """Draws from the proposal."""
        q = as_distribution(self.proposal(old, observation))  # type: ignore[misc]
        return _of_shape("proposal", q.sample(rng, count_particles(old)), old)


@dataclass(frozen=True)
class PriorityLookahead(Lookahead):
    """Log priority given by a function ``(particles, y) -> (n,)`` of x_{t-1} and y_t."""

    function: Callable[..., np.ndarray]
    alone: ClassVar[bool] = True
    step_functions: ClassVar = {"function": 2}

    def log_priority(self, population: Population, observation: Any) -> np.ndarray:
        return self.function(population.particles, observation)

    def examine(
        self, rng: np.random.Generator, before: Population | None, observation: Any, after: Population
    ) -> bool:
        few = Few.of(after.particles)
        compare_alone("the log priority", lambda x: self.function(x, observation), few)
        return few.differ


def bootstrap(
    model: StateSpaceModel,
    n: int,
    resampler: Resampler = Systematic(),  # noqa: B008 (frozen)
    trigger: Trigger = EssBelow(0.5),  # noqa: B008 (frozen)
) -> ParticleFilter:
    """The bootstrap filter of a model (Gordon, Salmond, Smith 1993) with `n` particles."""
    return ParticleFilter(
        initial=Prior(model),
        transition=Dynamics(model),
        update=Reweight(model.log_likelihood),
        resampler=resampler,
        trigger=trigger,
        n=n,
    )


def guided(
    model: StateSpaceModel,
    proposal: Callable[[Any, Any], Any] | None,
    n: int,
    initial: Callable[[Any], Any] | None = None,
    **components: Any,
) -> ParticleFilter:
    """The guided filter, which moves by a proposal q(x_t | x_{t-1}, y_t) and weights by f p(y_t | x_t) / q.

    The model needs its log densities. `proposal` is as in `Dynamics`, and None means the transition f of the model.
    `initial` is as the proposal of `Prior`. `components` are other fields of `ParticleFilter`, such as ``resampler``.
    """
    return replace(
        bootstrap(model, n), initial=Prior(model, initial), transition=Dynamics(model, proposal), **components
    )


def auxiliary(
    model: StateSpaceModel,
    log_priority: Callable[[Any, Any], np.ndarray],
    n: int,
    proposal: Callable[[Any, Any], Any] | None = None,
    initial: Callable[[Any], Any] | None = None,
    **components: Any,
) -> ParticleFilter:
    """Auxiliary filter (Pitt, Shephard 1999): selects by weight times priority, then divides weights by priority.

    Parameters
    ----------
    log_priority : callable
        ``(particles, y) -> (n,)``, close to log p(y_t | x_{t-1}). The filter is exact for any finite priority.
    proposal, initial, **components
        As in `guided`. With priority p(y_t | x_{t-1}) and proposal p(x_t | x_{t-1}, y_t), the filter is fully
        adapted.
    """
    return replace(guided(model, proposal, n, initial, **components), lookahead=PriorityLookahead(log_priority))


def resample_move(model: StateSpaceModel, move: Rejuvenation, n: int, **components: Any) -> ParticleFilter:
    """The bootstrap filter with a move at the end of each step that resampled (Gilks and Berzuini 2001)."""
    return replace(bootstrap(model, n), rejuvenation=move, **components)
