"""The arms of a study, grids multiplied out, names checked; imports no component and no heavy library.

>>> [asked.name for asked in expand(load_study("study.toml"))]
>>> split_grid("update.eta=3,5")
['update.eta=3', 'update.eta=5']
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError
from mstfilter.presets import load_config
from mstfilter.study.config import ArmEntry, StudyConfig

__all__ = ["Asked", "check_names", "expand", "split_grid"]


@dataclass(frozen=True)
class Asked:
    """An arm as it was asked for.

    Parameters
    ----------
    name : str
    preset : str
        Name or path.
    overrides : tuple of str
    beside : bool
        A floor or a ceiling: no part of the comparisons.
    """

    name: str
    preset: str
    overrides: tuple[str, ...]
    beside: bool

    def config(self, allow_files: bool) -> dict[str, Any]:
        """Its configuration, names checked."""
        return load_config(self.preset, self.overrides, allow_files=allow_files)

    @contextlib.contextmanager
    def named(self) -> Iterator[None]:
        """Errors inside say which arm they are of."""
        try:
            yield
        except InputError as error:
            raise InputError(f"arm {self.name!r}: {error.message}", *error.hints) from error


def check_names(study: StudyConfig, overrides: Sequence[str] = (), *, allow_files: bool = True) -> None:
    """Raise InputError for an unknown preset or component in any arm."""
    for asked in expand(study, overrides):
        with asked.named():
            asked.config(allow_files)


def expand(study: StudyConfig, overrides: Sequence[str] = ()) -> Iterator[Asked]:
    """The arms of a study; `overrides` are applied to each, and commas in them make a grid too."""
    for entry in study.arms:
        yield from _expand(entry, study.folder, overrides)


def _expand(entry: ArmEntry, folder: Path, overrides: Sequence[str]) -> Iterator[Asked]:
    presets = [_beside(folder, name.strip()) for text in entry.preset for name in text.split(",")]
    grids = [split_grid(text) for text in (*entry.set, *overrides)]
    if not presets or not all(presets):
        raise InputError(f"an arm names no preset: {list(entry.preset)}")
    varied = [k for k, grid in enumerate(grids) if len(grid) > 1]
    for preset in presets:
        for chosen in itertools.product(*grids):
            if entry.name:
                words = [entry.name, *([_stem(preset)] if len(presets) > 1 else []), *(chosen[k] for k in varied)]
            else:
                told = [k for k in range(len(grids)) if k < len(entry.set) or k in varied]
                words = [_stem(preset), *(chosen[k] for k in told)]
            yield Asked(" ".join(words), preset, chosen, entry.beside)


def _beside(folder: Path, name: str) -> str:
    """A preset's file beside the study's, where there is one."""
    return str(folder / name) if name.endswith(".toml") and (folder / name).is_file() else name


def _stem(preset: str) -> str:
    return Path(preset).stem if preset.endswith(".toml") else preset


def split_grid(text: str) -> list[str]:
    """``"path=a,b"`` as ``["path=a", "path=b"]``; commas inside brackets and quotes part nothing."""
    path, equals, values = text.partition("=")
    if not equals:
        return [text]
    parts, depth, quote, begin = [], 0, "", 0
    for k, letter in enumerate(values):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{(":
            depth += 1
        elif letter in "]})":
            depth -= 1
        elif letter == "," and depth == 0:
            parts.append(values[begin:k])
            begin = k + 1
    parts.append(values[begin:])
    if any(not part.strip() for part in parts):
        raise InputError(f"override {text!r} has an empty value", "for example resampler=systematic,residual")
    return [f"{path.strip()}={part.strip()}" for part in parts]
