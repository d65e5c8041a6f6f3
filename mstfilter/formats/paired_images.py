"""Adapter: a folder of pairs ``NAME_rgb.png`` and ``NAME_depth.png`` with an ``info.json``.

>>> recording = open_paired(Path("frames"), ["learn2", "learn3", "learn4"])

``info.json`` holds ``K`` as four numbers fx, fy, cx, cy or as a 3x3 matrix, and ``depth_scale_m``, metres a unit of
the 16-bit depth images. Every frame is a pause. There is no pose: the world is found from the support plane.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mstfilter.errors import InputError
from mstfilter.formats.interfaces import Format
from mstfilter.scene import Recording, read_depth, read_rgb

__all__ = ["PairedImages", "open_paired"]


@dataclass(frozen=True)
class PairedImages(Format):
    """A folder of pairs NAME_rgb.png, NAME_depth.png with an info.json; every frame is a pause.

    Parameters
    ----------
    frames : tuple of str or int
        Names of frames in order. Default: all, sorted by name.
    """

    frames: tuple[str | int, ...] = ()

    @classmethod
    def detects(cls, path: Path) -> bool:
        """See `Format`."""
        return (path / "info.json").is_file() and any(path.glob("*_rgb.png"))

    def open(self, path: Path) -> Recording:
        """See `Format`."""
        return open_paired(path, [str(name) for name in self.frames])


def open_paired(path: Path, names: Sequence[str] = ()) -> Recording:
    """A recording of some frames of a folder, in the order given; of all, sorted by name, where none is named."""
    try:
        info = json.loads((path / "info.json").read_text())
        K = np.asarray(info["K"], dtype=float)
        scale = float(info["depth_scale_m"])
    except FileNotFoundError:
        raise InputError(f"{path / 'info.json'} is missing", "it holds K and depth_scale_m") from None
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path / 'info.json'} does not give K and depth_scale_m: {error!r}") from error
    if K.shape == (4,):
        K = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
    present = sorted(p.name.removesuffix("_rgb.png") for p in path.glob("*_rgb.png"))
    chosen = list(names) or present
    missing = [name for name in chosen if name not in present]
    if missing:
        raise InputError(
            f"no frame {missing[0]!r} in {path}", f"there are {len(present)}: {', '.join(present[:8])}, ..."
        )
    rgb = [read_rgb(path / f"{name}_rgb.png") for name in chosen]
    depth = [read_depth(path / f"{name}_depth.png", scale) for name in chosen]
    for name, image in zip(chosen, rgb, strict=True):
        if image.shape != rgb[0].shape:
            raise InputError(f"frame {name} of {path} has shape {image.shape}, the first has {rgb[0].shape}")
    label = chosen[0] if len(chosen) == 1 else f"{chosen[0]}-{chosen[-1]}"
    return Recording.from_arrays(np.stack(rgb), np.stack(depth), K, pauses=range(len(chosen)), name=label)
