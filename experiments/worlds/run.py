"""Physics of simulated scenes: is everything at rest, and does nothing sink or fly?

    python experiments/worlds/run.py [--objects FOLDER] [--families row,stack] [--scenes N] [--smoke] [--out FOLDER]

For each scene of each family, rest.csv has: seconds to make the scene, objects, greatest overlap (mm), greatest speed
at rest (m/s or rad/s), greatest shift during one more second (mm), lowest point of an object (mm below the table),
and whether one push left all objects at rest. Scenes that are in the file are not made again. summary.csv counts, for
each family, the scenes in which something sinks (more than 2 mm into another object or the table), moves at rest
(more than 2 mm in a second), or explodes (faster than 1 m/s after a push that moved the finger at 0.1 m/s).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.files import read_csv, write_csv
from mstfilter.lab.simulation import SimulatedScene, scene_family
from mstfilter.lab.simulation.world import advance_push, draw_push, finish_push, is_clear

MESHES = ("m1", "m2", "m3")
GENERATED = ("s1", "s2", "row", "stack", "pack")


def lowest(scene: SimulatedScene) -> float:
    """Height of the lowest point of all boxes and meshes, metres."""
    heights = [
        float((shape.corners @ pose[2, :3]).min() + pose[2, 3])
        for shape, pose in zip(scene.world.shapes, scene.world.poses(), strict=True)
        if shape.surface is not None or shape.family in ("carton", "brick", "book", "box", "board", "tray")
    ]
    return min(heights, default=0.0)


def measure(family: str, seed: int, objects: str) -> dict[str, object]:
    """The row of a scene."""
    changes = {"objects": objects} if objects else {}
    began = time.process_time()
    try:
        scene = SimulatedScene(replace(scene_family(family), width=160, height=120, **changes), seed)
    except InputError as error:
        return {"family": family, "seed": seed, "error": error.message.splitlines()[0][:120]}
    seconds, world = time.process_time() - began, scene.world
    row: dict[str, object] = {"family": family, "seed": seed, "error": "", "seconds": round(seconds, 2)}
    row |= {"objects": world.n_objects, "overlap_mm": round(1000 * world.deepest_overlap(), 3)}
    row["lowest_mm"] = round(1000 * lowest(scene), 3)
    before = world.positions()
    row["speed"] = round(float(np.abs(world.data.qvel[world._velocity_index]).max()), 4)
    world.step(500)
    row["shift_mm"] = round(1000 * float(np.linalg.norm(world.positions() - before, axis=1).max()), 3)
    world.forward()
    rng, fastest = np.random.default_rng(seed), 0.0
    push = next(
        (p for p in (draw_push(rng, world, scene.family) for _ in range(100)) if is_clear(world, p.start)), None
    )
    if push is None:
        return row | {"fastest": "", "rests": ""}
    for k in range(28):
        advance_push(world, push, k * push.seconds / 28, (k + 1) * push.seconds / 28)
        linear = world.data.qvel[world._velocity_index[:, :3]]
        fastest = max(fastest, float(np.linalg.norm(linear, axis=1).max()))
    return row | {"fastest": round(fastest, 3), "rests": int(finish_push(world))}


def summary(rows: list[dict]) -> list[dict[str, object]]:
    """Counts of each family."""
    table = []
    for family in dict.fromkeys(row["family"] for row in rows):
        these = [row for row in rows if row["family"] == family]
        made = [row for row in these if not row["error"]]
        value = {name: np.array([float(row[name] or 0) for row in made]) for name in COLUMNS}
        pushed = np.array([row["rests"] != "" for row in made], bool)
        table.append(
            {
                "family": family,
                "scenes": len(these),
                "not_arranged": len(these) - len(made),
                "sinks": int((value["overlap_mm"] > 2).sum() + (value["lowest_mm"] < -2).sum()),
                "moves_at_rest": int((value["shift_mm"] > 2).sum()),
                "explodes": int((value["fastest"] > 1).sum()),
                "still_moving_after_a_push": int((pushed & (value["rests"] < 1)).sum()),
                "seconds": round(float(value["seconds"].mean()), 2) if made else "",
            }
        )
    return table


COLUMNS = ("overlap_mm", "lowest_mm", "shift_mm", "fastest", "rests", "seconds")


def main() -> None:
    """Make the missing scenes, then the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", default="", help="folder of meshes; adds the families m1 to m3")
    parser.add_argument("--families", default="")
    parser.add_argument("--scenes", type=int, default=25, help="of each family")
    parser.add_argument("--smoke", action="store_true", help="one scene of row and stack; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    families = tuple(options.families.split(",")) if options.families else GENERATED
    if options.objects and not options.families:
        families += MESHES
    if options.smoke:
        families, options.scenes = ("row", "stack"), 1
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "rest.csv"
    rows: list[dict] = list(read_csv(path)) if path.exists() else []
    done = {(row["family"], int(row["seed"])) for row in rows}
    columns = ("family", "seed", "error", "seconds", "objects", "overlap_mm", "lowest_mm", "speed", "shift_mm")
    for seed in range(options.scenes):
        for family in families:
            if (family, seed) not in done:
                row = measure(family, seed, options.objects if family in MESHES else "")
                rows.append({name: row.get(name, "") for name in (*columns, "fastest", "rests")})
                write_csv(path, rows)
    write_csv(options.out / "summary.csv", summary(rows))


if __name__ == "__main__":
    main()
