"""RGB-D geometry: cameras, frames, clips, voxel grids, hypotheses, recordings. Knows nothing of filters."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
