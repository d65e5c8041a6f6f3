"""The particle filter itself; knows nothing of images, voxels or robots."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
