"""Readers and writers of recordings: the folder of mstfilter, and the layouts of others.

>>> from mstfilter.formats import Tum, open_recording, save_recording
>>> recording = open_recording("session.mcap")  # any format  # doctest: +SKIP
>>> recording = Tum(K=(525, 525, 319.5, 239.5)).open(path)  # one format, with its fields  # doctest: +SKIP
>>> save_recording(recording, "recordings/mine")  # doctest: +SKIP

A reader is a `RecordingFormat`, a frozen dataclass with ``detects(path)`` and ``open(path)``. To read another layout,
write one more of them. A long video is divided into clips at its pauses, which a `PauseRule` finds.

=========================  ============================================================================
`sources`                  `open_recording`: finds out the format of a path and opens it
`folder`                   the recording folder of mstfilter: reader and writer
`pairs`, `tum`, `redwood`  folders of images: pairs of colour and depth, TUM RGB-D, Redwood and Open3D
`known_layout`, `layouts`  folders of phones and data sets: their reader, and what they look like
`bag`, `mcap_files`        ROS 1 and ROS 2 bags, MCAP; messages of Foxglove
`video`, `image_folders`   what all readers of videos share; what those of image folders share
`images`, `ros_images`     decoding of image files, and of images in ROS messages
`rvl`, `record3d`          decoding of compressed depth
`movies`, `reprojection`   frames of a video file; images brought into one camera
`pauses`                   rules that find the pauses
=========================  ============================================================================
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
        "layout": "KnownLayout",
    },
    "pauses": {"still": "Still", "settled": "Settled", "at": "At", "ends": "Ends", "every": "EveryNth"},
}
