"""How long does it take to score a pause?

    OMP_NUM_THREADS=1 python experiments/benchmarks/scoring.py [--n 20] [--smoke --out FILE]

Processor time in seconds on one core for a pause of a simulated scene (`s1`, seed 0; 100 x 100 x 50 voxels, 640 x 480
pixels): the questions, their answers by n hypotheses with their scores, and the metrics of objects. The hypotheses
are the truth, shifted by up to one voxel and with holes, all different. Writes scoring.csv, medians over pauses.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from mstfilter.files import write_csv
from mstfilter.formats import open_recording
from mstfilter.scoring import ask, object_status, pause_metrics, score_belief
from mstfilter.simulation import cached_recording

SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 6}


def main(n: int, small: bool, out: Path) -> None:
    """Measure and write the table."""
    recording = open_recording(cached_recording("demo", 0, **SMALL) if small else cached_recording("s1", 0))
    rng, weights = np.random.default_rng(0), np.full(n, 1 / n)
    seconds: dict[str, list[float]] = {}
    for t in range(len(recording.pauses)):
        truth, status = recording.truth(t), object_status(recording, t)
        labels = [
            np.roll(truth, rng.integers(-1, 2, 2), (0, 1)) * (rng.random(truth.shape) > 0.002) for _ in range(n)
        ]
        marks = [time.process_time()]
        questions = ask(recording, t)
        marks.append(time.process_time())
        score_belief(questions, labels, weights, truth, status)
        marks.append(time.process_time())
        pause_metrics(labels, weights, truth, status)
        marks.append(time.process_time())
        for name, spent in zip(
            ("questions", "answers and scores", "metrics of objects"), np.diff(marks), strict=True
        ):
            seconds.setdefault(name, []).append(float(spent))
        seconds.setdefault("all", []).append(marks[-1] - marks[0])
    rows = [{"what": name, "n": n, "seconds": float(np.median(spent))} for name, spent in seconds.items()]
    write_csv(out, rows, float_format=".3g")
    for row in rows:
        print(f"{row['what']:<22}{row['seconds']:.3f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=20, help="hypotheses")
    parser.add_argument("--smoke", action="store_true", help="a small scene; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "scoring.csv")
    given = parser.parse_args()
    if given.smoke and given.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another file with --out")
    main(given.n, given.smoke, given.out)
