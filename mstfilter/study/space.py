"""How much disk a study will need, so that it is refused before it begins rather than after an hour.

>>> check_space({"the study": (Path("studies/first"), 1.5e9)})
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError
from mstfilter.runs.sources import open_source

__all__ = ["check_space", "recording_bytes", "run_bytes"]

# Bytes, measured on simulated recordings and on real frames, a quarter added.
_PER_PIXEL = 2.2  # a colour image as PNG
_PER_FRAME_PIXEL = 4.0  # colour, depth, instance and robot images
_PER_VOXEL = 0.02  # of a hypothesis, compressed
_PER_PAUSE = 20_000


def recording_bytes(source: Mapping[str, Any]) -> float:
    """Size of a simulated recording."""
    family = _family(source)
    return family.n_frames * family.width * family.height * _PER_FRAME_PIXEL + _voxels(family) * _PER_VOXEL


def run_bytes(source: Mapping[str, Any], n: int, keep: str) -> float:
    """Size of the folder of a run with `n` hypotheses on a scene."""
    if keep == "tables":
        return _PER_PAUSE
    if "path" in source:
        recording = open_source(Path(source["path"]), source["format"], source["options"], source["pauses"])
        camera = recording.frames[0].camera
        pixels, pauses = camera.width * camera.height, len(recording.pauses)
        voxels = float(recording.grid.shape[0] * recording.grid.shape[1] * recording.grid.shape[2])
    else:
        family = _family(source)
        pixels, pauses, voxels = family.width * family.height, family.n_actions + 1, _voxels(family)
    return float(pauses * (pixels * _PER_PIXEL + n * voxels * _PER_VOXEL + _PER_PAUSE))


def check_space(needs: Mapping[str, tuple[Path, float]]) -> None:
    """Raise InputError if a disk has less left than all that is to be written on it.

    Parameters
    ----------
    needs : mapping
        What is written -> its folder, which need not exist yet, and bytes.
    """
    disks: dict[int, list[str]] = {}
    for what, (folder, _) in needs.items():
        disks.setdefault(_device(folder), []).append(what)
    for together in disks.values():
        needed = sum(needs[what][1] for what in together)
        free = shutil.disk_usage(_existing(needs[together[0]][0])).free
        if needed > free:
            each = (f"{what} needs about {needs[what][1] / 1e9:.2g} GB in {needs[what][0]}" for what in together)
            raise InputError(
                f"{' and '.join(each)}, where {free / 1e9:.2g} GB are free",
                'make room, choose another folder, or keep = "tables" in the study',
            )


def _device(folder: Path) -> int:
    """Names the disk of a folder."""
    return _existing(folder).stat().st_dev


def _existing(folder: Path) -> Path:
    """The folder, or the one above it that exists."""
    path = folder.absolute()
    while not path.exists():
        path = path.parent
    return path


def _family(source: Mapping[str, Any]) -> Any:
    from dataclasses import replace

    from mstfilter.simulation import scene_family

    return replace(scene_family(source["family"]), **source["set"])


def _voxels(family: Any) -> float:
    shape = family.grid().shape
    return float(shape[0] * shape[1] * shape[2])
