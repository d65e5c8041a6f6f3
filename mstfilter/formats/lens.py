"""Lens distortion: the cameras of this library have none, so distorted images are straightened when they are read.

>>> lens = Lens.of(camera, (0.26, -0.95, -0.005, 0.003, 1.16))
>>> lens.smooth(rgb), lens.nearest(depth, np.nan)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Camera

__all__ = ["Lens"]

_NEGLIGIBLE = 0.5  # pixels


@dataclass(frozen=True, eq=False)
class Lens:
    """Where each pixel of a straight image comes from.

    Parameters
    ----------
    source : (H, W, 2) float32, optional
        Column and row in the distorted image; None where the lens is straight.
    """

    source: np.ndarray | None = None

    @classmethod
    def of(cls, camera: Camera, distortion: tuple[float, ...]) -> Lens:
        """The lens of OpenCV's coefficients k1, k2, p1, p2, k3, ...; less than half a pixel anywhere is straight."""
        if not any(distortion):
            return cls()
        if len(distortion) not in (4, 5, 8, 12, 14) or not np.isfinite(distortion).all():
            raise InputError(
                f"distortion has {len(distortion)} numbers {tuple(distortion)}, expected 4, 5, 8, 12 or 14",
                "k1, k2, p1, p2, k3, ... as OpenCV orders them",
            )
        import cv2

        size = (camera.width, camera.height)
        x, y = cv2.initUndistortRectifyMap(
            camera.K, np.array(distortion, dtype=float), None, camera.K, size, cv2.CV_32FC1
        )
        source = np.stack([x, y], axis=-1)
        v, u = np.mgrid[: camera.height, : camera.width]
        return cls() if np.abs(source - np.stack([u, v], axis=-1)).max() < _NEGLIGIBLE else cls(source)

    def smooth(self, image: np.ndarray) -> np.ndarray:
        """A straight colour image."""
        import cv2

        return image if self.source is None else self._remap(image, cv2.INTER_LINEAR, 0)

    def nearest(self, image: np.ndarray, outside: float) -> np.ndarray:
        """A straight image of depth or labels: values are picked, never mixed."""
        import cv2

        return image if self.source is None else self._remap(image, cv2.INTER_NEAREST, outside)

    def _remap(self, image: np.ndarray, how: int, outside: float) -> np.ndarray:
        import cv2

        fill: Any = outside
        remapped: np.ndarray = cv2.remap(
            image, self.source, None, how, borderMode=cv2.BORDER_CONSTANT, borderValue=fill
        )
        return remapped
