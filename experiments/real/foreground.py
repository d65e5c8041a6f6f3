"""How well are the pixels of objects found in real images?

    python experiments/real/foreground.py                 # two minutes of one core
    python experiments/real/foreground.py --out FILE

Compares `mstfilter.scene.foreground` with all readings above the table, on the frames of HOTS and OSD. Writes
results/foreground.csv: the overlap (IoU) with the true pixels of objects, wrong and missing pixels as shares of the
true pixels, and the missed objects of a frame. An object is missed if less than a quarter of its pixels are found.
The data are those of `run.py`.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
from scores import FOUND
from sequences import SHARED, sequences

from mstfilter.base.files import write_csv
from mstfilter.scene import foreground, readings_above_table

HERE = Path(__file__).resolve().parent


def scores(found: np.ndarray, labels: np.ndarray) -> dict[str, float]:
    """Scores of the pixels (H, W) bool of objects. `labels` (H, W) are the true objects; -1 does not count."""
    known, true = labels >= 0, labels > 0
    found = found & known
    shares = [found[labels == k].mean() for k in np.unique(labels[true])]
    return {
        "iou": (found & true).sum() / (found | true).sum(),
        "wrong": (found & ~true).sum() / true.sum(),
        "missing": (true & ~found).sum() / true.sum(),
        "missed_objects": float(sum(share < FOUND for share in shares)),
    }


def main() -> None:
    """Measure both rules on all frames; one row for each sequence and rule, with means over frames."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "foreground.csv")
    out = parser.parse_args().out
    rows = []
    for sequence in sequences(SHARED):
        if sequence.source not in ("hots", "osd"):
            continue
        measured: dict[str, list[dict[str, float]]] = defaultdict(list)
        for clip in sequence.recording.clips():
            labels, frame = sequence.truth(clip.index).labels, clip.after
            measured["readings above the table"].append(scores(readings_above_table(frame, clip.grid), labels))
            measured["foreground"].append(scores(foreground(frame, clip.grid).pixels, labels))
        for rule, found in measured.items():
            means = {key: round(float(np.mean([row[key] for row in found])), 3) for key in found[0]}
            rows.append({"sequence": sequence.name, "rule": rule, "frames": len(found), **means})
            print(*rows[-1].values(), flush=True)
    write_csv(out, rows)


if __name__ == "__main__":
    main()
