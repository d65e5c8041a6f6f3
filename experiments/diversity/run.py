"""Do the hypotheses represent the ambiguities of a scene, and only those?

    python experiments/diversity/run.py [--scenes 20] [--smoke] [--out FOLDER]

In every scene of scenes.py two similar objects touch, and our own samples are ambiguous about whether they are one or
two. They do not move in the first two actions and move apart in the third. Each method runs once per scene with
n = 5. Counted: pauses 1 and 2 at which at least one hypothesis has the twins as one and at least one as two; after
the third action, runs in which no hypothesis has them as one; and the mean quality of pairs of hypotheses (1: all
equal).
Writes results/runs.csv and results/summary.csv. Finished runs are not repeated.
"""

from __future__ import annotations

import argparse
from itertools import combinations, count
from pathlib import Path

import numpy as np
from scenes import as_one, recorded

import mstfilter
from mstfilter.files import read_csv, write_csv
from mstfilter.scene import Recording
from mstfilter.scoring import weighted_coverage

METHODS = ("mst", "samples_only", "tracking_only", "union", "paper", "authors")
SMALL = {"width": 160, "height": 120, "frames_per_clip": 8, "voxel_size": 0.02}
FIELDS = ["scene", "method", "pause", "as_one", "as_two", "missing", "pairwise"]


def pauses(method: str, recording: Recording, pair: tuple[int, int], seed: int) -> list[dict[str, object]]:
    """One row per pause: how many hypotheses have the twins as one, as two, or lack one of them."""
    pipeline = mstfilter.preset(method)
    state, rows = pipeline.start(seed), []
    for clip in recording.clips():
        state, _ = pipeline.step(state, clip)
        hypotheses, truth = state.population.particles, recording.truth(clip.index)
        found = [as_one(h.labels, truth, pair) for h in hypotheses]
        alike = [weighted_coverage(a.labels, b.labels) for a, b in combinations(hypotheses, 2)]
        rows.append(
            {
                "pause": clip.index,
                "as_one": sum(one is True for one in found),
                "as_two": sum(one is False for one in found),
                "missing": sum(one is None for one in found),
                "pairwise": round(float(np.mean(alike)), 4) if alike else "",
            }
        )
    return rows


def summary(rows: list[dict[str, str]]) -> list[dict[str, object]]:
    """One row per method."""
    table = []
    for method in METHODS:
        own = [row for row in rows if row["method"] == method]
        if not own:
            continue
        last = max(int(row["pause"]) for row in own)
        unmoved = [row for row in own if 0 < int(row["pause"]) < last]
        parted = [row for row in own if int(row["pause"]) == last]
        both = [int(row["as_one"]) > 0 and int(row["as_two"]) > 0 for row in unmoved]
        none = [int(row["as_one"]) == 0 for row in parted]
        alike = [float(row["pairwise"]) for row in own if row["pairwise"] and int(row["pause"]) > 0]
        table.append(
            {
                "method": method,
                "runs": len(parted),
                "pauses with both": f"{sum(both)} / {len(both)}",
                "share": round(float(np.mean(both)), 3),
                "never one once parted": f"{sum(none)} / {len(none)}",
                "share parted": round(float(np.mean(none)), 3),
                "pairwise quality": round(float(np.mean(alike)), 3) if alike else "",
            }
        )
    return table


def main(n_scenes: int, out: Path, smoke: bool) -> None:
    """Run the missing scenes; write both tables after every run."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "runs.csv"
    rows = read_csv(path) if path.is_file() else []
    done = {(row["scene"], row["method"]) for row in rows}
    found = 0
    for seed in count():
        if found == n_scenes:
            break
        made = recorded(seed, (0.0, 1.0), **SMALL) if smoke else recorded(seed)
        if made is None:
            continue
        found += 1
        recording, pair = made
        for method in METHODS:
            if (str(seed), method) in done:
                continue
            new = pauses(method, recording, pair, seed)
            rows += [{"scene": str(seed), "method": method, **{k: str(v) for k, v in row.items()}} for row in new]
            write_csv(path, rows, FIELDS)
        table = summary(rows)
        write_csv(out / "summary.csv", table)
        print(
            f"scene {seed}: " + "; ".join(f"{r['method']} {r['share']} {r['share parted']}" for r in table),
            flush=True,
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    main(1 if arguments.smoke else arguments.scenes, arguments.out, arguments.smoke)
