"""Completion: the whole volume of an object, from the part of its surface that was seen (paper, section IV-B).

>>> completions = Extrude().complete(rng, frame, masks, grid)      # one for each mask
>>> labels = arbitrate(completions, grid)                          # (X, Y, Z) uint16

============  =========================================================================================
`completer`   `Completer`, the interface; `arbitrate`, which decides between overlapping completions
`extrude`     completion by rules: the surface, extruded to the table
`network`     `NetworkCompleter`: by a trained network, ours or yours
`posterior`   `Posterior`: by a prior over whole objects; it also draws shapes
`kinds`       the kinds of whole shapes, `ShapeKind`
`candidates`  where the bounding box of an object can be
`pooled`      `Pooled`: several completers that answer as one
`lattice`     completers that work in a crop of voxels of 1 cm
`unet`        the network of the package
`crops`       its input: a crop of the grid around the object
`observed`    what was seen of an object, in the latest frame and in earlier ones
============  =========================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"completer": "Completer", "architecture": "Architecture", "shape_kind": "ShapeKind"}
__components__ = {
    "completer": {
        "extrude": "Extrude",
        "network": "NetworkCompleter",
        "posterior": "Posterior",
        "drawn": "DrawnShape",
        "pooled": "Pooled",
        "surface": "SurfaceOnly",
        "hull": "Hull",
    },
    "shape_kind": {
        "box": "BoxKind",
        "cylinder": "CylinderKind",
        "cone": "ConeKind",
        "turned": "TurnedKind",
        "ellipsoid": "EllipsoidKind",
        "superquadric": "SuperquadricKind",
        "vessel": "VesselKind",
        "tray": "TrayKind",
    },
}
