"""Completion estimates the space that an object fills from its visible part (paper, section IV-B).

>>> completions = Extrude().complete(rng, frame, masks, grid)      # one for each mask
>>> labels = arbitrate(completions, grid)                          # (X, Y, Z) uint16
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"completer": "Completer", "architecture": "Architecture"}
__components__ = {
    "completer": {"extrude": "Extrude", "network": "NetworkCompleter", "surface": "SurfaceOnly", "hull": "Hull"}
}
