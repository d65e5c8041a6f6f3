"""Which objects of a recording can be seen at a pause: visible, seen before and now hidden, never seen.

>>> object_status(recording, 2)
{1: 'visible', 2: 'hidden', 3: 'unseen'}
>>> split_truth(recording, 2)["hidden"]        # (X, Y, Z) true labels of the hidden objects alone

No method can know of an object that it never saw, and what it still knows of an object that is hidden now is the
point of tracking; so figures of quality are split by this.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Recording

__all__ = ["MIN_PIXELS", "STATUSES", "Status", "object_status", "split_truth"]

Status = Literal["visible", "hidden", "unseen"]
STATUSES: tuple[Status, ...] = get_args(Status)

MIN_PIXELS = 100  # of a 640 x 480 image: 2.3 cm^2 at 0.8 m


def object_status(recording: Recording, t: int, min_pixels: float = MIN_PIXELS) -> dict[int, Status]:
    """Status of every object that has true voxels at pause `t`, by its label, ascending.

    *visible*: the instance image of the pause shows it; *hidden*: that of an earlier pause did; *unseen*: none
    did. Frames between pauses do not count: hypotheses are made at pauses.

    Parameters
    ----------
    recording : Recording
        With true voxels and instance images at the pauses.
    t : int
        Number of the pause.
    min_pixels : float
        An object is shown by an image if so many pixels show it; of a 640 x 480 image, scales with its area.

    Raises
    ------
    InputError
        If the recording has no true voxels at pause `t`, or no instance image at a pause up to it.
    """
    if not 0 <= t < len(recording.pauses):
        raise InputError(f"recording {recording.name} has no pause {t}, it has {len(recording.pauses)}")
    labels = recording.truth(t)
    if labels is None:
        raise InputError(f"recording {recording.name} has no true voxels at pause {t}")
    present = [int(k) for k in np.unique(labels) if k > 0]
    visible = _shown(recording, t, min_pixels)
    left = set(present) - visible
    seen: set[int] = set()
    for earlier in range(t - 1, -1, -1):
        if not left - seen:
            break
        seen |= _shown(recording, earlier, min_pixels)
    return {k: "visible" if k in visible else "hidden" if k in seen else "unseen" for k in present}


def split_truth(recording: Recording, t: int, min_pixels: float = MIN_PIXELS) -> dict[Status, np.ndarray]:
    """True labels (X, Y, Z) uint16 at pause `t` of the objects of each status alone; parameters as above."""
    status = object_status(recording, t, min_pixels)
    labels = recording.truth(t)
    assert labels is not None
    return {
        wanted: np.where(np.isin(labels, [k for k, s in status.items() if s == wanted]), labels, 0).astype(np.uint16)
        for wanted in STATUSES
    }


def _shown(recording: Recording, t: int, min_pixels: float) -> set[int]:
    """Labels that the instance image of a pause shows in enough pixels."""
    image = recording.instance(recording.pauses[t])
    if image is None:
        raise InputError(f"recording {recording.name} has no instance image at pause {t}")
    counts = np.bincount(image.ravel())
    return set(np.flatnonzero(counts >= max(1.0, min_pixels * image.size / 307200)).tolist())
