"""Checks of the values that methods of components return.

An interface declares the check of a method's result by a decorator of the method. The check applies to every class
that defines the method. The error of a failed check names the class, the file and the line of the method:

>>> class Score(Checked):
...     @returns(lambda self, found, particles: check_array(found, (len(particles),)))
...     def score(self, particles): ...
>>> class Mine(Score):
...     def score(self, particles):
...         return [0.0 for _ in particles]
>>> Mine().score((1, 2))                       # doctest: +SKIP
InputError: Mine.score (mine.py, line 2) returns a list, expected an array of shape (2,)

A method that changes its read-only input causes an error with the same information.
"""

from __future__ import annotations

import functools
import inspect
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mstfilter.base.errors import InputError, InputWarning, short_path
from mstfilter.base.fields import Bounded

_Method = TypeVar("_Method", bound=Callable[..., Any])

_TOLERANCE = 1e-6  # rounding errors of float32 at the limits of a range
_PACKAGE = Path(__file__).parents[1]


def returns(check: Callable[..., Any]) -> Callable[[_Method], _Method]:
    """Declare the check of a method: ``check(self, result, *arguments)`` returns the result or raises InputError.

    The message of the error begins with a verb: "returns None, expected ...".
    """

    def mark(method: _Method) -> _Method:
        method.__check__ = check  # type: ignore[attr-defined]
        return method

    return mark


class Checked(Bounded):
    """Base class of interfaces with methods that `returns` decorates, and of components with bounded fields."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        marks = {
            name: f.__check__ for base in cls.__mro__ for name, f in vars(base).items() if hasattr(f, "__check__")
        }
        for name, check in marks.items():
            method = inspect.getattr_static(cls, name)  # of this class, or of another base class
            if not hasattr(method, "__check__"):
                setattr(cls, name, _checked(name, method, check))


def _checked(name: str, method: Any, check: Callable[..., Any]) -> Any:
    """A method whose result is checked. A call from an overriding method of a subclass is not checked."""

    @functools.wraps(method)
    def call(self: Any, *arguments: Any, **named: Any) -> Any:
        bound = method.__get__(self, type(self)) if hasattr(method, "__get__") else method
        if getattr(type(self), name) is not call:
            return bound(*arguments, **named)
        try:
            found = bound(*arguments, **named)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise InputError(f"{_name_of(self, name)} changes its input in place", "make a copy first") from error
        try:
            return check(self, found, *arguments, **named)
        except InputError as error:
            raise error.with_message(f"{_name_of(self, name)} {error.message}") from None

    call.__check__ = check  # type: ignore[attr-defined]
    return call


def warn_once(component: Any, method: str, message: str, *hints: str) -> None:
    """Warn about an unusual result of a method. Each message appears once per class and process."""
    key = type(component), method, message.split(":")[0]
    if key not in _WARNED:
        _WARNED.add(key)
        warnings.warn(InputWarning(f"{_name_of(component, method)} {message}", *hints), stacklevel=2)


_WARNED: set[tuple[type, str, str]] = set()


def _name_of(component: Any, method: str) -> str:
    """The text ``Class.method (file, line n)``, or ``Class.method`` for methods of this package."""
    code = getattr(inspect.unwrap(getattr(type(component), method)), "__code__", None)
    name = f"{type(component).__name__}.{method}"
    if code is None or not Path(code.co_filename).is_file() or Path(code.co_filename).is_relative_to(_PACKAGE):
        return name
    return f"{name} ({short_path(code.co_filename)}, line {code.co_firstlineno})"


def describe_value(value: Any) -> str:
    """The text of a value in an error message: its type, and for an array also the shape and the type of elements."""
    if value is None or isinstance(value, (bool, int, float)):
        return repr(value)
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, np.ndarray):
        masked = "a masked" if isinstance(value, np.ma.MaskedArray) else "an"
        return f"{masked} array of shape {value.shape} and type {value.dtype}"
    kind = type(value)
    name = kind.__name__ if kind.__module__ in ("builtins", "mstfilter") else f"{kind.__module__}.{kind.__name__}"
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"


def check_type(found: Any, kind: type | tuple[type, ...], expected: str, *hints: str) -> Any:
    """Return a result; raise InputError unless the result is an instance of a type."""
    if not isinstance(found, kind):
        why = ("does every branch of the method return it?",) if found is None else hints
        raise InputError(f"returns {describe_value(found)}, expected {expected}", *why)
    return found


def check_list(found: Any, n: int, kind: type | tuple[type, ...], expected: str) -> list[Any]:
    """Return a result as a list; raise InputError unless it is a list or tuple of `n` instances of a type."""
    check_type(found, (list, tuple), f"a list of {expected}")
    if len(found) != n:
        raise InputError(f"returns {len(found)} results, expected {n}, one for each input")
    for k, one in enumerate(found):
        if not isinstance(one, kind):
            raise InputError(f"returns {describe_value(one)} as result {k}, expected {expected}")
    return list(found)


def check_pair(found: Any, first: str, second: str) -> tuple[Any, Any]:
    """Return a result of two values; raise InputError unless it is a tuple or list of two values."""
    check_type(found, (tuple, list), f"{first} and {second}")
    if len(found) != 2:
        raise InputError(f"returns {len(found)} values, expected {first} and {second}")
    return found[0], found[1]


def check_array(
    found: Any,
    shape: Sequence[int],
    kinds: str = "iuf",
    at_least: float = -math.inf,
    at_most: float = math.inf,
    finite: bool = True,
) -> np.ndarray:
    """Return a result as an array; raise InputError unless its type, shape and values are as expected.

    Parameters
    ----------
    shape : sequence of int
        Expected shape.
    kinds : str
        Kinds of numbers, as in `numpy.dtype.kind`: "b" bool, "iu" integers, "f" floats.
    at_least, at_most : float
        Range of the values. Values that are outside the range by no more than a rounding error are clipped.
    finite : bool
        Whether infinite values are errors. NaN always is an error.
    """
    shape = tuple(shape)
    if not isinstance(found, np.ndarray) or isinstance(found, np.ma.MaskedArray):
        raise InputError(f"returns {describe_value(found)}, expected an array of shape {shape}", *_conversion(found))
    if found.shape != shape:
        raise InputError(f"returns shape {found.shape}, expected shape {shape}", *_reshaping(found, shape))
    if found.dtype.kind not in kinds:
        names = {"b": "bool", "iu": "integers", "f": "floats"}
        expected = " or ".join(name for kind, name in names.items() if kind in kinds)
        raise InputError(f"returns an array of type {found.dtype}, expected {expected}")
    if not found.size or found.dtype.kind == "b":
        return found
    low, high = found.min(), found.max()  # NaN if a value is NaN
    if at_least <= low <= high <= at_most and (not finite or (-math.inf < low and high < math.inf)):
        return found
    wrong = np.isnan(found) if not finite else ~np.isfinite(found)
    if wrong.any():
        first = np.unravel_index(int(wrong.argmax()), shape)
        place = f"the first at {tuple(map(int, first))}"
        raise InputError(
            f"returns {found[first]} in {wrong.sum()} of {found.size} values, {place}",
            *(_BOUND if found[first] == -math.inf else ()),
        )
    if low >= at_least - _TOLERANCE and high <= at_most + _TOLERANCE:
        return np.clip(found, at_least, at_most)
    raise InputError(
        f"returns values from {low:.4g} to {high:.4g}, expected {at_least:g} to {at_most:g}",
        *(_scaling(float(low), float(high)) if (at_least, at_most) == (0, 1) else ()),
    )


def check_probabilities(found: Any, shape: Sequence[int]) -> np.ndarray:
    """Return a result as an array of probabilities or bool; raise InputError unless the result has this shape."""
    return check_array(found, shape, "biuf", 0, 1)


def check_rigid(T: np.ndarray, name: str) -> None:
    """Raise InputError unless a matrix (4, 4) is a rigid motion, up to a relative error of 1e-3."""
    if not np.isfinite(T).all():
        raise InputError(f"returns {name} that is not finite")
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > 2e-3 or np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-9:
        scale = float(np.cbrt(abs(np.linalg.det(R))))
        raise InputError(f"returns {name} that is no rigid motion: its scale is {scale:.4g}, or it shears")
    if np.linalg.det(R) < 0:
        raise InputError(f"returns {name} that is no rigid motion: it is a reflection")


def _conversion(found: Any) -> list[str]:
    """Hints for converting a result to an array."""
    if found is None:
        return ["does every branch of the method return it?"]
    if hasattr(found, "detach"):
        return ["return tensor.detach().cpu().numpy()"]
    if isinstance(found, np.ma.MaskedArray):
        return ["return array.filled(value)"]
    return ["return a numpy array, for example np.array(values)"]


def _reshaping(found: np.ndarray, shape: tuple[int, ...]) -> list[str]:
    if sorted(found.shape) == sorted(shape):
        return ["are the axes exchanged?"]
    if found.size == math.prod(shape):
        return ["has the array an axis too many, or is it flattened?"]
    return []


_BOUND = ("a score of -inf rules a hypothesis out: bound it from below",)


def _scaling(low: float, high: float) -> list[str]:
    """Hints for converting numbers that are not probabilities to probabilities."""
    if high <= _TOLERANCE:
        return ["of log probabilities: np.exp(values)"]
    if low < 0:
        return ["of logits: 1 / (1 + np.exp(-logits))"]
    if high <= 100:
        return ["of percent: divide by 100"]
    return ["of grey levels: divide by 255"] if high <= 255 else []
