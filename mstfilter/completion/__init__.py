"""Completion: from the visible part of an object to the space it fills (paper IV-B)."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"completer": "Completer"}
__components__ = {"completer": {"extrude": "Extrude", "surface": "SurfaceOnly"}}
