"""Completion: the whole volume of an object, from the part of its surface that was seen (paper, section IV-B).

>>> completions = Extrude().complete(rng, frame, masks, grid)      # one for each mask
>>> labels = arbitrate(completions, grid)                          # (X, Y, Z) uint16

============  =========================================================================================
`completer`   `Completer`, the interface; `arbitrate`, which decides between overlapping completions
`extrude`     completion by rules: the surface, extruded to the table
`network`     `NetworkCompleter`: by a trained network, ours or yours
`unet`        the network of the package
`crops`       its input: a crop of the grid around the object
`observed`    what was seen of an object, in the latest frame and in earlier ones
============  =========================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"completer": "Completer", "architecture": "Architecture"}
__components__ = {
    "completer": {"extrude": "Extrude", "network": "NetworkCompleter", "surface": "SurfaceOnly", "hull": "Hull"}
}
