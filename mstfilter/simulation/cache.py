"""Simulated recordings kept on disk: made once, found again by the content of their recipe.

>>> from mstfilter.formats import open_recording
>>> from mstfilter.scene import Recording
>>> from mstfilter.simulation.cache import cached_recording
>>> recording = open_recording(cached_recording("s2", seed=7))  # doctest: +SKIP
>>> small = cached_recording("s2", 7, width=160, height=120, n_actions=1)  # doctest: +SKIP

The name of a recording's folder holds a hash of everything that decides its bytes: every field of the family, the
seed, the version of the simulator and of the physics library. A folder of that name is therefore complete and
right: it is written under another name and renamed. Several processes may ask for the same recording.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from dataclasses import asdict, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError
from mstfilter.simulation.families import GENERATOR_VERSION, SceneFamily, scene_family

__all__ = ["cache_folder", "cached_recording", "recipe_key"]


def cache_folder() -> Path:
    """Where recordings are kept: MSTFILTER_CACHE, else `mstfilter` in the user's cache folder."""
    own = os.environ.get("MSTFILTER_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mstfilter"


def recipe_key(family: SceneFamily, seed: int) -> str:
    """A hash of everything that decides the bytes of a recording."""
    recipe = {
        "generator": GENERATOR_VERSION,
        "mujoco": version("mujoco"),
        "family": asdict(family),
        "seed": int(seed),
    }
    return hashlib.sha256(json.dumps(recipe, sort_keys=True).encode()).hexdigest()[:16]


def cached_recording(family: str | SceneFamily, seed: int, folder: Path | None = None, **overrides: Any) -> Path:
    """The folder of a simulated recording, made now if it is not there.

    Parameters
    ----------
    family : str or SceneFamily
        A named family, or an own one.
    seed : int
        Not negative.
    folder : path, optional
        Where recordings are kept. Default: `recordings` in `cache_folder()`.
    **overrides
        Fields of the family to change: image size, frames a clip, number of actions, ...

    Raises
    ------
    InputError
        If the family, a field or the seed is wrong, or the folder cannot be written.
    """
    chosen = scene_family(family) if isinstance(family, str) else family
    known = {f.name for f in fields(SceneFamily)}
    unknown = sorted(set(overrides) - known)
    if unknown:
        raise InputError(
            f"scene family {chosen.name!r}: there is no field {unknown[0]!r}",
            f"there are: {', '.join(sorted(known))}",
        )
    chosen = replace(chosen, **overrides)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError(f"seed is {seed!r}, expected an integer of at least 0")
    home = Path(folder) if folder is not None else cache_folder() / "recordings"
    target = home / f"{chosen.name}-{seed}-{recipe_key(chosen, seed)}"
    if not (target / "manifest.json").is_file():
        _make(chosen, seed, target)
    return target


def _make(family: SceneFamily, seed: int, target: Path) -> None:
    from mstfilter.simulation.recorder import simulate

    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # Wherever a user keeps recordings, they never enter version control.
        ignore = target.parent / ".gitignore"
        if not ignore.exists():
            ignore.write_text("*\n")
        work = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        raise InputError(
            f"cannot keep recordings in {target.parent}: {error.strerror}",
            "set MSTFILTER_CACHE to a folder that can be written",
        ) from error
    try:
        made = simulate(family, seed, work / "recording").path
        assert made is not None
        try:
            made.rename(target)
        except OSError:
            if not (target / "manifest.json").is_file():
                raise
            # Another process was quicker; its recording is the same.
    finally:
        shutil.rmtree(work, ignore_errors=True)
