"""Functions that open recordings of any format.

>>> open_recording("recordings/mine")
>>> open_recording("session.mcap")
>>> open_recording("rgbd_dataset", options=["K=525,525,319.5,239.5"], pauses="0s,4.2s")

Options ``FIELD=VALUE`` set fields of the format. ``mstfilter list format`` shows these fields. Commas separate the
values of a list. The format ``./file.py:Class`` is a class in a file of the user. Each other format is a class of
`mstfilter.formats`.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Sequence
from fnmatch import fnmatch
from itertools import chain
from pathlib import Path
from typing import Any

from mstfilter import formats
from mstfilter.base.errors import InputError
from mstfilter.base.registry import Registry, settings
from mstfilter.formats.image_folders import INTRINSICS, is_recording
from mstfilter.formats.pauses import pauses_from_text
from mstfilter.formats.video import RecordingFormat
from mstfilter.scene import PauseRule, Recording

_REGISTRY = Registry(formats)


def open_recording(
    path: str | Path, format: str = "", options: Sequence[str] = (), pauses: str = "", *, allow_files: bool = True
) -> Recording:
    """Open a recording of any format.

    Parameters
    ----------
    path : str or Path
        File or folder.
    format : str
        Name of a format, or ``./file.py:Class``. By default, the format is detected.
    options : sequence of str
        Settings ``FIELD=VALUE`` of the format.
    pauses : str
        Rule for the pauses (`mstfilter.formats.pauses.pauses_from_text`). The default is the rule of the format.
    allow_files : bool
        Whether ``./file.py:Class`` may be loaded.
    """
    return open_format(path, format, options, pauses, allow_files=allow_files).open(Path(path))


def open_format(
    path: str | Path, format: str = "", options: Sequence[str] = (), pauses: str = "", *, allow_files: bool = True
) -> RecordingFormat:
    """The reader for an existing file or folder. Parameters: `open_recording`."""
    path = Path(path)
    fields = format_settings(options)
    if pauses:
        rule = pauses_from_text(pauses)
        more = fields.get("pauses")
        fields["pauses"] = {**rule, **more} if isinstance(more, dict) else rule
    name = format or detect_format(path)
    cls = _REGISTRY.find_class("format", name, "format", allow_files)
    if not path.exists():
        raise InputError(f"recording does not exist: {path}")
    reader: RecordingFormat = _REGISTRY.make(cls, fields, "", allow_files)
    return reader


def pause_rule(text: str) -> PauseRule:
    """The pause rule for a text: "still", "ends", "every", frames "0,40,85", or seconds "0s,4.2s"."""
    rule: PauseRule = _REGISTRY.build("pauses", pauses_from_text(text))
    return rule


def detect_format(path: Path) -> str:
    """Detect the format of a file or folder, and return its name."""
    if not path.exists():
        raise InputError(f"recording folder or file does not exist: {path}")
    names, found = _REGISTRY.known("format"), _formats_of(path)
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(
            f"{path} looks like {' and like '.join(found)}", f"choose one: --format {' or --format '.join(found)}"
        )
    entries = sorted(p.name for p in path.iterdir()) if path.is_dir() else []
    near = _near_misses(entries)
    if path.is_dir() and not near:  # the reader reports what is missing
        if not entries or is_recording(path):
            return "recording"
        for name, parts in _PARTS.items():
            if any(fnmatch(entry, part) for entry in entries for part in parts):
                return name
    inside = [p.name for p in sorted(path.iterdir())[:_FEW] if _formats_of(p)] if path.is_dir() else []
    if inside:
        raise InputError(
            f"{path} has no known format, but folders and files in it have", f"give {' or '.join(inside)}"
        )
    cures = (cure for kinds, cure in _CONVERT.items() if path.is_file() and path.suffix.lower() in kinds.split())
    if cure := next(cures, None):
        raise InputError(f"{path} has no known format", cure)
    raise InputError(
        f"{path} has no known format",
        *near,
        f"known formats: {', '.join(names)}; `mstfilter list format` describes them",
        "each colour image needs a depth image that is aligned with it: record with an RGB-D camera",
        "in Python, mstfilter.Recording.from_arrays makes a recording from arrays",
    )


_FEW = 20  # entries of a folder that are examined


def _formats_of(path: Path) -> list[str]:
    """Names of the formats that detect a path."""
    names = _REGISTRY.known("format")
    return [name for name in names if _REGISTRY.find_class("format", name).detects(path)]  # type: ignore[attr-defined]


#: Suffixes of files that are not read, and how to convert them.
_CONVERT = {
    ".mkv": "Azure Kinect: python azure_kinect_mkv_reader.py --input FILE.mkv --output frames (an example of Open3D, "
    "which aligns depth to colour), then convert frames/; images that ffmpeg extracts are not aligned",
    ".sens": "extract the frames: reader.py --filename FILE.sens --output_path frames --export_color_images "
    "--export_depth_images --export_poses --export_intrinsics (SensReader of ScanNet), then convert frames/",
    ".svo .svo2": "ZED: write left images and depth with its SDK as numbered images, 16-bit PNG, to rgb/ and depth/",
    ".oni": "OpenNI: play it with depth registered to colour, and write numbered images to rgb/ and depth/",
    ".mp4 .mov": "a video of colour has no depth: give the folder that also has the depth images",
    ".h5 .hdf5 .npz": "read its arrays, and make a recording: mstfilter.Recording.from_arrays(rgb, depth, K)",
    ".ply .pcd": "a cloud of points has no images: record colour and depth images",
    ".zip": "unpack it, and give the folder",
}
_PARTS = {
    "pairs": ("info.json", "*_rgb.png", "*_depth.png"),
    "tum": ("rgb.txt", "depth.txt"),
    "redwood": ("depth", "rgb", "color", "colour", "image"),
    "recording": ("manifest.json", "camera.json"),
}


def _near_misses(entries: Sequence[str]) -> list[str]:
    """Hints about files and folders whose names are nearly those of a known format."""
    known, hints = [*chain(*_PARTS.values(), INTRINSICS)], []
    for name in (entry for entry in entries if not any(fnmatch(entry, part) for part in known)):
        inside = [word for word in _PARTS["redwood"] if "." not in name and word in name.lower()]
        close = difflib.get_close_matches(name.lower(), known, 1, 0.75) or inside
        if close and close[0] not in entries:
            hints.append(f"{name} is there: is it {close[0]}? rename it")
    return hints


def format_settings(options: Sequence[str]) -> dict[str, Any]:
    """Fields of a format from ``FIELD=VALUE`` texts."""
    return settings(_with_lists(text) for text in options)


def _with_lists(text: str) -> str:
    """Convert ``K=1,2,3`` to ``K=["1", "2", "3"]``. The texts become numbers later, by the type of the field."""
    path, equals, value = text.partition("=")
    if not equals or "," not in value or value.strip()[:1] in "[{\"'":
        return text
    return f"{path}={json.dumps([word.strip() for word in value.split(',') if word.strip()])}"
