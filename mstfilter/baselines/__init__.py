"""Baselines: filters with which MST is compared.

>>> mstfilter.preset("tracking_only").run(recording.clips(), seed=0)

`updates` has fusion without crossover (samples alone, tracking alone, their union). `proposals` has the floors, and
`object_fusion` a map of volumes in the style of MID-Fusion. ``docs/baselines.md`` lists the presets.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__components__ = {
    "proposal": {
        "first_pause": "FirstPause",
        "image_components": "ImageComponents",
        "occupied_components": "OccupiedComponents",
        "one_blob": "OneBlob",
    },
    "update": {
        "object_fusion": "ObjectFusion",
        "samples_only": "SamplesOnly",
        "tracking_only": "TrackingOnly",
        "union": "Union",
    },
}
