"""A format: reads a folder of colour and depth images. This one reads the images of a recording folder.

mstfilter run demo/recording --format ./format.py:MyFormat --pauses ends --out runs/mine --replace
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.formats import Video, VideoFormat


@dataclass(frozen=True)
class MyFormat(VideoFormat):
    """rgb/ and depth/ with PNG images of the same names, and camera.json with K. Fields are options: -o fps=10.

    Parameters
    ----------
    fps : float
        Frames per second.
    """

    fps: float = 5.0

    @classmethod
    def detects(cls, path: Path) -> bool:
        """Whether a path has this layout. Raises no error."""
        return (path / "rgb").is_dir() and (path / "camera.json").is_file()

    def video(self, path: Path) -> Video:
        """The frames and their calibration. Pauses and the pose of the camera are found; images are read late."""
        names = sorted(file.name for file in (path / "rgb").glob("*.png"))
        if not names:
            raise InputError(f"{path / 'rgb'} has no image")
        K = np.asarray(json.loads((path / "camera.json").read_text())["K"])
        return Video.of_files(
            name=path.name,
            times=tuple(k / self.fps for k in range(len(names))),
            pairs=[(path / "rgb" / name, path / "depth" / name) for name in names],
            K=self.K or (K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
            path=path,
            depth_scale=self.depth_scale,
        )
