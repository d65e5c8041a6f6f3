"""Errors and warnings about problems that a user can correct.

A message states the error, its place and the value found. Hints state how to correct the error.

>>> from mstfilter.base.errors import InputError
>>> InputError("depth image 000003.png is empty", "record the frame again").hints
('record the frame again',)

`check_number`, `check_integer`, `check_choice` and `check_component` check fields and raise uniform errors.
"""

from __future__ import annotations

import difflib
import errno
import linecache
import math
import sys
import sysconfig
import traceback
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from numbers import Integral, Real
from pathlib import Path
from types import FrameType
from typing import Any, Self, TypeVar

_Error = TypeVar("_Error", bound="_WithHints")


class _WithHints(Exception):
    hints: tuple[str, ...] = ()

    def __init__(self, message: str, *hints: str) -> None:
        super().__init__(printable(message))
        self.hints = tuple(map(printable, hints))
        for hint in self.hints:
            self.add_note(f"hint: {hint}")

    @property
    def message(self) -> str:
        """The text without hints, also of a subclass whose constructor does not call the one above."""
        return printable(Exception.__str__(self))

    def with_message(self, message: str) -> Self:
        """The same error, of the same class and with the same attributes and hints, with another message."""
        return _rebuilt(type(self), (printable(message),), self.__dict__)

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (type(self), self.args, self.__dict__)


def _rebuilt(cls: type[_Error], args: tuple[Any, ...], attributes: dict[str, Any]) -> _Error:
    """An error made without its constructor, which may have other parameters in a subclass."""
    new = cls.__new__(cls, *args)
    new.__dict__.update(attributes)
    new.args = args
    if notes := attributes.get("__notes__"):
        new.__notes__ = list(notes)
    return new


class InputError(_WithHints, ValueError):
    """Input that cannot be used.

    `message` is one line that states the error, its place and the value found. A hint is one line that states how to
    correct the error.
    """


class MissingLibraryError(InputError):
    """Raised if a library or a system package that a component needs is missing."""


class LostRunError(InputError):
    """Raised if all particles have weight 0 after an observation. The run cannot continue."""


class InputWarning(_WithHints, UserWarning):
    """Input that can be used but is probably not intended. `InputError` describes the message and the hints.

    The command line shows the warning as one ``warning:`` line.
    """

    def __str__(self) -> str:
        return "\n".join((self.message, *(f"hint: {hint}" for hint in self.hints)))


def warn_user(message: str, *hints: str) -> None:
    """Issue an `InputWarning` that shows the line of code that called this package."""
    level = 1
    frame: FrameType | None = sys._getframe()
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] in ("mstfilter", "functools"):
        level, frame = level + 1, frame.f_back
    warnings.warn(InputWarning(message, *hints), stacklevel=level)


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Put `where` before the message of an InputError that the block raises, unless the message contains it.

    The error keeps its class.
    """
    try:
        yield
    except InputError as error:
        if where in error.message:
            raise
        raise error.with_message(f"{where}: {error.message}") from error


def reason(error: BaseException) -> str:
    """The message of an exception, or its class name if it has no message; ``NAME is missing`` for a KeyError."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return f"{error} is missing" if isinstance(error, KeyError) else str(error) or type(error).__name__


def printable(text: str) -> str:
    """A text as one line of at most 1500 characters, in which control characters are replaced by printable codes.

    Names and values in files of unknown origin may contain control characters.
    """
    line = " ".join(part.strip() for part in text.split("\n"))
    line = line if len(line) <= 1500 else f"{line[:1400]} ... {line[-80:]}"
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def suggestion(name: str, names: Iterable[str]) -> list[str]:
    """A list of one hint with the known name closest to an unknown name; an empty list if no known name is close."""
    return [f"did you mean {close}?" for close in difflib.get_close_matches(name, list(names), n=1)]


def check_number(
    name: str,
    value: Any,
    *hints: str,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    below: float = math.inf,
    unit: str = "number",
) -> None:
    """Raise InputError unless `value` is finite, ``above < value < below`` and ``at_least <= value <= at_most``."""
    numeric = isinstance(value, Real) and not isinstance(value, bool)
    if numeric and math.isfinite(value) and above < value < below and at_least <= value <= at_most:
        return
    bounds = (
        f"above {above:g}" if above > -math.inf else "",
        f"of at least {at_least:g}" if at_least > -math.inf else "",
        f"of at most {at_most:g}" if at_most < math.inf else "",
        f"below {below:g}" if below < math.inf else "",
    )
    expected = " and ".join(bound for bound in bounds if bound)
    raise InputError(f"{name} is {value!r}, expected a finite {unit} {expected}".rstrip(), *hints)


def check_integer(name: str, value: Any, *hints: str, at_least: int = 1, at_most: float = math.inf) -> None:
    """Raise InputError unless `value` is an integer with ``at_least <= value <= at_most``."""
    if isinstance(value, Integral) and not isinstance(value, bool) and at_least <= int(value) <= at_most:
        return
    limit = f" and of at most {at_most}" if at_most < math.inf else ""
    raise InputError(f"{name} is {value!r}, expected an integer of at least {at_least}{limit}", *hints)


def check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raise InputError unless `value` is one of `choices`."""
    if value not in choices:
        raise InputError(f"{name} is {value!r}, expected {', '.join(choices[:-1])} or {choices[-1]}")


def check_component(name: str, value: Any, interface: type, optional: bool = False) -> None:
    """Raise InputError unless `value` is an instance of `interface`. With `optional`, None is also accepted."""
    if isinstance(value, interface) or (optional and value is None):
        return
    hints = []
    if isinstance(value, type) and issubclass(value, interface):
        hints = [f"pass an instance: {name}={value.__name__}(...)"]
    elif isinstance(value, str):
        hints = ["names are for presets and the command line; in Python pass a component"]
    article = "an" if interface.__name__[0] in "AEIOU" else "a"
    found = f"the class {value.__name__}" if isinstance(value, type) else repr(value)
    raise InputError(f"{name} is {found}, expected {article} {interface.__name__}", *hints)


def missing_library(error: ImportError, what: str, *hints: str, library: str = "") -> InputError:
    """The error for a library that `what` needs and that cannot be imported.

    It is a `MissingLibraryError`, unless memory ran out while the library was loaded.

    `library` is the name of the library. The default is the name of the module in `error`.
    """
    library = library or (error.name or "").partition(".")[0] or "a library"
    if exhausted(error):
        return InputError(f"out of memory: {what} cannot load {library}: {error}", _LESS_MEMORY)
    install = install_hint(library)
    if not isinstance(error, ModuleNotFoundError) and library != "a library":
        install = f"if {library} is damaged or incomplete, install it again: {install}"
    return MissingLibraryError(f"{what} needs {library}, which cannot be imported: {error}", install, *hints)


def install_hint(library: str) -> str:
    """The command that installs the library whose module has the name `library`."""
    return f"pip install {_PACKAGES.get(library, library)}"


#: What pip installs for a library that has another name there, or that belongs to an extra of this package.
_PACKAGES = {
    "cv2": "opencv-python-headless",
    "skimage": "scikit-image",
    "rosbags": "'mstfilter[bags]'",
    "mcap": "'mstfilter[bags]'",
    "mcap_protobuf": "'mstfilter[bags]'",
    "OpenEXR": "'mstfilter[exr]'",
    "lzfse": "'mstfilter[record3d]'",
    "onnxruntime": "'mstfilter[onnx]'",
    "xarray": "'mstfilter[xarray]'",
    "distributed": "'mstfilter[cluster]'",
    "coacd": "'mstfilter[objects]'",
}


def place_in_user_file(error: BaseException) -> str | None:
    """``FILE, line N: text`` for the line of a user's file that raised an exception; None if there is no such line.

    The line is in the deepest frame (of the error, or else of its cause) whose file belongs neither to this package
    nor to an installed library. For a syntax error, the line is in the file that the error names.
    """
    if isinstance(error, SyntaxError) and error.filename and Path(error.filename).is_file():
        return f"{short_path(error.filename)}, line {error.lineno}: {(error.text or '').strip()}"
    found = None
    current: BaseException | None = error
    while current is not None and found is None:
        for frame, number in traceback.walk_tb(current.__traceback__):
            file = frame.f_code.co_filename
            if _is_of_user(file):
                linecache.checkcache(file)
                found = f"{short_path(file)}, line {number}: {linecache.getline(file, number).strip()}"
        current = current.__cause__
    return found


def exhausted(error: BaseException) -> InputError | None:
    """The message for the user if memory, disk space or the size of a file ran out; None for other errors.

    An import may fail because memory ran out: the loader of shared libraries says so in its text, and a package may
    raise ImportError for a MemoryError.
    """
    short: BaseException | None = error
    while isinstance(short, ImportError) and not _is_out_of_memory(short):
        short = short.__cause__ or short.__context__
    if short is not None and _is_out_of_memory(short):
        return InputError("out of memory", _LESS_MEMORY)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return InputError(f"no space left: {error}", "free disk space and repeat the command")
    if isinstance(error, OSError) and error.errno == errno.EFBIG:
        return InputError(f"a file exceeds the largest size: {error}", "`ulimit -f` shows the limit of the shell")
    return None


_LESS_MEMORY = "use fewer workers, fewer particles or larger voxels"


def _is_out_of_memory(error: BaseException) -> bool:
    text = str(error)  # cv2, torch and the loader of shared libraries have no class for it
    if "static TLS block" in text:  # has a fixed size, however much memory is free
        return False
    return isinstance(error, MemoryError) or "allocate" in text or "failed to map segment" in text


def describe_error(error: BaseException) -> str:
    """One line for an exception: type, message, and, if known, the line of a user's file that raised the error."""
    if isinstance(error, InputError):
        return error.message
    place = place_in_user_file(error)
    return printable(f"{type(error).__name__}: {error}" + (f" ({place})" if place else ""))


def _is_of_user(file: str) -> bool:
    """Whether the file of a frame exists and belongs neither to this package nor to an installed library."""
    libraries = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    folders = [str(Path(__file__).parents[1]), *libraries]
    return Path(file).is_file() and not any(Path(file).is_relative_to(folder) for folder in folders)


def short_path(file: str | Path) -> str:
    """A path, relative to the working folder if the path is inside the working folder."""
    path = Path(file).resolve()
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
