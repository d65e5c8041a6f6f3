"""What of an image is not an object: the table, and what lies behind it.

>>> height = above_table(frame)        # (H, W), > 0 above the table, NaN without reading
"""

from __future__ import annotations

import numpy as np

from mstfilter.scene import Frame, fit_support_plane, table_residual

__all__ = ["SENSOR_FOCAL", "above_table"]

#: Focal length in pixels at which disparity is counted: units are 1/8 pixel of a 640 x 480 Kinect whatever
#: the image's size, so that the noise (0.58 units) and all thresholds stay the same when an image is resized.
SENSOR_FOCAL = 525.0


def above_table(frame: Frame) -> np.ndarray:
    """(H, W) float32 disparity above the table in sensor units (1/8 px at f = 525 px); NaN without reading.

    One unit is 3.2 mm of depth at 1 m. The table is z = 0 where the camera's pose is known, else the plane that
    most readings lie on.
    """
    if frame.camera.T_world_camera is None:
        residual = fit_support_plane(frame).residual
    else:
        residual = table_residual(frame)
    return residual
