"""Interfaces of the components of a particle filter, `State` and `Info`.

A component is a frozen dataclass. The fields of a component are hyperparameters, with bounds in their annotations
(see `mstfilter.base.fields`), and one method defines its behaviour. Methods that draw random numbers take the
generator as first argument. All methods work on whole populations, so a component can share work between particles.

>>> from dataclasses import dataclass
>>> import numpy as np
>>> from mstfilter.smc import Population, Transition
>>> @dataclass(frozen=True)
... class RandomWalk(Transition):
...     scale: float = 1.0
...
...     def predict(self, rng, population, observation):
...         step = self.scale * rng.standard_normal(population.particles.shape)
...         return Population(population.particles + step, population.log_weights)

In the terms of theory, with weighted particles (x_i, w_i):

=============  ==================================================================================================
`Proposal`     x ~ q(x | y), new particles; also those of the first step, x_0 ~ p(x_0)
`Transition`   x_t ~ f(x_t | x_{t-1}), or x_t ~ q(x_t | x_{t-1}, y_t) with w_i multiplied by f / q
`Update`       w_i multiplied by p(y_t | x_i)
`Resampler`    n particles such that the expected mean of w f(x) stays the same for every f
`Trigger`      whether to resample, usually if (sum w)^2 / sum w^2 < n / 2
`Lookahead`    the particles are selected by w_i a(x_i, y_t), and their weights then divided by a
=============  ==================================================================================================

Every filter needs a `Proposal` for its first particles, a `Resampler` and a `Trigger`. Most filters have a
`Transition` and an `Update`. Models and programs use `Distribution` objects. Reference: Chopin and Papaspiliopoulos
(2020), "An introduction to sequential Monte Carlo", chapter 10.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import Bounded
from mstfilter.base.lazy import late, short_repr
from mstfilter.smc.inputs import AtStep
from mstfilter.smc.population import Population
from mstfilter.smc.streams import Key


class Component(AtStep, ABC):
    """A component that takes part in a step.

    At step t with input u, the filter uses ``component.at_step(t, u)`` (see `mstfilter.smc.inputs`). Class attributes
    can override `properly_weighted`, `draws` and `alone`, as in ``properly_weighted = False``.
    """

    def __init_subclass__(cls, **named: Any) -> None:
        super().__init_subclass__(**named)
        if "__repr__" not in cls.__dict__:  # a dataclass keeps it instead of writing all fields
            cls.__repr__ = short_repr  # type: ignore[method-assign]

    @property
    def properly_weighted(self) -> bool:
        """Whether unnormalised weighted means over the result are unbiased, as in an exact particle filter.

        The author of a component declares whether this holds. `mstfilter check` tests it for resamplers. A filter
        reports the log evidence only if it has no `proposal` and all its components are properly weighted.
        """
        return True

    @property
    def draws(self) -> bool:
        """Whether the component draws random numbers. If False, the component must not use the generator."""
        return True

    @property
    def alone(self) -> bool:
        """Whether the component processes each particle as if it were alone, and returns as many particles.

        The particles of many runs can then be processed in one call (`mstfilter.smc.sweep`).
        """
        return False

    def examine(
        self, rng: np.random.Generator, before: Population | None, observation: Any, after: Population
    ) -> bool:
        """Examine the functions of a model at the first steps of a run (see `mstfilter.smc.first_steps`).

        `before` are the particles that the component got, None at the first step, and `after` those that it returned.
        `rng` starts where it started for the call. Raises InputError if a function mixes particles or draws from
        another generator. Returns whether the particles differed: if not, another step is examined.
        """
        return True


class Proposal(Component):
    """Draws particles given only the observation."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        """Draw `n` particles. If fewer distinct particles exist, some particles are repeated."""


class Transition(Component):
    """Moves particles from the previous time to the present time (prediction)."""

    @abstractmethod
    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Move all particles. A missing `observation` is None.

        ``population.parents`` has "ancestor" if the particles have just been resampled.
        """


class DensityTransition(Transition):
    """A transition with a known density, for moves, smoothing and importance weights."""

    @abstractmethod
    def log_prob(self, previous: Any, new: Any, observation: Any) -> np.ndarray:
        """Log density (n,) float64 of the move from row i of `previous` to row i of `new`; -inf if impossible.

        `observation` is the observation passed to `predict`, or None if missing.
        """


class Update(Component):
    """Uses the observation: reweights, projects or combines the predicted and the proposed particles."""

    @abstractmethod
    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Any
    ) -> Population:
        """Make the updated population, of any size, from the predicted and the proposed particles.

        At least one of `predicted` and `proposed` is not None.

        `predicted` are the moved particles, None at the first step of a filter that starts from its proposal.
        `proposed` are new particles; None if the filter has no proposal. The log weights of `predicted` contain the
        likelihoods of all earlier observations and those of `proposed` do not, so an update that keeps both must
        bring them to one level, as `Reweight` does. Each particle of the result keeps the ``parents`` of the
        particles from which it was made (see `union`).
        """


class Resampler(Component):
    """Selects particles by weight. A scheme that compares particles inherits `Resampler` and defines `resample`.

    A scheme that needs only the weights inherits `WeightResampler` and defines `select`.

    Every scheme promises the following. Its only check is `mstfilter.smc.testing.ResamplerContract`; a filter trusts
    a scheme and does not count its particles.

    - The particles are those at ``parents["ancestor"]``, and keep the parents that they had, such as "previous" and
      "proposed". A particle of weight 0 is never selected.
    - There are n of them. If `exact_size` is False there can be fewer, but at least one; if `chooses_n` is True as
      well, there can be more.
    - If it is `properly_weighted`, the copies of particle i carry in expectation the weight W_i that it had; with
      equal output weights, these are n W_i copies.
    - A common factor of all weights changes nothing but the log weights of the result.
    - The population is left as it is, and all randomness comes from `rng`.
    """

    @property
    def exact_size(self) -> bool:
        """Whether the result always has `n` particles. Schemes without duplicates may return fewer particles."""
        return True

    @property
    def chooses_n(self) -> bool:
        """Whether the scheme chooses the number of particles itself, so that more than `n` are not too many."""
        return False

    @abstractmethod
    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Select `n` particles; ``parents["ancestor"]`` holds the (n,) indices of the selected particles."""


class WeightResampler(Resampler):
    """A resampler that needs only the weights of the particles. Define `select`."""

    @abstractmethod
    def select(
        self, rng: np.random.Generator, log_weights: np.ndarray, n: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Choose `n` ancestors.

        Parameters
        ----------
        log_weights : (m,) float64
            Unnormalised log weights, finite or -inf, with at least one finite value.
        n : int
            Number of ancestors to choose.

        Returns
        -------
        ancestors : (n,) int
            Indices into the m particles; fewer if `exact_size` is False.
        log_weights : (n,) float or None
            Log weights of the selected particles. If None, each of them gets the log of the mean input weight, so
            the estimate of the evidence does not change.
        """

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Select particles by `select`."""
        ancestors, log_weights = self.select(rng, population.log_weights, n)
        if log_weights is None:
            log_weights = np.full(len(ancestors), population.log_mean_weight)
        return population.select(ancestors, log_weights)


class Trigger(Bounded, ABC):
    """Decides whether a step resamples."""

    @abstractmethod
    def wants(self, population: Population, t: int) -> bool:
        """Whether the filter resamples at step `t`."""


class Size(Bounded, ABC):
    """Chooses the number of particles to select, for the resampler `Sized`."""

    @abstractmethod
    def choose(self, population: Population) -> int:
        """Number of particles to select (at least 1), given the weighted particles before the resampling."""


class Similarity(Bounded, ABC):
    """Measures the similarity of particles."""

    @abstractmethod
    def matrix(self, particles: Any) -> np.ndarray:
        """(n, n) symmetric similarities in [0, 1], with diagonal 1. The matrix need not be positive semidefinite."""


class Equivalence(Bounded, ABC):
    """Defines classes of equal particles."""

    @abstractmethod
    def classes(self, particles: Any) -> np.ndarray:
        """(n,) int: the class of each particle, numbered from 0 in the order of first occurrence."""


class Lookahead(Component):
    """Gives each particle a priority by the next observation, before the selection (auxiliary filter).

    The filter subtracts the log priority from the log weights of the selected particles, so it is exact for any
    priority. A good priority is close to log p(y_t | x_{t-1}).
    """

    @abstractmethod
    def log_priority(self, population: Population, observation: Any) -> np.ndarray:
        """(n,) finite log priority of each particle x_{t-1} given y_t; -inf would bias the filter."""


class Rejuvenation(Component):
    """Moves particles after a step that resampled, by a kernel that preserves their distribution (resample-move)."""

    @abstractmethod
    def move(
        self, rng: np.random.Generator, population: Population, previous: Population | None, observation: Any
    ) -> Population:
        """Move x_t without changing its distribution.

        `population` holds the weighted particles x_t after the observation. `previous` holds the parent x_{t-1} of
        each particle in the same row; None at the first step. The result has the same number of particles in the same
        order, with unchanged log weights. The kernel must leave p(x_t | x_{t-1}, y_t) invariant. `observation` is
        y_t, or None if missing.
        """


class Distribution(ABC):
    """A distribution over the values of particles."""

    discrete = False  #: whether the values are integers or booleans
    draws_numbers = False  #: whether draws are never NaN. If False, programs check the draws for NaN

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        """Shape ``(n, *event_shape)``; ``(1, *event_shape)`` or () if all particles share the parameters."""
        return np.shape(self.mean)

    @property
    def event_shape(self) -> tuple[int, ...]:
        """Shape of the value of one particle."""
        return self.parameter_shape[1:]

    def value_shape(self, size: int) -> tuple[int, ...]:
        """Shape ``(size, *event_shape)`` of `size` values; InputError if the parameters are for another size."""
        shape = self.parameter_shape
        if shape and shape[0] not in (1, size):
            raise InputError(
                f"parameters of shape {shape} do not fit {size} particles",
                f"give one row per particle, ({size}, ...), or write a vector shared by all as (1, d)",
                "a branch of a program has the particles whose rows it receives as arguments of switch",
            )
        return (size, *shape[1:])

    def check_parameters(self) -> None:  # noqa: B027 (optional)
        """Raise InputError if a parameter is out of range."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw values ``(size, *event_shape)`` for `size` particles."""

    @abstractmethod
    def log_prob(self, value: Any) -> np.ndarray:
        """(n,) log density or probability of each row; -inf outside the support."""

    @property
    @abstractmethod
    def mean(self) -> np.ndarray:
        """Expected value, of the shape of the parameters: (), (n,), (1, d) or (n, d)."""


class Codec(ABC):
    """Converts particles to named arrays and back, bit for bit, without pickle."""

    @abstractmethod
    def encode(self, particles: Any) -> Mapping[str, np.ndarray]:
        """Convert the particles of a population to named arrays, which must not have the dtype object."""

    @abstractmethod
    def decode(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """Convert the arrays of `encode` back to particles."""


@dataclass(frozen=True, eq=False)
class State:
    """The state of a run: all data that a filter needs to continue."""

    t: int  #: number of observations so far
    population: Population | None  #: the particles after the last observation; None before the first
    key: Key  #: names the random streams of the run
    properly_weighted: bool = True  #: whether the filters of all steps are properly weighted

    def __post_init__(self) -> None:
        if self.t == 0 and self.population is not None and not self.key.path:
            raise InputError(
                f"a state at t = 0 has {len(self.population)} particles: a run with seed {self.key.seed} would draw "
                "again the random numbers that it drew for them",
                "filter.start(seed, population) starts from given particles with new random numbers",
            )

    def __repr__(self) -> str:
        evidence = "" if self.log_evidence is None else f", log evidence {self.log_evidence:.4g}"
        particles = "" if self.population is None else f"\n  {self.population!r}"
        return f"State at t = {self.t}, seed {self.key.seed}{evidence}{particles}"

    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    @property
    def log_evidence(self) -> float | None:
        """Log of the unbiased estimate of p(y_0 .. y_{t-1}); None if the filter is not properly weighted."""
        if not self.properly_weighted:
            return None
        return 0.0 if self.population is None else self.population.log_mean_weight


@dataclass(frozen=True, eq=False)
class Info:
    """Summary of a step; its size in memory does not depend on n. The weights and parents are in the `State`."""

    t: int  #: index of the observation, from 0
    n: int  #: particles after the step
    n_candidates: int  #: particles after the update, before the resampling that follows it
    ess: float  #: effective sample size after the update, before the resampling that follows it
    resampled: bool  #: whether the step resampled
    notes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  #: notes of the components, by slot
    seconds: Mapping[str, float] = field(default_factory=dict)  #: wall time by slot. Not reproducible

    def __repr__(self) -> str:
        how = "resampled" if self.resampled else "not resampled"
        times = ", ".join(f"{slot} {s:.2g}" for slot, s in self.seconds.items())
        lines = [f"Info of step {self.t}: {self.n} of {self.n_candidates} candidates, ESS {self.ess:.1f}, {how}"]
        return "\n  ".join([*lines, f"seconds {times}"] if times else lines)


class Infos(list[Info]):
    """The `Info` objects of the steps of a run: a list with the method `rows`, which makes a table.

    >>> state, infos = filter.run(observations)
    >>> pandas.DataFrame(infos.rows())
    """

    def rows(self) -> list[dict[str, Any]]:
        """One row per step: the numbers of `Info`, and the wall time in seconds of the step and each component."""
        slots = dict.fromkeys(slot for info in self for slot in info.seconds)
        return [
            {
                **{name: getattr(info, name) for name in ("t", "n", "n_candidates", "ess", "resampled")},
                "seconds": sum(info.seconds.values()),
                **{f"{slot}_seconds": info.seconds.get(slot, 0.0) for slot in slots},
            }
            for info in self
        ]

    def __repr__(self) -> str:
        if not self:
            return "Infos: no steps"
        ess, seconds = [info.ess for info in self], sum(sum(info.seconds.values()) for info in self)
        spread = f"ESS {min(ess):.1f} to {max(ess):.1f}"
        return f"Infos: steps {len(self)}, resampled {sum(i.resampled for i in self)}, {spread}, {seconds:.3g} s"

    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")
