"""Decisions: is a scene known better after pushes that the belief chooses?

    python experiments/decisions/run.py [--workers 2] [--smoke --out FOLDER]

The loop is closed: a policy chooses one of twelve candidate pushes, the simulator plays it, `mst` filters the clip,
and so on, six times. All policies start from the same scene. The objects of the first scene are judged, followed by
their true identity; objects that have left the workspace count as not found.

Columns of runs.csv, one row per scene, policy and number of pushes k:
coverage: IoU of each object of the first scene with the best object of a hypothesis, weighted by the volume at the
start, 0 for lost objects, mean over the hypotheses. quality: `objects` quality of what is on the table. brier and
log_loss: of "do these two voxels belong to one object?" at the present pause. lost: objects that have left. entropy:
of the segmentation, in nats, as the filter believes.

On the first `--regret` scenes of a family all candidates are tried at every push of the random policy: `best` is
the coverage after the best one, and the regret of a policy is the best coverage minus that of its choice.

Finished scenes are not run again. summary.csv has the differences to the random policy, paired by scene.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from policies import POLICIES

from mstfilter import Belief, preset
from mstfilter.files import write_csv, write_text
from mstfilter.scoring import ask, overlap, pause_metrics, score_belief
from mstfilter.scoring.metrics import coverage_of
from mstfilter.simulation import PushLoop, scene_family
from mstfilter.smc import State
from mstfilter.statistics import compare_arms, conclusion

N_PUSHES, N_CANDIDATES = 6, 12
SMALL = {"width": 96, "height": 72, "frames_per_clip": 6, "voxel_size": 0.02, "supersample": 1}


def measure(loop: PushLoop, state: State) -> dict[str, float]:
    """Scores after the pushes so far."""
    recording, t = loop.recording(), loop.n_pushes
    first, now = recording.truth(0), recording.truth(t)
    labels, weights = [h.labels for h in state.population.particles], state.population.weights
    objects = [k for k in np.unique(first) if k > 0]
    volume = np.array([(first == k).sum() for k in objects], dtype=float)
    tables = [overlap(one, now) for one in labels]
    found = np.array([[np.nan_to_num(coverage_of(table, [k])) for k in objects] for table in tables])
    scores = score_belief(ask(recording, t), labels, weights, now).row
    return {
        "coverage": float((found @ volume / volume.sum()).mean()),
        "quality": pause_metrics(labels, weights, now, {})[0]["quality"],
        "brier": scores["brier"],
        "log_loss": scores["log_loss"],
        "lost": float(len(loop.lost)),
        "entropy": Belief(state.population).partition_entropy(),
    }


def play(family: str, seed: int, policy: str, regret: bool, small: bool) -> list[dict[str, Any]]:
    """One scene with one policy; the rows of k = 0 .. n pushes."""
    changes, n = (SMALL, 1) if small else ({}, N_PUSHES)
    mst = preset("mst", *(["n=2", "update.eta=1"] if small else []))
    loop = PushLoop(replace(scene_family(family), **changes), seed)
    state, _ = mst.step(mst.start(0), loop.clip)
    named = {"family": family, "scene": f"{family}-{seed}", "policy": policy}
    rows = [{**named, "k": 0, **measure(loop, state)}]
    for k in range(1, n + 1):
        rng = np.random.default_rng([seed, k])
        belief, pushes = Belief(state.population), loop.candidates(2 if small else N_CANDIDATES)
        chosen = POLICIES[policy](rng, belief, pushes)
        row: dict[str, Any] = {}
        if regret:
            saved, outcomes = loop.save(), []
            for push in pushes:
                after, _ = mst.step(state, loop.play(push))
                outcomes.append(measure(loop, after)["coverage"])
                loop.restore(saved)
            row["best"] = max(outcomes)
            for name, choose in POLICIES.items():
                row[f"regret {name}"] = (
                    max(outcomes) - outcomes[choose(np.random.default_rng([seed, k]), belief, pushes)]
                )
        state, _ = mst.step(state, loop.play(pushes[chosen]))
        rows.append({**named, "k": k, **measure(loop, state), **row})
    return rows


def run(arguments: tuple[Any, ...]) -> str:
    """Play a scene and write its rows, unless that has been done."""
    folder, family, seed, policy, regret, small = arguments
    path = folder / "scenes" / f"{family}-{seed}-{policy.replace(' ', '_')}.json"
    if not path.exists():
        write_text(path, json.dumps(play(family, seed, policy, regret, small)))
    return path.name


def _scenes(rows: list[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(row["scene"] for row in rows))


def summarise(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Differences to the random policy by family, score and number of pushes; the mean over k >= 1 is named "all"."""
    found = []
    last = max(row["k"] for row in rows)
    for family in dict.fromkeys(row["family"] for row in rows):
        for score in ("coverage", "quality", "brier", "log_loss", "lost"):
            for name, chosen in (("all", range(1, last + 1)), (str(last), [last])):
                table: dict[str, dict[str, float]] = {}
                for policy in POLICIES:
                    own = [row for row in rows if (row["family"], row["policy"]) == (family, policy)]
                    of = {s: [r[score] for r in own if r["scene"] == s and r["k"] in chosen] for s in _scenes(own)}
                    table[policy] = {scene: float(np.mean(values)) for scene, values in of.items()}
                for policy, d in compare_arms(table, "random").items():
                    row = {"family": family, "score": score, "pushes": name, "policy": policy, "n": d.n}
                    row["random"] = float(np.mean(list(table["random"].values())))
                    row |= {"difference": -d.mean, "low": -d.high, "high": -d.low, "p_holm": d.p_holm}
                    found.append({**row, "conclusion": conclusion(d, "random", policy, f"{family}, {score}")})
    return found


def main() -> None:
    """Run the study and write its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--families", default="s1,s2,s3")
    parser.add_argument("--scenes", type=int, default=20, help="scenes of each family, seeds 0, 1, ...")
    parser.add_argument("--regret", type=int, default=2, help="scenes of each family with all candidates tried")
    parser.add_argument("--workers", type=int, default=1)
    chosen = parser.parse_args()
    if chosen.smoke and chosen.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    families = ["s1"] if chosen.smoke else chosen.families.split(",")
    n_scenes, n_regret = (2, 1) if chosen.smoke else (chosen.scenes, chosen.regret)
    jobs = [
        (chosen.out, family, seed, policy, policy == "random" and seed < n_regret, chosen.smoke)
        for seed in range(n_scenes)
        for family in families
        for policy in POLICIES
    ]
    if chosen.workers > 1:
        with ProcessPoolExecutor(chosen.workers) as pool:
            for name in pool.map(run, jobs):
                print(name, flush=True)
    else:
        for job in jobs:
            print(run(job), flush=True)
    rows = [row for path in sorted((chosen.out / "scenes").glob("*.json")) for row in json.loads(path.read_text())]
    write_csv(chosen.out / "runs.csv", rows, dict.fromkeys(k for row in rows for k in row), float_format=".5g")
    write_csv(chosen.out / "summary.csv", summarise(rows), float_format=".4g")


if __name__ == "__main__":
    main()
