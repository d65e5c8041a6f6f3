"""Parallel efficiency of the study runner, and its recovery from killed workers.

``python experiments/study_runner/trials.py [--smoke --out DIR]`` writes results.csv beside this file.

1 and 2 workers run the same study of short runs in turn, several times. If other programs use the machine, two
workers cannot use two cores. Therefore their processor time is recorded too, and a second efficiency excludes them:
the fraction of time that workers spend in runs, times the core seconds of the study with one worker over those with
two.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import tempfile
import threading
import time
from pathlib import Path

import psutil

from mstfilter.files import write_csv
from mstfilter.simulation import cached_recording
from mstfilter.study import Local, run_study, study_of

HERE = Path(__file__).parent
SCENE = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}


def scenes_of(n_runs: int) -> int:
    """Number of scenes of a study of `n_runs` runs."""
    return min(4, max(1, n_runs // 2))


def short_study(n_runs: int):
    """Runs of about a second: each opens its recording, filters two pauses and measures them."""
    n_scenes = scenes_of(n_runs)
    seeds = list(range(n_runs // n_scenes))
    scenes = [{"family": "demo", "seeds": list(range(n_scenes)), "set": SCENE}]
    arms = [{"preset": "mst"}]
    return study_of({"name": "short", "scenes": scenes, "arms": arms, "seeds": seeds, "tries": 3, "cache_gb": 0})


def run(
    n_runs: int, workers: int, folder: Path, cache: Path, kill_every: float = 0.0, most_kills: int = 1000
) -> dict[str, float]:
    """A study of short runs: wall time and processor time of its workers, of which some are killed if asked."""
    stop = threading.Event()
    killed: list[int] = []
    if kill_every:
        threading.Thread(target=killer, args=(kill_every, most_kills, stop, killed), daemon=True).start()
    begun: dict[str, float] = {}
    spent: list[float] = []

    def watch(p) -> None:
        if p.event is not None and p.event.kind == "started":
            begun[p.name] = time.perf_counter()
        elif p.event is not None and p.event.kind in ("ended", "lost"):
            spent.append(time.perf_counter() - begun[p.name])

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = psutil.cpu_times()
    began = time.perf_counter()
    try:
        result = run_study(short_study(n_runs), folder, Local(workers), cache=cache, progress=watch)
    finally:
        stop.set()
    wall = time.perf_counter() - began
    after, later = resource.getrusage(resource.RUSAGE_CHILDREN), psutil.cpu_times()
    own = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    machine = sum(later) - later.idle - later.iowait - (sum(busy) - busy.idle - busy.iowait)
    shutil.rmtree(folder)
    return {
        "runs": n_runs,
        "workers": workers,
        "killed_every_s": kill_every,
        "killed": len(killed),
        "done": result.done,
        "failed": len(result.failed),
        "wall_s": round(wall, 2),
        "at_runs": round(sum(spent) / (workers * wall), 3),
        "core_s": round(own, 2),
        "others_core_s": round(max(0.0, machine - own), 2),
        "cores": len(os.sched_getaffinity(0)),
    }


def killer(every: float, most: int, stop: threading.Event, killed: list[int]) -> None:
    """Kill a worker of this process every `every` seconds, at most `most` of them."""
    while len(killed) < most and not stop.wait(every):
        workers = [p for p in psutil.Process().children() if "spawn_main" in " ".join(p.cmdline())]
        if workers:
            chosen = workers[len(killed) % len(workers)]
            chosen.kill()
            killed.append(chosen.pid)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=HERE)
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    n, rounds = (1, 1) if options.smoke else (200, options.rounds)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder, cache = Path(name) / "study", Path(name) / "cache"
        for seed in range(scenes_of(n)):
            cached_recording("demo", seed, cache / "recordings", **SCENE)
        for round_ in range(rounds):
            for workers in (1, 2):
                rows.append({"round": round_, **run(n, workers, folder, cache)})
                print(rows[-1], flush=True)
        # The small form kills one worker: on a busy machine a run that is killed every few seconds never ends.
        kills = {"kill_every": 0.2, "most_kills": 1} if options.smoke else {"kill_every": 10.0}
        rows.append({"round": 0, **run(n, 2, folder, cache, **kills)})
        print(rows[-1])
    options.out.mkdir(parents=True, exist_ok=True)
    write_csv(options.out / "results.csv", rows)
    for round_ in range(rounds):
        one, two = (r for r in rows if r["round"] == round_ and not r["killed_every_s"])
        print(f"round {round_}: {one['wall_s']} s with one worker, {two['wall_s']} s with two: ", end="")
        print(f"efficiency {one['wall_s'] / 2 / two['wall_s']:.2f} by the clock", end="")
        runner = two["at_runs"] / one["at_runs"] * one["core_s"] / two["core_s"]
        print(f", {runner:.2f} of the runner itself; others used {two['others_core_s']:.0f} core seconds")
    last = rows[-1]
    print(f"{last['killed']} workers killed: {last['done']} of {last['runs']} runs done, {last['failed']} failed")


if __name__ == "__main__":
    main()
