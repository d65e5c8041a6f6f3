"""Time saved by shared work on disk: core seconds per step without it, when it is written, and when it is found.

``python experiments/study_runner/sharing.py [--smoke --out DIR]`` writes sharing.csv beside this file.

Each row is a separate study in a new worker, so nothing is cached in memory.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from mstfilter.files import write_csv
from mstfilter.simulation import cache_folder
from mstfilter.study import Local, run_study, study_of

HERE = Path(__file__).parent
ARMS = ["mst", "paper"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=HERE)
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    families = ["demo"] if options.smoke else ["s1", "s2", "s3"]
    small = {"width": 160, "height": 120, "n_actions": 1} if options.smoke else {}
    rows = []
    with tempfile.TemporaryDirectory() as name:
        cache = Path(name) / "cache"
        cache.mkdir()
        (cache_folder() / "recordings").mkdir(parents=True, exist_ok=True)
        (cache / "recordings").symlink_to(cache_folder() / "recordings")
        for family in families:
            for arm in ARMS[:1] if options.smoke else ARMS:
                for sharing in ("none", "written", "found"):
                    scenes = [{"family": family, "seeds": 0, "set": small}]
                    data = {"name": "sharing", "scenes": scenes, "arms": [{"preset": arm}], "seeds": 0}
                    study = study_of({**data, "cache_gb": 0 if sharing == "none" else 4})
                    folder = Path(name) / f"{family}-{arm}-{sharing}"
                    result = run_study(study, folder, Local(1), cache=cache)
                    if result.failed:
                        raise SystemExit(f"failed: {result.failed[0][0]}: {result.failed[0][1].trace}")
                    found = result.folder.rows()
                    later = [row for row in found if row["pause"]]
                    work = sum(p.stat().st_size for p in (cache / "work").rglob("*") if p.is_file()) / 1e6
                    rows.append(
                        {
                            "family": family,
                            "arm": arm,
                            "shared_work": sharing,
                            "core_s_a_step": f"{np.mean([row['core_seconds'] for row in later]):.6g}",
                            "core_s_worst_step": f"{max(row['core_seconds'] for row in later):.6g}",
                            "peak_mb": f"{max(row['peak_mb'] for row in later):.6g}",
                            "work_mb": f"{work:.6g}",
                            "quality": f"{np.mean([row['quality'] for row in later]):.6g}",
                        }
                    )
                    print(rows[-1], flush=True)
                assert len({row["quality"] for row in rows[-3:]}) == 1, "shared work changed a result"
    write_csv(options.out / "sharing.csv", rows)


if __name__ == "__main__":
    main()
