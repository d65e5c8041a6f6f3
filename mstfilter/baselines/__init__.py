"""What MST is compared with: filters of the same parts that leave out what MST adds, and floors."""

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
