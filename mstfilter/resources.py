"""Where presets and weights lie: an explicit path, the installed package, or the repository.

>>> models_folder() / "mst.toml"

A wheel carries `models/` inside the package; in a checkout or an editable install it lies beside the package.
"""

from __future__ import annotations

from pathlib import Path

from mstfilter.errors import InputError

__all__ = ["find_preset", "models_folder", "preset_names"]


def models_folder() -> Path:
    """The folder that holds presets and weights."""
    package = Path(__file__).resolve().parent
    for folder in (package / "_models", package.parent / "models"):
        if (folder / "mst.toml").is_file():
            return folder
    raise InputError(
        f"presets are missing: no mst.toml in {package / '_models'} nor in {package.parent / 'models'}",
        "install the package again",
    )


def preset_names() -> list[str]:
    """Presets that come with the package."""
    return sorted(path.stem for path in models_folder().glob("*.toml"))


def find_preset(name: str) -> Path:
    """The TOML file of a preset by name, or of a user's own by path."""
    own = Path(name)
    if own.suffix == ".toml":
        if own.is_file():
            return own
        raise InputError(f"preset file does not exist: {name}")
    path = models_folder() / f"{name}.toml"
    if name not in preset_names():
        raise InputError(
            f"there is no preset {name!r}", f"there are: {', '.join(preset_names())}, or the path of a .toml file"
        )
    return path
