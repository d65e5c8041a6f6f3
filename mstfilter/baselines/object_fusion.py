"""A baseline in the manner of MID-Fusion: one map of objects, each a tracked volume of signed distances.

>>> mstfilter.preset("object_fusion")

This is a re-implementation of the idea of Xu et al. 2019 ("MID-Fusion: Octree-based Object-Level Multi-Instance
Dynamic SLAM") within the interfaces of this package, not of their program. At every pause

1. the objects of the map follow the clip by the tracker that all filters share (the transition of the filter);
2. the masks of the single-frame segmentation are matched with the rendered map by their overlap;
3. the volume of every object is averaged with the images of the clip, each from the pose that frame-by-frame
   registration of depth and colour gives. Surface counts within the mask of the object, free space everywhere;
4. masks without a match that do not show known objects become new objects, with the usual completion.

There is one hypothesis: wrong masks are never revised, and two objects are never merged. Between pauses the map is
stored as voxels, like every hypothesis; a volume starts with the signed distance of its voxels.

>>> volume = ObjectVolume.of(hypothesis.mask(3), grid, truncation=0.03, weight=2.0)
>>> volume = volume.integrate(frame, grid, np.eye(4), mask, others)
>>> volume.occupied                     # (a, b, c) bool, at volume.box of the grid
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from mstfilter.scene import (
    Clip,
    Frame,
    FreeSpace,
    Hypothesis,
    ObjectRecord,
    Projection,
    VoxelGrid,
    depth_sigma,
    project,
    scaled_area,
)
