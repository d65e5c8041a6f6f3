"""Recordings on disk: our own folder, and one reader for each other layout.

A reader is a `Format`: a frozen dataclass with ``detects(path)`` and ``open(path)``. What they share stands in
`mstfilter.formats.video`, how a long video is cut at its pauses in `mstfilter.formats.pauses`.
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"format": "Format", "pauses": "PauseRule"}
__components__ = {
    "format": {
        "recording": "RecordingFolder",
        "pairs": "PairedImages",
        "tum": "Tum",
        "bop": "Bop",
        "redwood": "Redwood",
        "dsr": "Dsr",
        "bag": "Bag",
    },
    "pauses": {"still": "Still", "at": "At", "listed": "Listed", "ends": "Ends", "every": "Every"},
}
