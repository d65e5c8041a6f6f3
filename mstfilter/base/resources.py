"""Files that are part of the package: presets, weights, training programs (`models/`) and example components.

>>> models_folder() / "mst.toml"
>>> examples_folder() / "resampler.py"
>>> write_starter("resampler", Path("mine.py"))                # returns the commands that test and run it
>>> write_starter("transition", Path("mine.py"), "numbers")    # particles are numbers instead of hypotheses

In a wheel, the folders of models and examples are inside the package. In a checkout or an editable install, the
folders of models and examples are beside the package.
"""

from __future__ import annotations

import ast
import re
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

from mstfilter.base.errors import InputError, check_choice, suggestion

_TARGETS = ("scenes", "numbers")
_BOTH = ("resampler", "trigger", "size")  # use the weights only, so one file is for both
BASE = "base"  #: The common parts of `mst` and its baselines; not a preset, because `base` has no update


def models_folder() -> Path:
    """The folder of presets and weights."""
    return _folder_with("mst.toml", "_models", "models")


def examples_folder() -> Path:
    """The folder with the example components of the documentation and the tests of these components."""
    return _folder_with("resampler.py", "_examples", "docs/examples")


def training_program(name: str) -> ModuleType:
    """A module of `models/mst_training`, which contains the programs that trained the weights.

    The folder is kept in `sys.path`, so that processes started by a training find the module.
    """
    folder = str(models_folder())
    if folder not in sys.path:
        sys.path.append(folder)
    return import_module(f"mst_training.{name}")


def _folder_with(file: str, installed: str, in_checkout: str) -> Path:
    """The folder that contains `file`: inside the installed package, or beside the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    folders = (package / installed, package.parent / in_checkout)
    for folder in folders:
        if (folder / file).is_file():
            return folder
    raise InputError(f"{file} is missing in {folders[0]} and in {folders[1]}", "install the package again")


def preset_names() -> list[str]:
    """Names of the presets of the package, without `base`."""
    return sorted({path.stem for path in models_folder().glob("*.toml")} - {BASE})


def find_preset(name: str, to_extend: bool = False) -> Path:
    """The TOML file of a preset, by name or path. `base` is found only with `to_extend`."""
    given = Path(name)
    if given.suffix == ".toml":
        if given.is_file():
            return given
        raise InputError(f"preset file does not exist: {name}")
    known = [*preset_names(), *([BASE] if to_extend else [])]
    if name not in known:
        raise InputError(
            f"there is no preset {name!r}",
            *suggestion(name, known),
            f"there are: {', '.join(known)}, or the path of a .toml file",
        )
    return models_folder() / f"{name}.toml"


def starter_kinds(target: str = "") -> list[str]:
    """Kinds of component with a starting file for the target "scenes" or "numbers"; by default, for either target."""
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
