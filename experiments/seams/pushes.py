"""How many pushes until the belief is right? Informative pushes against random ones and against the largest object.

    python experiments/seams/pushes.py --out FOLDER [--families row,stack] [--seeds 0-19] [PATH=VALUE]...

A scene has two groups of parts that touch, each one object or several. After every pause, the belief is asked of each
group whether all its visible parts are one object. It is right if it gives the truth a probability of .9 or more. A
scene is decided at the first pause from which on it is right about all groups that it was asked about, up to the last
of `--most` pushes. The policies see images and beliefs only:

- `information`: the first of `push_candidates`; if there is none, as `random`.
- `random border`: one of `push_candidates` at random, with all borders however probable (`at_least=0`).
- `random`: a random push towards an object (`PushLoop.candidates`).
- `largest`: of 16 such pushes, the first that meets the largest object of the estimate.

pauses.csv has a row for each group, policy and pause; pushes.csv for each scene and policy the number of pushes until
it was decided (`--most` + 1 if it never was) and the mean log loss after each; summary.csv the mean numbers and the
ratio to `random` with a bootstrap interval over scenes.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import mstfilter
from mstfilter import Belief
from mstfilter.base.errors import InputError
from mstfilter.base.files import write_csv
from mstfilter.lab.simulation import FingerPush, PushLoop, scene_family
from mstfilter.mst.belief import PushCandidate, push_candidates
from mstfilter.scene import scaled_area, scene_cache
from mstfilter.scoring.forecasts import ForecastTable

sys.path.append(str(Path(__file__).resolve().parent.parent / "worlds"))
from one_or_two import VISIBLE, is_one, visible_parts

REACH = ((-0.5, -0.5, 0.0), (0.5, 0.5, 0.4))
POLICIES = ("information", "random border", "random", "largest")
SOFTENING = 0.04  # see `ForecastTable.log_loss`
RIGHT = 0.9  # probability from which a forecast is right
Row = dict[str, object]


def forecasts(belief: Belief, loop: PushLoop) -> dict[int, float]:
    """Probability of "one object" for each group with at least two visible parts."""
    refined, mass = belief.refined_image(loop.clip.after.camera)
    image = loop.part_image()
    parts = visible_parts(image, loop.groups, scaled_area(VISIBLE, image.size))
    objects = refined.objects[:, refined.cells]
    return {
        number: float(np.clip(mass @ np.array([is_one(row, own) for row in objects]), 0, 1))
        for number, own in parts.items()
    }


def chosen(policy: str, belief: Belief, loop: PushLoop, rng: np.random.Generator) -> FingerPush | PushCandidate:
    """The push of a policy."""
    camera = loop.clip.after.camera
    if policy in ("information", "random border"):
        at_least = 0.05 if policy == "information" else 0.0
        try:
            found = push_candidates(belief, camera, REACH, at_least=at_least)
        except InputError:  # the belief has no objects
            found = []
        if found:
            return found[0] if policy == "information" else found[int(rng.integers(len(found)))]
    pushes = loop.candidates(16 if policy == "largest" else 1)
    if policy == "largest":
        labels = belief.estimate().labels
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        largest = labels == sizes.argmax()
        for push in pushes:
            if (push.swept(loop.grid) & largest).any():
                return push
    return pushes[0]


def played(policy: str, family: str, seed: int, most: int, overrides: list[str]) -> list[Row]:
    """A row for each group and pause of a scene."""
    loop = PushLoop(replace(scene_family(family), one_share=(0.3, 0.5, 0.7)[seed % 3]), seed)
    mst, rows = mstfilter.preset("mst", *overrides), []
    state, rng = mst.start(0), np.random.default_rng([seed, POLICIES.index(policy)])
    for pushes in range(most + 1):
        state, info = mst.step(state, loop.clip)
        belief = Belief.of_step(state, info)
        asked = forecasts(belief, loop)
        for number, p in asked.items():
            about = {"policy": policy, "family": family, "seed": seed, "pushes": pushes, "group": number}
            rows.append(about | {"one": int(loop.groups[number]["one"]), "forecast": round(p, 4)})
        if pushes < most and not (asked and all(right(row) for row in rows[-len(asked) :])):
            loop.play(chosen(policy, belief, loop, rng))
        elif asked:
            break
    scene_cache.clear()
    return rows


def right(row: Row) -> bool:
    """Whether the truth has a probability of .9 or more."""
    p = float(row["forecast"])  # type: ignore[arg-type]
    return (p if row["one"] else 1 - p) >= RIGHT


def of_scene(rows: list[Row], most: int) -> Row:
    """Pushes until a scene was decided, and the log loss at its last pause."""
    last = max(int(row["pushes"]) for row in rows)  # type: ignore[call-overload]
    own = [row for row in rows if row["pushes"] == last]
    p, one = (np.array([row[name] for row in own], float) for name in ("forecast", "one"))
    loss = ForecastTable.of(p, one).log_loss(SOFTENING)
    n = last if all(right(row) for row in own) else most + 1
    return {name: rows[0][name] for name in ("policy", "family", "seed")} | {"pushes": n, "log_loss": round(loss, 3)}


def summary(scenes: list[Row]) -> list[Row]:
    """Mean numbers of pushes and their ratios to those of `random`; scenes that need no push are left out."""
    rng, found = np.random.default_rng(0), []
    table = {(str(r["policy"]), f"{r['family']} {r['seed']}"): float(r["pushes"]) for r in scenes}  # type: ignore[arg-type]
    names = [n for n in dict.fromkeys(n for _, n in table) if table.get(("random", n), 0) > 0]
    for policy in dict.fromkeys(policy for policy, _ in table):
        own, random = (np.array([table[p, n] for n in names if (policy, n) in table]) for p in (policy, "random"))
        draws = rng.integers(len(own), size=(5000, len(own)))
        ratio = own[draws].mean(axis=1) / random[draws].mean(axis=1)
        low, high = np.percentile(ratio, (2.5, 97.5))
        found.append(
            {"policy": policy, "scenes": len(own), "pushes": round(own.mean(), 2)}
            | {"ratio": round(own.mean() / random.mean(), 3), "low": round(low, 3), "high": round(high, 3)}
        )
    return found


def main() -> None:
    """Play all scenes and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", metavar="PATH=VALUE", help="changes to the preset mst")
    parser.add_argument("--families", default="row,stack")
    parser.add_argument("--seeds", default="0-19")
    parser.add_argument("--policies", default=",".join(POLICIES))
    parser.add_argument("--most", type=int, default=5)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    first, last = (int(n) for n in (options.seeds.split("-") * 2)[:2])
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    scenes: list[Row] = []
    for seed in range(first, last + 1):
        for family in options.families.split(","):
            for policy in options.policies.split(","):
                try:
                    own = played(policy, family, seed, options.most, options.overrides)
                except InputError as error:  # the objects cannot be arranged, or there is no room for a push
                    print(family, seed, policy, error, flush=True)
                    continue
                if own:
                    rows += own
                    scenes.append(of_scene(own, options.most))
                    print(*scenes[-1].values(), flush=True)
        write_csv(options.out / "pauses.csv", rows)
        write_csv(options.out / "pushes.csv", scenes)
    write_csv(options.out / "summary.csv", found := summary(scenes))
    for row in found:
        print(*(f"{name} {value}" for name, value in row.items()), sep=", ")


if __name__ == "__main__":
    main()
