"""Baselines: simpler filters, with which MST is compared.

>>> mstfilter.preset("tracking_only").run(recording.clips(), seed=0)

Each leaves out something that MST has. The updates use samples alone, predictions alone, or their union without
fusing them; the proposals are trivial (floors). They share all else with `mst`, so a comparison changes one thing.
``models/published/object_fusion.py`` is one in the style of MID-Fusion, and ``docs/baselines.md`` lists all presets.
"""

from mstfilter.base.lazy import attach
from mstfilter.base.resources import models_folder

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__components__ = {
    "proposal": {
        "first_pause": "FirstPause",
        "image_components": "ImageComponents",
        "occupied_components": "OccupiedComponents",
        "one_blob": "OneBlob",
    },
    "update": {
        "object_fusion": f"{models_folder()}/published/object_fusion.py:ObjectFusion",
        "samples_only": "SamplesOnly",
        "tracking_only": "TrackingOnly",
        "union": "Union",
    },
}
