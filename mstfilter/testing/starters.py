"""Starting files for components of a user: the example components of the documentation, with other file names.

>>> write_starter("resampler", Path("mine.py"))                # returns the commands that test and run it
>>> write_starter("transition", Path("mine.py"), "numbers")    # particles are numbers instead of hypotheses
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

from mstfilter.errors import InputError, check_choice, suggestion
from mstfilter.resources import examples_folder

_TARGETS = ("scenes", "numbers")
_BOTH = ("resampler", "trigger", "size")  # use the weights only, so one file is for both


def starter_kinds(target: str = "") -> list[str]:
    """Kinds of component that have a starting file for `target`, "scenes" or "numbers", or for any target."""
    folders = map(_folder, [target] if target else _TARGETS)
    return sorted({path.stem for folder in folders for path in folder.glob("*.py")} | set(_BOTH))


def _folder(target: str) -> Path:
    return examples_folder() / "scenes" if target == "scenes" else examples_folder()


def write_starter(kind: str, path: Path, target: str = "") -> list[str]:
    """Write a working component of one of `starter_kinds`, and return the commands that test and run the component.

    `target` states the kind of particles: "scenes" (hypotheses) or "numbers". The default is scenes, if a starting
    file for scenes exists. Raises InputError if no starting file exists, the name is invalid, or `path` exists.
    """
    check_choice("the target", target or "scenes", _TARGETS)
    kinds = starter_kinds(target)
    if kind not in kinds:
        fact = f"there is no starting file of {kind!r}" + f" for {target}" * bool(target)
        raise InputError(fact, *suggestion(kind, kinds), f"there are: {', '.join(kinds)}")
    target = target or ("scenes" if kind in starter_kinds("scenes") else "numbers")
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise InputError(f"{path.name} cannot be imported as a Python module", "choose a name like mine.py")
    source = _folder("numbers" if kind in _BOTH else target) / f"{kind}.py"
    text = re.sub(rf"(\./|python ){kind}\.py\b", rf"\g<1>{path.name}", source.read_text(encoding="utf-8"))
    if path.exists():
        raise InputError(f"{path} exists already", "choose another name; nothing was written")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    lines = (ast.get_docstring(ast.parse(text)) or "").splitlines()
    place = path.as_posix() if path.is_absolute() else f"./{path.as_posix()}"
    commands = [line for line in lines if re.match("mstfilter |python ", line)]
    if path.parent != Path("."):
        commands = [re.sub(rf"(\./)?\b{re.escape(path.name)}\b", place, command) for command in commands]
    return commands
