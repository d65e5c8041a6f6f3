"""Files that are part of the package: presets, weights, training programs (`models/`) and example components.

>>> models_folder() / "mst.toml"
>>> examples_folder() / "resampler.py"

In a wheel, the folders of models and examples are inside the package. In a checkout or an editable install, the
folders of models and examples are beside the package.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

from mstfilter.errors import InputError, suggestion

BASE = "base"  #: The common parts of `mst` and its baselines; not a preset, because `base` has no update


def models_folder() -> Path:
    """The folder of presets and weights."""
    return _folder_with("mst.toml", "_models", "models")


def examples_folder() -> Path:
    """The folder of the example components of the documentation, and of the tests of the example components."""
    return _folder_with("resampler.py", "_examples", "docs/examples")


def training_program(name: str) -> ModuleType:
    """A module of `models/mst_training`, which contains the programs that trained the weights.

    The folder stays in `sys.path`, so that processes started by a training find the module.
    """
    folder = str(models_folder())
    if folder not in sys.path:
        sys.path.append(folder)
    return import_module(f"mst_training.{name}")


def _folder_with(file: str, installed: str, in_checkout: str) -> Path:
    """A folder inside the installed package, or beside the package in a checkout."""
    package = Path(__file__).resolve().parent
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
