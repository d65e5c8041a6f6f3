"""One box or two? Probabilities of both readings of ambiguous scenes.

    python experiments/weights/ambiguity.py [--smoke --out FOLDER]

A scene has one box, or two boxes that touch. Both cases have the same outline, up to a random offset and turn of the
second box. The print shows one box or two, independently of the truth. `mst` sees two images of the scene; nothing
moves between the images. *Forecast*: the total weight of the candidates in which both halves are one object. At the
first pause the candidates are the distinct samples of the tree.

scenes.csv: truth, print and forecasts of each scene (finished scenes are not run again). ambiguity.csv: forecasts and
frequencies, by print and in bins of equal size.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from reliability import cells_of, recorded

import mstfilter
from mstfilter.base.files import read_csv, write_csv
from mstfilter.lab.simulation.families import scene_family
from mstfilter.lab.simulation.groups import about_z
from mstfilter.lab.simulation.renderer import Renderer, visible_texel
from mstfilter.lab.simulation.sensor import DepthSensor, colour_reading
from mstfilter.lab.simulation.shapes import TUNING, Shape
from mstfilter.lab.simulation.solids import box
from mstfilter.lab.simulation.textures import Skin, draw_room, draw_skin, sliced
from mstfilter.lab.simulation.world import PhysicsWorld
from mstfilter.scene import Clip, Frame
from mstfilter.scoring.forecasts import ForecastTable

FAMILY = replace(scene_family("demo"), catalogue="tuning")
OFFSET, TURN = 0.01, 0.07  # standard deviations of the offset and the turn of the second box, metres and radians
FACES = ("-x", "+x", "-y", "+y", "-z", "+z")


def carton(half: np.ndarray) -> Shape:
    """A carton."""
    return Shape("carton", "carton", [box(tuple(half))], 0.3, "box", ((3, 1.0),), ("carton",))


def joined(left: Skin, right: Skin) -> Skin:
    """The print of two boxes, side by side along y, on one box. `left` has the smaller y."""
    charts = []
    for k, face in enumerate(FACES):
        # The right of a face, seen from outside, is -y on the face -x and +y on +x; up is +y on the faces -z and +z.
        pair = (right.charts[k], left.charts[k])
        if face == "+x":
            pair = pair[::-1]
        one = left.charts[k] if face == "-y" else right.charts[k]
        charts.append(one if face[1] == "y" else np.concatenate(pair, axis=1 if face[1] == "x" else 0))
    return Skin((*charts, left.charts[-1]), left.gloss)


def scene(seed: int) -> tuple[list[Clip], np.ndarray, dict[str, int]]:
    """Two images of a scene, the half (H, W) of each pixel (1 or 2, 0 is none), and what is true."""
    rng = np.random.default_rng([seed, 31])
    two, prints = bool(rng.integers(2)), int(rng.integers(1, 3))
    half = np.array([rng.uniform(0.02, 0.05), rng.uniform(0.025, 0.05), rng.uniform(0.03, 0.09)])
    whole, part = carton(half * (1, 2, 1)), carton(half)
    if prints == 2:
        parts = [draw_skin(rng, part, TUNING), draw_skin(rng, part, TUNING)]
        skin = joined(*parts)
    else:
        skin = draw_skin(rng, whole, TUNING)
        parts = sliced(skin, 1, 2)
    offset, turned, yaw = OFFSET * rng.standard_normal(), TURN * rng.standard_normal(), rng.uniform(-np.pi, np.pi)
    turn, up = about_z(yaw), half[2]
    world = PhysicsWorld((part, part) if two else (whole,), arm=False)
    if two:
        gap = half[0] * abs(np.sin(turned)) - half[1] * (1 - np.cos(turned)) + 0.0003  # the boxes touch
        world.place(0, turn @ (0, -half[1], up), turn)
        world.place(1, turn @ (offset, half[1] + gap, up), turn @ about_z(turned))
    else:
        world.place(0, turn @ (0, 0, up), turn)
    world.forward()
    camera = FAMILY.camera()
    room = draw_room(rng, visible_texel(camera))
    view = Renderer(world, parts if two else (skin,), room, camera, FAMILY.supersample).render()
    clips: list[Clip] = []
    for t in range(2):
        depth = DepthSensor().read(rng, view.depth, view.slant)
        frame = Frame(colour_reading(rng, view.colour * room.exposure), depth, camera)
        clips.append(Clip((frame,) if not t else (clips[0].after, frame), FAMILY.grid(), t))
    rays = camera.rays().reshape(*view.depth.shape, 3) * view.depth[..., None]
    world_points = rays @ camera.pose.as_matrix()[:3, :3].T + camera.position
    local = world_points @ turn  # y < 0 is the first half
    sides = np.where(local[..., 1] < 0, 1, 2) if not two else view.instance
    sides = np.where(view.instance > 0, sides, 0).astype(int)
    return clips, sides, {"seed": seed, "one": int(not two), "prints": prints}


def joins(partition: np.ndarray, counts: np.ndarray) -> bool:
    """Whether most readings of both halves have one segment, from segments (K,) and numbers of readings (K, 3)."""
    by_segment = np.zeros((int(partition.max(initial=0)) + 1, 3))
    np.add.at(by_segment, partition, counts)
    first, second = by_segment[:, 1:].argmax(axis=0)
    return bool(first == second)


def forecast(seed: int) -> dict[str, object]:
    """The row of a scene: the probability of "one object" at both pauses."""
    clips, sides, row = scene(seed)
    filter, kept, _ = recorded(mstfilter.preset("mst"))
    state, p = filter.start(seed), []
    for t, clip in enumerate(clips):
        if not t:
            samples = filter.proposal.sample(np.random.default_rng(seed), clip, filter.n_proposed)
            cells = cells_of(samples, clip)
            partitions, weights = cells.samples, samples.weights
        state, _ = filter.step(state, clip)
        if t:
            cells, choices = kept[-1].cells, kept[-1].choices
            partitions, weights = choices.partitions, np.exp(choices.log_weights)
        counts = cells.counts(cells.readings.of_image(sides))
        counts = np.pad(counts, ((0, 0), (0, 3 - counts.shape[1])))
        p.append(float(weights @ [joins(one, counts) for one in partitions] / weights.sum()))
    return {**row, "first": round(p[0], 4), "second": round(p[1], 4)}


def summary(rows: list[dict[str, float]], n_bins: int = 5) -> list[dict[str, object]]:
    """Forecasts and frequencies of "one object", for each pause, for both prints and in bins."""
    table = []
    for pause in ("first", "second"):
        p, one = (np.array([row[name] for row in rows], float) for name in (pause, "one"))
        prints = np.array([row["prints"] for row in rows], float)
        for name, chosen in (("all", prints > 0), ("print of one", prints == 1), ("print of two", prints == 2)):
            if chosen.any():
                table.append((pause, name, chosen.sum(), p[chosen].mean(), one[chosen].mean()))
        bins = ForecastTable.of(p, one).reliability(n_bins)
        table += [
            (pause, f"bin {k}", *row)
            for k, row in enumerate(zip(bins.count, bins.forecast, bins.frequency, strict=True))
        ]
        table.append((pause, "calibration error", len(p), bins.error, ""))
    names = ("pause", "scenes", "n", "forecast", "frequency")
    return [
        dict(zip(names, (x if isinstance(x, str) else round(float(x), 3) for x in row), strict=True)) for row in table
    ]


def main() -> None:
    """Run the missing scenes, then make the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--smoke", action="store_true", help="four scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "scenes.csv"
    rows: list[dict] = list(read_csv(path)) if path.exists() else []
    for seed in range(len(rows), 4 if options.smoke else options.scenes):
        rows.append(forecast(seed))
        write_csv(path, rows)
    write_csv(options.out / "ambiguity.csv", summary(rows))


if __name__ == "__main__":
    main()
