"""Folders of pairs of a colour and a depth image, NAME_rgb.png and NAME_depth.png, with one info.json.

>>> PairedImages(frames=("learn2", "learn3", "learn4")).open(Path("frames"))
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, check_number
from mstfilter.base.fields import NonNegativeFloat
from mstfilter.formats.image_folders import Intrinsics
from mstfilter.formats.images import COLOUR_SUFFIXES, DEPTH_SUFFIXES, read_optional
from mstfilter.formats.pauses import EveryNth
from mstfilter.formats.video import Video, VideoFormat, object_numbers
from mstfilter.scene import TABLE_TOLERANCE, Frame, PauseRule, Recording, table_residual

_SUFFIXES = {*COLOUR_SUFFIXES, *DEPTH_SUFFIXES}


@dataclass(frozen=True)
class PairedImages(VideoFormat):
    """A folder of pairs NAME_rgb.png, NAME_depth.png with an info.json. By default, every frame is a pause.

    Other suffixes are those of `Redwood`, such as NAME_rgb.jpg and NAME_depth.npy.

    ``info.json`` holds ``K`` (fx, fy, cx, cy, or a 3x3 matrix) and ``depth_scale_m``, metres per unit of the 16-bit
    depth images. Label images NAME_label.png (8 or 16 bits, one number for each object) are used as the true label
    images. Label 0, and labels with most of their depth readings on the support plane, are background. Robot masks
    NAME_robot.png are optional. The frames have the times 0, 1, 2, ... s.

    Further parameters: `VideoFormat`.

    Parameters
    ----------
    frames : tuple of str
        Names of the frames in order. By default, all frames are read, sorted by name with numbers in numerical order.
    depth_scale : float
        Metres per unit of integer depth. The default is the scale in info.json.
    """

    frames: tuple[str | int, ...] = ()
    depth_scale: NonNegativeFloat = 0.0
    pauses: PauseRule = field(default_factory=EveryNth)

    @classmethod
    def detects(cls, path: Path) -> bool:
        pictures = (path.glob(f"*_rgb{end}") for end in COLOUR_SUFFIXES)
        return (path / "info.json").is_file() and any(any(found) for found in pictures)

    def video(self, path: Path) -> Video:
        calibration = Intrinsics.read(path, ("info.json",), "depth_scale_m")
        scale: Any = self.depth_scale or calibration.entries.get("depth_scale_m")
        hint = 'for example {"K": [525, 525, 319.5, 239.5], "depth_scale_m": 0.001}'
        check_number(f"{path / 'info.json'}: depth_scale_m", scale, hint, above=0)
        found = {p.stem: p for end in _SUFFIXES for part in ("rgb", "depth") for p in path.glob(f"*_{part}{end}")}
        names = {stem.rpartition("_")[0] for stem in found}
        key = lambda name: [w.zfill(20) if w.isdigit() else w for w in re.split(r"(\d+)", name)]  # noqa: E731
        present = sorted(sorted(names), key=key)
        chosen = [str(name) for name in self.frames] or present or ["NAME"]
        stems = [[f"{name}_{part}" for part in ("rgb", "depth", "robot")] for name in chosen]
        files = [tuple(found.get(stem, path / f"{stem}.png") for stem in listed) for listed in stems]
        for name, pair in zip(chosen, files, strict=True):
            if lost := [file.name for file in pair[:2] if not file.is_file()]:
                hint = (
                    f"a pair is NAME_rgb.png and NAME_depth.png; there are {len(present)}: {', '.join(present[:8])}"
                )
                raise InputError(f"no frame {name!r} in {path}: {' and '.join(lost)} missing", hint)
        title = chosen[0] if len(chosen) == 1 else f"{chosen[0]}-{chosen[-1]}"
        times = tuple(float(k) for k in range(len(chosen)))
        made = calibration.video(self, title, times, files, scale)
        return replace(made, read_instance=lambda k: read_optional(path / f"{chosen[k]}_label.png"))

    def open(self, path: Path) -> Recording:
        made = super().open(path)
        return replace(made, instance=lambda index: _objects(made.frames[index], made.instance(index)))


def _objects(frame: Frame, labels: np.ndarray | None) -> np.ndarray | None:
    """The label image (H, W) of a frame without the labels of the table."""
    if labels is None:
        return None
    with np.errstate(invalid="ignore"):
        on_plane = np.abs(table_residual(frame)) < TABLE_TOLERANCE
    known = np.unique(labels[frame.valid])
    background = [k for k in known if on_plane[frame.valid & (labels == k)].mean() > 0.5]
    return object_numbers(np.where(np.isin(labels, background), 0, labels))
