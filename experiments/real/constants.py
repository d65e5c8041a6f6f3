"""How sensitive are the pixels of objects to the constants of `mstfilter.scene.support`? Folds over cameras.

    python experiments/real/constants.py                # some minutes of one core

Every constant is changed alone. The loss of a camera is the mean over its images: 1 - overlap with the true pixels of
objects (HOTS, OSD), or invented and missed objects as a share of the true ones (`other_cameras`, `two_cameras`). An
invented object is a connected region of at least 60 pixels without a marked pixel; a marked pixel outside of all
regions is a missed object. For every camera, the value with the least loss on the other cameras, relative to the
losses with the present values, is chosen. Writes results/constants.csv.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from cameras import cases
from foreground import scores
from scipy import ndimage
from sequences import SHARED, sequences

from mstfilter.base.files import write_csv
from mstfilter.scene import Clip, foreground, scene_cache, support

HERE = Path(__file__).resolve().parent
VALUES = {
    "_LIKE_TABLE": (2.0, 3.0, 5.0),
    "_SHADED": (4.0, 6.0, 9.0),
    "_DOUBT": (0.4, 0.8, 1.6),
    "_SMEARED": (20.0, 30.0, 40.0),
    "_LOW": (4.0, 6.0, 9.0),
}
#: Pauses of sequences with label images.
PAUSES = {"mix_1": (0, 8), "office_6": (0, 2), "office_9": (2,), "table_7": (3, 7)}
PAUSES |= {"learn6-16": (3,), "learn17-24": (4,), "learn25-26": (0,), "learn33-44": (1, 6)}
_REGION = 60  # pixels
_LEAST = 0.02  # losses below count as this much when losses are compared


def images() -> Iterator[tuple[str, Clip, np.ndarray, bool]]:
    """Camera, clip, true labels or marked pixels (n, 2), and whether these are labels."""
    for case in cases(SHARED):
        name = "RealSense" if case.name.startswith("uoc") else case.name
        for clip, points in zip(case.open().clips(), case.points, strict=True):
            if points:
                yield name, clip, np.array(points), False
    for sequence in sequences(SHARED):
        for t in PAUSES.get(sequence.name, ()):
            yield sequence.source, sequence.recording.clips()[t], sequence.truth(t).labels, True


def loss(clip: Clip, truth: np.ndarray, labelled: bool) -> float:
    """The loss of an image with the constants that are set."""
    scene_cache.clear()
    pixels = foreground(clip.after, clip.grid).pixels
    if labelled:
        return 1 - scores(pixels, truth)["iou"]
    regions, n = ndimage.label(pixels)
    marked = regions[truth[:, 1], truth[:, 0]]
    large = np.bincount(regions.ravel(), minlength=n + 1)[1:] >= _REGION
    invented = sum(bool(large[k - 1]) and k not in marked for k in range(1, n + 1))
    return float(invented + (marked == 0).sum()) / len(truth)


def main() -> None:
    """Print and write the losses, and the choice of each fold."""
    warnings.simplefilter("ignore")
    given, rows = list(images()), []
    cameras = list(dict.fromkeys(one[0] for one in given))
    for constant, values in VALUES.items():
        present, losses = getattr(support, constant), {}
        for value in values:
            setattr(support, constant, value)
            found: dict[str, list[float]] = {camera: [] for camera in cameras}
            for camera, clip, truth, labelled in given:
                found[camera].append(loss(clip, truth, labelled))
            losses[value] = {camera: float(np.mean(of)) for camera, of in found.items()}
        setattr(support, constant, present)
        for camera in cameras:
            others = [one for one in cameras if one != camera]
            relative = {
                v: np.mean([of[o] / max(losses[present][o], 0.02) for o in others]) for v, of in losses.items()
            }
            chosen = min(relative, key=lambda value: relative[value])
            row = {"constant": constant, "left_out": camera, "present": present, "chosen": chosen}
            rows.append(row | {f"loss_{k}": round(losses[v][camera], 4) for k, v in enumerate(values)})
            print(*rows[-1].values(), flush=True)
    write_csv(HERE / "results" / "constants.csv", rows)


if __name__ == "__main__":
    main()
