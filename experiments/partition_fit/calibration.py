"""Which shift of the log odds of shapes (`OnLattice.log_odds`) fits tuning scenes best?

    python experiments/partition_fit/calibration.py [--seeds 5] [--smoke --out FOLDER]

`mst` runs with no added log odds. For the questions of each pause (`mstfilter.scoring.ask`), the probabilities of the
two voxels in every hypothesis are kept. The loss is the mean of two log losses of forecasts as they come: "is the
first voxel occupied?" and "do both belong to one object?". Each scene is scored with the value of least loss on the
others.

scenes/*.npz: what is kept of one scene (finished scenes are not run again). calibration.csv: losses in nats and
calibration errors for each value. reliability.png: how often forecasts come true, without and with the default
value.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.special import expit, logit

import mstfilter
from mstfilter.base.files import write_csv
from mstfilter.lab.simulation import cached_recording
from mstfilter.scoring import ask
from mstfilter.scoring.forecasts import SOFTENING, ForecastTable

LOG_ODDS = (0.0, 0.2, 0.4, 0.5, 0.6, 0.8, 1.0)
SMALL = {"width": 160, "height": 120, "n_actions": 1}


def of_scene(family: str, seed: int, small: bool) -> dict[str, np.ndarray]:
    """Of every question: probabilities of its voxels, whether hypotheses give them to one object, and the answer."""
    recording = mstfilter.open_recording(cached_recording(family, seed, **(SMALL if small else {})))
    filter = mstfilter.preset("mst", "update.completer.log_odds=0.0")
    state, p, same, truth = filter.start(0), [], [], []
    for t, clip in enumerate(recording.clips()):
        state, _ = filter.step(state, clip)
        if not t:
            continue
        questions, true = ask(recording, t), recording.truth(t)
        a, b = questions.first[::4], questions.second[::4]
        shares = [h.shares for h in state.population.particles]
        owner = np.stack([one.owner.ravel() for one in shares])
        probability = np.stack([one.probability.ravel() for one in shares])
        p.append(np.stack([np.where(owner[:, v] > 0, probability[:, v], 0) for v in (a, b)]))
        same.append((owner[:, a] == owner[:, b]) & (owner[:, a] > 0))
        truth.append(np.stack([true.ravel()[a] > 0, questions.outcomes(true)[::4]]))
    return {
        "p": np.concatenate(p, axis=2),
        "same": np.concatenate(same, axis=1),
        "truth": np.concatenate(truth, axis=1),
    }


def forecasts(scene: dict[str, np.ndarray], log_odds: float) -> np.ndarray:
    """(2, m): the first voxel is occupied; both voxels belong to one object."""
    p = scene["p"].astype(np.float64)
    inner = (p > 0) & (p < 1)
    p[inner] = expit(logit(p[inner]) + log_odds)
    return np.stack([p[0].mean(axis=0), (scene["same"] * p.min(axis=0)).mean(axis=0)])


def tables(scenes: list[dict[str, np.ndarray]], log_odds: float) -> list[ForecastTable]:
    """The forecasts of each question in all scenes together."""
    p = np.concatenate([forecasts(scene, log_odds) for scene in scenes], axis=1)
    y = np.concatenate([scene["truth"] for scene in scenes], axis=1)
    return [ForecastTable.of(*both) for both in zip(p, y, strict=True)]


def draw(scenes: list[dict[str, np.ndarray]], path: Path) -> None:
    """The reliability diagrams of both questions."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.style.use("mstfilter.app.report.figures")
    figure, places = plt.subplots(1, 2, figsize=(8, 4.1), sharey=True, layout="constrained")
    for k, question in enumerate(("is this voxel occupied?", "do these two belong to one object?")):
        place = places[k]
        place.plot([0, 1], [0, 1], color=".6", lw=1)
        for log_odds, marker in ((0.0, "o"), (0.2, "s")):
            found = tables(scenes, log_odds)[k].reliability(15)
            label = f"added log odds {log_odds:g}: error {found.error:.3f}"
            place.plot(found.forecast, found.frequency, marker=marker, ms=4, label=label)
        place.set(title=question, xlabel="forecast", xlim=(0, 1), ylim=(0, 1), aspect="equal")
        place.legend(loc="lower right", frameon=False, fontsize=9)
    places[0].set_ylabel("share of true answers")
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def held_out(losses: np.ndarray) -> float:
    """Mean loss of scenes (s, v), each with the value that is best on the others."""
    total = losses.sum(axis=0)
    return float(np.mean([row[np.argmin(total - row)] for row in losses]))


def main() -> None:
    """Run the missing scenes, then fit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="scenes of each family, seeds 0, 1, ...")
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    if chosen.smoke and chosen.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    (chosen.out / "scenes").mkdir(parents=True, exist_ok=True)
    scenes = []
    for seed in range(2 if chosen.smoke else chosen.seeds):
        for family in ("demo",) if chosen.smoke else ("s1", "s2", "s3"):
            path = chosen.out / "scenes" / f"{family}-{seed}.npz"
            if not path.exists():
                np.savez_compressed(path, **of_scene(family, seed, chosen.smoke))
                print(path.stem, flush=True)
            scenes.append(dict(np.load(path)))
    by_log_odds = np.array(
        [[[t.log_loss(SOFTENING) for t in tables([scene], a)] for a in LOG_ODDS] for scene in scenes]
    )
    rows: list[dict[str, str]] = []
    for k, a in enumerate(LOG_ODDS):
        occupied, same = by_log_odds[:, k].mean(axis=0)
        errors = [table.reliability(15).error for table in tables(scenes, a)]
        rows.append(
            {
                **{"field": "log_odds", "value": f"{a}", "loss": f"{(occupied + same) / 2:.4f}"},
                **{"occupied_loss": f"{occupied:.4f}", "same_loss": f"{same:.4f}"},
                **{"occupied_error": f"{errors[0]:.3f}", "same_error": f"{errors[1]:.3f}"},
            }
        )
    total = held_out(by_log_odds.mean(axis=2))
    rows.append({"field": "log_odds", "value": "held out", "loss": f"{total:.4f}"})
    draw(scenes, chosen.out / "reliability.png")
    names = list(dict.fromkeys(name for row in rows for name in row))
    rows = [{name: row.get(name, "") for name in names} for row in rows]
    write_csv(chosen.out / "calibration.csv", rows)
    for row in rows:
        print("  ".join(f"{value:>18}" for value in row.values()))


if __name__ == "__main__":
    main()
