"""Accuracy of motion rules: predict one clip from the true labels and compare with the volumetric ground truth.

python experiments/tracking_rules/run.py demo 0 12 table 3 7
python experiments/tracking_rules/run.py --smoke --out DIR    # one small scene: shows only that it works
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from mstfilter.files import write_csv
from mstfilter.scene import Hypothesis
from mstfilter.simulation import scene_family, simulate_recording
from mstfilter.smc import Population
from mstfilter.tracking import (
    AuthorsRule,
    DenseFlow,
    IdentityTransition,
    MotionResidual,
    MstRule,
    PaperRule,
    StaticTest,
    TrackingTransition,
    Warp,
)

HERE = Path(__file__).resolve().parent
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}

PUBLISHED = {"static": StaticTest(enabled=False), "warp": Warp("splat", "label")}
CENTROID = MstRule(use_flow=False, use_sift=False, n_refine=0, search_above=-1.0)
ARMS = {
    "identity": IdentityTransition(),
    "small_gicp from centroid": TrackingTransition(CENTROID),
    "paper": TrackingTransition(PaperRule(), **PUBLISHED),
    "paper, ICP accepted to 20 mm": TrackingTransition(PaperRule(max_error=0.02), **PUBLISHED),
    "authors": TrackingTransition(AuthorsRule(), **PUBLISHED),
    "mst": TrackingTransition(),
    "mst, splat": TrackingTransition(warp=Warp("splat", "deepest")),
    "mst, no search": TrackingTransition(MstRule(search_above=-1.0)),
    "mst, no refinement": TrackingTransition(MstRule(n_refine=0)),
    "mst, no twin term": TrackingTransition(MstRule(residual=MotionResidual(track_weight=0.0))),
    "mst, no static test": TrackingTransition(static=StaticTest(enabled=False)),
    "mst, flow fast": TrackingTransition(flow=DenseFlow("fast")),
    "mst, flow ultrafast": TrackingTransition(flow=DenseFlow("ultrafast")),
}


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def main(families: list[tuple[str, int, int]], out: Path, small: dict[str, float]) -> None:
    rows = []
    for name, first, last in families:
        scores: dict[str, dict[str, list[float]]] = {arm: {"moved": [], "rest": [], "s": []} for arm in ARMS}
        for seed in range(first, last):
            with tempfile.TemporaryDirectory() as folder:
                recording = simulate_recording(
                    replace(scene_family(name), **small), seed=seed, path=Path(folder) / "recording"
                )
                for i, clip in enumerate(recording.clips()):
                    if i == 0:
                        continue
                    before, after = recording.truth(i - 1), recording.truth(i)
                    hypothesis = Hypothesis.from_labels(before, clip.grid)
                    for arm, transition in ARMS.items():
                        began = time.perf_counter()
                        rng = np.random.default_rng(seed)
                        moved = transition.predict(rng, Population((hypothesis,), np.zeros(1)), clip).particles[0]
                        scores[arm]["s"].append(time.perf_counter() - began)
                        for k in hypothesis.volumes():
                            kind = "rest" if iou(before == k, after == k) >= 0.9 else "moved"
                            scores[arm][kind].append(iou(moved.labels == k, after == k))
        for arm, s in scores.items():
            rows.append(
                {
                    "family": name,
                    "seeds": f"{first}-{last - 1}",
                    "arm": arm,
                    "n_moved": len(s["moved"]),
                    "iou_moved": f"{np.mean(s['moved']):.3f}",
                    "moved_below_half": sum(x < 0.5 for x in s["moved"]),
                    "n_rest": len(s["rest"]),
                    "iou_rest": f"{np.mean(s['rest']):.3f}",
                    "iou_rest_worst": f"{min(s['rest']):.2f}",
                }
            )
    write_csv(out / "results.csv", rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "scenes", nargs="*", default=["demo", "0", "12", "table", "3", "7"], help="family, first, end"
    )
    parser.add_argument("--smoke", action="store_true", help="one small scene; needs --out")
    parser.add_argument("--out", type=Path, default=HERE)
    options = parser.parse_args()
    if len(options.scenes) % 3:
        parser.error(f"scenes are triples of family, first seed and end, not {options.scenes}")
    if options.smoke and options.out == HERE:
        parser.error("--smoke would overwrite the results: name another folder with --out")
    words = ["demo", "0", "1"] if options.smoke else options.scenes
    triples = [(words[i], int(words[i + 1]), int(words[i + 2])) for i in range(0, len(words), 3)]
    main(triples, options.out, SMALL if options.smoke else {})
