"""Readers and writers of recordings: the recording folder of mstfilter, and readers for other layouts.

>>> from mstfilter.formats import Tum, open_recording, save_recording
>>> recording = Tum(K=(525, 525, 319.5, 239.5)).open(path)  # doctest: +SKIP
>>> save_recording(recording, "recordings/mine")  # doctest: +SKIP
>>> recording = open_recording("recordings/mine")  # any format  # doctest: +SKIP

A reader is a `RecordingFormat`: a frozen dataclass with ``detects(path)`` and ``open(path)``. A `PauseRule` finds the
pauses at which a long video is divided into clips.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"format": "RecordingFormat", "pauses": "mstfilter.scene:PauseRule"}
__components__ = {
    "format": {
        "recording": "RecordingFolder",
        "pairs": "PairedImages",
        "tum": "Tum",
        "redwood": "Redwood",
        "bag": "Bag",
    },
    "pauses": {"still": "Still", "settled": "Settled", "at": "At", "ends": "Ends", "every": "EveryNth"},
}
