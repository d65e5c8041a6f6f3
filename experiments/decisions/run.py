"""Decisions: are the hypotheses about a scene better after pushes that the belief chooses?

    python experiments/decisions/run.py [--workers 2] [--smoke --out FOLDER]

A policy chooses one of twelve candidate pushes, the simulator executes the push, and `mst` filters the clip. This
loop is repeated six times. All policies start from the same scene. The objects on the table before the first push are
scored, identified by their true labels. Objects that have left the workspace have an IoU of 0.

Columns of runs.csv, one row per scene, policy and number of pushes k:

- coverage: the IoU of each scored object with the best object of a hypothesis, averaged over the objects with their
  volumes at the start as weights, and over the hypotheses.
- quality: the `objects` quality against the objects on the table.
- recalibrated_log_loss: the log loss of forecasts of "these two voxels belong to one object" at the present pause, in
  nats. Forecasts are recalibrated on the other scenes of the family, with one recalibration for all policies.
- brier and log_loss: the scores of the same forecasts without recalibration.
- lost: the number of objects that have left the workspace.
- entropy: the entropy of the segmentation, in nats.

On the first `--regret` scenes of a family all candidates are simulated at every push of the random policy: `best` is
the coverage after the best candidate. The regret of a policy is `best` minus the coverage after the policy's choice.

Finished scenes are not run again; with `--scenes 0` the tables are made from the finished scenes. summary.csv has the
differences from the random policy, paired by scene. decisions.png has the means.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from policies import POLICIES

from mstfilter import Belief, ParticleFilter, preset
from mstfilter.base.files import write_csv, write_text
from mstfilter.lab.simulation import FingerPush, PushLoop, scene_family
from mstfilter.scoring import LOG_LOSS, ask, leave_one_out, overlap, pause_metrics, score_belief
from mstfilter.scoring.metrics import coverage_of
from mstfilter.scoring.statistics import compare_arms, conclusion
from mstfilter.smc import State

N_PUSHES, N_CANDIDATES = 6, 12
#: Eight frames a clip instead of fifteen halve the time of the study.
CHANGES = {"frames_per_clip": 8, "fps": 2.5}
SCORES = ("coverage", "quality", LOG_LOSS, "brier", "log_loss", "lost")
SMALL = {"width": 96, "height": 72, "frames_per_clip": 6, "voxel_size": 0.02, "supersample": 1}


def measure(loop: PushLoop, state: State) -> tuple[dict[str, float], np.ndarray]:
    """Scores after the pushes so far, and the counts of forecasts."""
    recording, t = loop.recording(), loop.n_pushes
    first, now = recording.truth(0), recording.truth(t)
    labels, weights = [h.labels for h in state.population.particles], state.population.weights
    objects = [k for k in np.unique(first) if k > 0]
    volume = np.array([(first == k).sum() for k in objects], dtype=float)
    tables = [overlap(one, now) for one in labels]
    found = np.array([[np.nan_to_num(coverage_of(table, [k])) for k in objects] for table in tables])
    scores, counts = score_belief(ask(recording, t), state.population.particles, weights, now)
    row = {
        "coverage": float((found @ volume / volume.sum()).mean()),
        "quality": pause_metrics(labels, weights, now, {})[0]["quality"],
        "brier": scores["brier"],
        "log_loss": scores["log_loss"],
        "lost": float(len(loop.lost)),
        "entropy": Belief(state.population).partition_entropy(),
    }
    return row, counts


def play(family: str, seed: int, regret: bool, small: bool) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Rows of one scene for all policies and k = 0 .. n pushes, and the counts of forecasts of each row."""
    changes, n = (SMALL, 1) if small else (CHANGES, N_PUSHES)
    mst = preset("mst", *(["n=2"] if small else []))
    loop = PushLoop(replace(scene_family(family), **changes), seed)
    first, _ = mst.step(mst.start(0), loop.clip)
    start, at_start = loop.save(), measure(loop, first)
    rows, counts = [], []
    for policy, choose in POLICIES.items():
        loop.restore(start)
        named = {"family": family, "scene": f"{family}-{seed}", "policy": policy}
        state, (scores, counted) = first, at_start
        rows.append({**named, "k": 0, **scores})
        counts.append(counted)
        for k in range(1, n + 1):
            belief, pushes = Belief(state.population), loop.candidates(2 if small else N_CANDIDATES)
            chosen = choose(np.random.default_rng([seed, k]), belief, pushes)
            extra = {}
            if regret and policy == "random":
                extra = _regret(mst, loop, state, pushes, [seed, k])
            state, _ = mst.step(state, loop.play(pushes[chosen]))
            scores, counted = measure(loop, state)
            rows.append({**named, "k": k, **scores, **extra})
            counts.append(counted)
    return rows, np.stack(counts)


def _regret(
    mst: ParticleFilter, loop: PushLoop, state: State, pushes: Sequence[FingerPush], key: Sequence[int]
) -> dict[str, float]:
    """Coverage after the best of all candidates, and the regret of each policy.

    The regret of the random policy is the mean over all candidates.
    """
    saved, outcomes = loop.save(), []
    for push in pushes:
        after, _ = mst.step(state, loop.play(push))
        outcomes.append(measure(loop, after)[0]["coverage"])
        loop.restore(saved)
    belief, best = Belief(state.population), max(outcomes)
    chosen = {name: choose(np.random.default_rng(key), belief, pushes) for name, choose in POLICIES.items()}
    reached = {name: outcomes[k] for name, k in chosen.items()} | {"random": float(np.mean(outcomes))}
    return {"best": best, **{f"regret {name}": best - coverage for name, coverage in reached.items()}}


def run(arguments: tuple[Any, ...]) -> str:
    """Play a scene and write its rows, unless that has been done."""
    folder, family, seed, regret, small = arguments
    path = folder / "scenes" / f"{family}-{seed}.json"
    if not path.exists():
        rows, counts = play(family, seed, regret, small)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path.with_suffix(".npz"), counts=counts)
        write_text(path, json.dumps(rows))  # written last: a scene with this file is finished
    return path.name


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of all finished scenes, with the recalibrated log loss."""
    rows: list[dict[str, Any]] = []
    counts: dict[str, dict[str, np.ndarray]] = {}
    for path in sorted(folder.glob("*.json")):
        own = json.loads(path.read_text())
        counts.setdefault(own[0]["family"], {})[own[0]["scene"]] = np.load(path.with_suffix(".npz"))["counts"]
        rows += own
    for family, found in counts.items():
        fits = leave_one_out({scene: one.sum(axis=0) for scene, one in found.items()})
        for scene, one in found.items():
            own = [row for row in rows if row["family"] == family and row["scene"] == scene]
            for row, of_pause in zip(own, one, strict=True):
                row[LOG_LOSS] = fits[scene].log_loss(of_pause) if scene in fits else float("nan")
    return rows


def summarise(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Differences from the random policy by family, score and number of pushes; "all": all families, or mean over k.

    The regrets of all policies are measured at the states that the random policy reaches.
    """
    last = max(row["k"] for row in rows)
    pushes = {"all": range(1, last + 1), **{str(k): [k] for k in sorted({min(4, last), last})}}
    found = []
    for family in ("all", *dict.fromkeys(row["family"] for row in rows)):
        own = [row for row in rows if family in ("all", row["family"])]
        for score in (*SCORES, "regret"):
            for name, chosen in pushes.items():
                table = {policy: _by_scene(own, policy, score, chosen) for policy in POLICIES}
                for policy, d in compare_arms(table, "random").items():
                    row = {"family": family, "score": score, "pushes": name, "policy": policy, "n": d.n}
                    row["random"] = float(np.mean(list(table["random"].values())))
                    row |= {"difference": d.mean, "low": d.low, "high": d.high, "p_holm": d.p_holm}
                    found.append({**row, "conclusion": conclusion(d, policy, "random", f"{family}, {score}")})
    return found


def _by_scene(rows: list[dict[str, Any]], policy: str, score: str, pushes: Sequence[int]) -> dict[str, float]:
    """Mean of a score over the given numbers of pushes, by scene."""
    found: dict[str, list[float]] = {}
    name, plays = (f"regret {policy}", "random") if score == "regret" else (score, policy)
    for row in rows:
        if row["policy"] == plays and row["k"] in pushes and name in row:
            found.setdefault(row["scene"], []).append(row[name])
    return {scene: float(np.mean(values)) for scene, values in found.items()}


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Coverage, log loss and quality against the number of pushes, means over all scenes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    plt.style.use("mstfilter.app.report.figures")
    titles = {
        "coverage": "coverage of the first objects (higher is better)",
        LOG_LOSS: "log loss (recalibrated), nats (lower is better)",
        "quality": "quality (higher is better)",
    }
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.2))
    pushes = sorted({row["k"] for row in rows})
    for axis, (score, title) in zip(axes, titles.items(), strict=True):
        for policy in POLICIES:
            means = [np.mean(list(_by_scene(rows, policy, score, [k]).values())) for k in pushes]
            axis.plot(pushes, means, "o-", label=policy)
        axis.set(xlabel="pushes", title=title, xticks=pushes)
    axes[0].legend()
    figure.savefig(path, dpi=120)


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
        (chosen.out, family, seed, seed < n_regret, chosen.smoke) for seed in range(n_scenes) for family in families
    ]
    if chosen.workers > 1:
        with ProcessPoolExecutor(chosen.workers) as pool:
            for name in pool.map(run, jobs):
                print(name, flush=True)
    else:
        for job in jobs:
            print(run(job), flush=True)
    rows = read_rows(chosen.out / "scenes")
    write_csv(chosen.out / "runs.csv", rows, dict.fromkeys(k for row in rows for k in row), float_format=".5g")
    write_csv(chosen.out / "summary.csv", summarise(rows), float_format=".4g")
    draw(rows, chosen.out / "decisions.png")


if __name__ == "__main__":
    main()
