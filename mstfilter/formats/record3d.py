"""Depth images of Record3D: floats in metres, compressed with LZFSE.

>>> metres = read_lzfse_depth(Path("session/rgbd/0.depth"), (256, 192))
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from mstfilter.base.errors import InputError, missing_library
from mstfilter.base.files import reading
from mstfilter.formats.images import MAX_PIXELS, File, depth_of, file_content


def read_lzfse_depth(file: File, shape: tuple[int, int] | None, aspect: float = 0.75) -> np.ndarray:
    """Depth image (H, W) float32 in metres, NaN for no reading.

    If the metadata do not have the `shape` (H, W), it follows from the number of pixels and the `aspect`, width by
    height, of the colour image.
    """
    try:
        import lzfse
    except ImportError as error:
        raise missing_library(error, "depth of Record3D", library="lzfse") from error
    data = file_content(file)
    with reading(Path(str(file)), "a depth image of Record3D", "copy the recording again"):
        try:
            values = np.frombuffer(lzfse.decompress(data), "<f4")
        except lzfse.error as error:
            raise ValueError("it is not LZFSE") from error
    if shape is None or math.prod(shape) != values.size:
        width = round(math.sqrt(values.size * aspect))
        shape = (values.size // max(width, 1), width)
    if math.prod(shape) != values.size or not 0 < values.size <= MAX_PIXELS:
        raise InputError(
            f"depth image {file} has {values.size} values, which are no image", "copy the recording again"
        )
    return depth_of(values.reshape(shape), 1.0, f"depth image {file}")
