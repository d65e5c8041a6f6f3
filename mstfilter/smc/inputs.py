"""Observations, time and inputs: the values that a step passes to the functions of its components.

A transition may depend on the time t and on an input u_t that is known, such as odometry, a control, or the time
since the last observation: x_t ~ f_t(x_t | x_{t-1}, u_t). A function of a model that has a parameter ``t`` or ``u``
gets them by keyword, and an observation brings the input of its step along:

>>> from mstfilter.smc import Normal, StateSpaceModel, WithInput, bootstrap
>>> model = StateSpaceModel.of(
...     initial=Normal(0.0, 1.0),
...     transition=lambda x, t, u: Normal(x + u, 0.1 * t),         # the index of the step, and its input
...     observation=lambda x: Normal(x, 0.2),
... )
>>> observations = [WithInput(y, u) for y, u in zip([0.1, 1.2, None], [0.0, 1.0, 0.5])]     # the last is missing
>>> state, infos = bootstrap(model, n=1000).run(observations, seed=0)
>>> bool(abs(state.population.mean() - 1.67) < 0.05)                # 1.17 after y_1, and half a unit further
True

The first observation has t = 0. The transition to x_t is called with t >= 1, and the input of the first step belongs
to no transition. An observation without input needs no `WithInput`. `Component.at_step` returns the component for
step t with input u.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property, partial
from types import CodeType, FunctionType
from typing import Any, ClassVar, Self
from weakref import WeakKeyDictionary

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import Bounded


@dataclass(frozen=True, eq=False)
class WithInput:
    """An observation with the input of its step. Pass `WithInput` to a filter instead of the observation.

    The filter passes `y` to its components as the observation. The input `u` belongs to the transition from x_{t-1}
    to x_t. At the first step, the initial distribution and the likelihood can use the input.
    """

    y: Any  #: the observation; None if missing
    u: Any  #: the input: an odometry reading, a control, a time difference; a number, an array or any object


def split_input(observation: Any) -> tuple[Any, Any]:
    """The observation and the input of a step; None for a missing input."""
    if isinstance(observation, WithInput):
        return observation.y, observation.u
    return observation, None


def check_observations(observations: Iterable[Any]) -> Any:
    """Check the type and the values of observations, and return the observations unchanged.

    Raises InputError for a table, a mapping or a string, and for an observation whose entries are all NaN. Masked
    entries also raise InputError, because the functions of models ignore masks.

    Iteration over a data frame or a mapping would yield names, not rows.
    """
    if isinstance(observations, (str, bytes, Mapping)) or hasattr(observations, "columns"):
        raise InputError(
            f"observations are a {type(observations).__name__}, expected one observation for each step",
            "rows of a data frame: table.to_numpy(); one column: table['y'].to_numpy()",
        )
    if isinstance(observations, (list, tuple, np.ndarray)):
        for t, given in enumerate(observations):
            y, _ = split_input(given)
            nan = (isinstance(y, (float, np.floating)) and y != y) or (isinstance(y, np.ndarray) and _all_nan(y))
            if nan or np.ma.is_masked(y):
                what = "is NaN" if nan else "has masked entries"
                raise InputError(
                    f"observation {t} {what}", "one that is missing is None: then the step only predicts"
                )
    return observations


def _all_nan(y: np.ndarray) -> bool:
    if not y.size or y.dtype.kind != "f" or not math.isnan(y.item(0)):  # the usual case
        return False
    return bool(np.isnan(y).all())


#: Signatures of plain functions by their code: a model is made again for each parameter vector of a chain or sampler.
_SIGNATURES: WeakKeyDictionary[CodeType, inspect.Signature] = WeakKeyDictionary()


def _signature(function: Any) -> inspect.Signature:
    """`inspect.signature`, which takes a third of the time of a step of a small filter, looked up where it can be."""
    if type(function) is not FunctionType or function.__defaults__ or function.__kwdefaults__ or function.__dict__:
        return inspect.signature(function)
    if function.__code__ not in _SIGNATURES:
        _SIGNATURES[function.__code__] = inspect.signature(function)
    return _SIGNATURES[function.__code__]


def step_parameters(function: Any, n_arguments: int) -> dict[str, bool]:
    """Which of ``t`` and ``u`` a function accepts after its first `n_arguments` parameters, and which are required.

    A parameter without a default value is required.
    """
    try:
        parameters = list(_signature(function).parameters.values())
    except (TypeError, ValueError):  # not a function, or one without a signature
        return {}
    by_keyword = inspect.Parameter.KEYWORD_ONLY
    after = [p for p in parameters if p.kind is by_keyword or p in parameters[n_arguments:]]
    return {p.name: p.default is p.empty for p in after if p.name in ("t", "u") and p.kind in (_NAMED, by_keyword)}


_NAMED = inspect.Parameter.POSITIONAL_OR_KEYWORD


def check_signature(what: str, function: Any, n_arguments: int) -> None:
    """Raise InputError unless a function can be called with `n_arguments` arguments, and ``t`` and ``u`` by name."""
    try:
        signature = _signature(function)
    except (TypeError, ValueError):  # not a function, or one without a signature
        return
    try:
        signature.bind(*[None] * n_arguments, **step_parameters(function, n_arguments))
    except TypeError as error:
        several = f"{n_arguments} arguments" if n_arguments > 1 else "one argument, the particles"
        raise InputError(
            f"{what} has the parameters {signature}, and is called with {several}: {error}",
            "after these, a parameter t gets the index of the step and a parameter u its input, by these names only",
            "other parameters need a default value, or functools.partial",
        ) from None


#: Parts of messages of numpy and Python, what the function did, and what to write instead.
_USUAL_SLIPS = {
    "truth value of an array": (
        "an array that holds all particles decides (if, and, or, while)",
        "use numpy.where, in a program also switch(name, probs, branches)",
    ),
    "scalar": (
        "an array that holds all particles is used as one number (float, int, range, math, list index)",
        "use numpy (numpy.exp, x.astype(int)) or an array as table",
    ),
    "read-only": (
        "an array of particles is changed in place",
        "write x = x + 1 for x += 1 and numpy.where for x[i] = ..., and return the result under another name",
    ),
    "NoneType": (
        "None is used as a value",
        "a missing observation is None, and previous is None at the first step of a program: test `is None`",
    ),
    "zero-size array": (
        "an array without entries is reduced",
        "a branch of switch is also called when no particle reaches it",
    ),
}


def usual_slip(error: Exception) -> tuple[str, str] | None:
    """What a function of a model did if it raised this error, and what to write instead; None if it is not known."""
    return next((_USUAL_SLIPS[part] for part in _USUAL_SLIPS if part in str(error)), None)


def bind_step(function: Callable[..., Any], parameters: Mapping[str, bool], t: int, u: Any) -> Callable[..., Any]:
    """The function with ``t`` and ``u`` bound. A call raises InputError if a required input is missing."""
    given = {name: value for name, value in (("t", t), ("u", u)) if name in parameters}
    if u is None and "u" in given:
        if parameters["u"]:
            return partial(_no_input, t)
        del given["u"]
    return partial(function, **given)


def _no_input(t: int, *args: Any, **named: Any) -> Any:
    raise missing_input(t)


def missing_input(t: int) -> InputError:
    """The error if step `t` has no input and the model needs one."""
    return InputError(
        f"a function of the model has a parameter u, and step {t} has no input",
        "give the input with the observation: WithInput(y, u); name the parameter otherwise if it is none",
    )


def same_component(one: Any, other: Any) -> bool:
    """Whether two components are equal. Fields may be arrays, for which ``==`` of dataclasses raises an error."""
    if one is other:
        return True
    with suppress(Exception):
        return bool(one == other)
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if is_dataclass(one):
        return all(same_component(getattr(one, f.name), getattr(other, f.name)) for f in fields(one) if f.compare)
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(same_component(one[name], other[name]) for name in one)
    return isinstance(one, (tuple, list)) and len(one) == len(other) and all(map(same_component, one, other))


class AtStep(Bounded):
    """Base class of components and models. `at_step` binds time and input to the functions in the fields.

    A function in a field may also be a method of an `AtStep` object, which is then bound.
    """

    #: Fields that may be functions of the step -> number of their arguments before ``t`` and ``u``; None for a field
    #: that is a component or a model.
    step_functions: ClassVar[Mapping[str, int | None]] = {}

    @cached_property
    def _of_step(self) -> dict[str, dict[str, bool] | None]:
        """Map each field that depends on the step to its parameters `t` and `u`; None for an `AtStep` object."""
        found: dict[str, dict[str, bool] | None] = {}
        for name, n_arguments in self.step_functions.items():
            value = getattr(self, name)
            if isinstance(owner := _owner(value), AtStep):
                if owner.depends_on_step:
                    found[name] = None
            elif value is not None and n_arguments is not None:
                check_signature(f"{type(self).__name__}.{name}", value, n_arguments)
                if parameters := step_parameters(value, n_arguments):
                    found[name] = parameters
        return found

    @property
    def depends_on_step(self) -> bool:
        """Whether the result of `at_step` depends on the step."""
        return type(self).at_step is not AtStep.at_step or bool(self._of_step)

    def at_step(self, t: int, u: Any = None) -> Self:
        """The component or model at step `t` with input `u`; the object itself if no field depends on the step.

        Parameters
        ----------
        t : int
            Index of the observation, from 0. The transition from x_{t-1} to x_t belongs to step t.
        u : optional
            The input of the step, of any type; None if the step has no input.
        """
        if not self.step_functions or not self._of_step:
            return self
        new = object.__new__(type(self))
        new.__dict__.update(self.__dict__, _of_step={})  # its functions have their step
        bound: dict[int, Any] = {}
        for name, parameters in self._of_step.items():
            value = getattr(self, name)
            if parameters is not None:
                new.__dict__[name] = bind_step(value, parameters, t, u)
                continue
            owner = _owner(value)
            if id(owner) not in bound:
                bound[id(owner)] = owner.at_step(t, u)
            new.__dict__[name] = bound[id(owner)] if owner is value else getattr(bound[id(owner)], value.__name__)
        return new


def _owner(value: Any) -> Any:
    """The object of a method; other values are returned unchanged."""
    return getattr(value, "__self__", value)
