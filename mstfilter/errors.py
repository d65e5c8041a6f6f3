"""Errors and warnings that a user can mend: what is wrong, where, the value found; then what to do.

>>> from mstfilter.errors import InputError
>>> raise InputError("depth image 000003.png is empty", "record the frame again")
Traceback (most recent call last):
...
mstfilter.errors.InputError: depth image 000003.png is empty
"""

from __future__ import annotations

__all__ = ["InputError", "InputWarning", "MissingLibraryError"]


class InputError(ValueError):
    """Input that cannot be used.

    Parameters
    ----------
    message : str
        One line: what is wrong, where, and the value found.
    *hints : str
        One line each: what the user can do about it.
    """

    def __init__(self, message: str, *hints: str) -> None:
        super().__init__(message)
        self.message = message
        self.hints = hints


class MissingLibraryError(InputError):
    """A library or a system package that a chosen component needs is not there."""


class InputWarning(UserWarning):
    """Input that can be used but is probably not what was meant. The command line shows it as one ``warning:`` line.

    Parameters
    ----------
    message : str
        One line: what is strange, where, and the value found.
    *hints : str
        One line each: what the user can do about it.
    """

    def __init__(self, message: str, *hints: str) -> None:
        super().__init__(message)
        self.message = message
        self.hints = hints
