"""The families s1, s2, s3: contents of the scenes, their stability, and the difficulty of a single frame.

    python experiments/families/run.py            # an hour on one core; finished scenes are not run again
    python experiments/families/run.py --smoke --out DIR    # half a minute

Writes counts.csv (one row per scene: physics and visibility), difficulty.csv, summary.csv and pictures. A row of
difficulty.csv has the quality of the single-frame baseline and of floors on a first pause, in the image and in space.
All seeds are tuning seeds.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mstfilter.base.files import read_csv, write_csv
from mstfilter.lab.simulation import (
    FIRST_REPORTED_SEED,
    SceneFamily,
    SimulatedScene,
    play_push,
    scene_family,
)
from mstfilter.mst.completion import Extrude, arbitrate
from mstfilter.mst.segmentation import OptimalCut, TreeCutProposal, optimal_cut
from mstfilter.scene import Clip, Frame
from mstfilter.scoring import weighted_coverage

FAMILIES = ("s1", "s2", "s3")
SEEN = 150  # pixels at 640 x 480 from which an object counts as visible
MOVED = 0.01  # metres


def visible(scene: SimulatedScene) -> np.ndarray:
    """Visible pixels (n,) of each object without sensor noise, scaled to an image of 640 x 480 pixels."""
    camera = scene.camera
    rays = camera.rays().reshape(-1, 3) @ camera.pose.as_matrix()[:3, :3].T
    geom, _, _ = scene.world.cast(np.array(camera.position), rays, (1,))
    ids = scene.world.geom_object[geom[geom >= 0]]
    return np.bincount(ids, minlength=256)[1 : scene.world.n_objects + 1] * (640 / camera.width) ** 2


def count(family: SceneFamily, seed: int) -> dict[str, float]:
    """Simulate one scene and its pushes without rendering, and count objects and contacts."""
    scene = SimulatedScene(replace(family, width=160, height=120, supersample=False), seed)
    world = scene.world
    pixels, contacts, deepest = [visible(scene)], [len(world.contacts())], [world.deepest_overlap()]
    moved, toppled, left, restless = [], 0, 0, 0
    for action in range(family.n_actions):
        result = play_push(world, scene.choose_push(action), scene.family)
        pixels.append(visible(scene))
        contacts.append(len(world.contacts()))
        deepest.append(world.deepest_overlap())
        moved.append(result.moved(MOVED))
        toppled += int((result.turned > np.deg2rad(75)).sum())
        left += int((~scene.family.contains_points(world.positions())).sum())
        restless += int(not result.settled)
    seen = np.array(pixels)
    truth = scene.truth()
    pairs = set(world.contacts())
    twins = [(min(k, t), max(k, t)) for k, t in enumerate(scene.objects.twin_of) if t >= 0]
    return {
        "objects": world.n_objects,
        "visible": float((seen >= SEEN).mean()),
        "slivers": float(((seen > 0) & (seen < SEEN)).mean()),
        "hidden": float((seen == 0).mean()),
        "hidden_at_first": int((seen[0] == 0).sum()),
        "seen_and_hidden": float(((seen == 0).any(axis=0) & (seen >= SEEN).any(axis=0)).mean()),
        "never_seen": float((seen == 0).all(axis=0).mean()),
        "moved": float(np.mean(moved)),
        "moved_least": int(min(moved)),
        "toppled": toppled,
        "left_workspace": left,
        "restless": restless,
        "contacts": float(np.mean(contacts)),
        "twins_touch_at_last": sum(pair in pairs for pair in twins),
        "overlap_mm": 1000 * max(deepest),
        "without_voxels": world.n_objects - len(np.unique(truth[truth > 0])),
        "median_pixels": float(np.median(seen[seen >= SEEN])),
    }


def judge(family: SceneFamily, seed: int) -> dict[str, float]:
    """Quality of the single-frame baseline and of floors on the first pause."""
    scene = SimulatedScene(family, seed)
    seen = scene.frame_images(0)
    frame = Frame(seen["rgb"], seen["depth"], scene.camera, None)
    # As on the real frames, pixels without a reading count on neither side.
    read = np.isfinite(seen["depth"])
    image = np.where(read, seen["instance"], 0)
    volume = scene.truth()
    proposal = TreeCutProposal(sampler=OptimalCut())
    tree, values = proposal.tree_of(frame, scene.grid)
    labels = proposal.objects.label_image(tree, optimal_cut(tree, values), frame, scene.grid)
    own = proposal.objects.segments(tree, frame, scene.grid).object_pixels
    population = proposal.sample(np.random.default_rng(seed), Clip((frame,), scene.grid, 0), 1)

    def score(found: np.ndarray) -> float:
        return weighted_coverage(np.where(read, found, 0), image)

    least = proposal.objects.min_points
    masks = [seen["instance"] == k for k in range(1, scene.world.n_objects + 1) if (seen["instance"] == k).any()]
    filled = arbitrate(Extrude().complete(np.random.default_rng(0), frame, masks, scene.grid), scene.grid)
    return {
        "objects_seen": len(np.unique(image[image > 0])),
        "single_frame_image": score(labels),
        "one_blob_image": score(own.astype(np.int32)),
        "components_image": score(_components(own, frame.depth, least)),
        "depth_steps_image": score(_components(own, frame.depth, least, 0.01)),
        "single_frame_space": weighted_coverage(population.particles[0].labels, volume),
        "true_masks_space": weighted_coverage(filled, volume),
        "missing_near_objects": _missing(image > 0, read),
    }


def _components(own: np.ndarray, depth: np.ndarray, least: int, step: float = np.inf) -> np.ndarray:
    """4-connected components above the table; neighbours whose depth differs by `step` m or more are not joined."""
    index, z = np.arange(own.size).reshape(own.shape), np.where(own, depth, 0)
    links = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        joined = own[a] & own[b] & (np.abs(z[a] - z[b]) < step)
        links.append((index[a][joined], index[b][joined]))
    rows, columns = (np.concatenate(x) for x in zip(*links, strict=True))
    graph = coo_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(own.size, own.size))
    found = connected_components(graph, directed=False)[1].reshape(own.shape) + 1
    found[~own] = 0
    found[np.bincount(found.ravel())[found] < least] = 0
    return np.unique(found, return_inverse=True)[1].reshape(own.shape)


def _missing(objects: np.ndarray, read: np.ndarray) -> float:
    near = cv2.dilate(objects.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    return float((near & ~read).sum() / near.sum())


def fill(
    target: Path, work: Callable[[SceneFamily, int], dict[str, float]], jobs: list[tuple[SceneFamily, int]]
) -> list:
    """One row per scene. Rows that are in the file are not computed again; each new row is written immediately."""
    lines = read_csv(target) if target.exists() else []
    done = {(line["family"], line["seed"]) for line in lines}
    for family, seed in jobs:
        if (family.name, str(seed)) in done:
            continue
        result = {k: f"{v:.4f}" if isinstance(v, float) else str(v) for k, v in work(family, seed).items()}
        lines.append({"family": family.name, "seed": str(seed), **result})
        print(*lines[-1].values(), flush=True)
        write_csv(target, sorted(lines, key=lambda line: (line["family"], int(line["seed"]))))
    return lines


def summarise(target: Path, tables: list[list[dict[str, str]]]) -> None:
    """Mean, smallest and largest value of every column by family."""
    header = ("mean", "least", "greatest", "half_width_95")
    rows = []
    for name in FAMILIES:
        for table in tables:
            own = [line for line in table if line["family"] == name]
            for measure in [k for k in (own[0] if own else {}) if k not in ("family", "seed")]:
                values = np.array([float(line[measure]) for line in own])
                half = 2.0 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
                figures = [f"{x:.3f}" for x in (values.mean(), values.min(), values.max(), half)]
                row = {"family": name, "measure": measure, "scenes": len(values)}
                rows.append(row | dict(zip(header, figures, strict=True)))
    write_csv(target, rows)


def picture(folder: Path, small: dict[str, int]) -> None:
    """Colour and depth of first pauses, and one action frame of each family."""
    rows = []
    for name in FAMILIES:
        shots = []
        for seed in (0, 1, 2):
            scene = SimulatedScene(replace(scene_family(name), **small), seed)
            shots.append(scene.frame_images(0))
        from mstfilter.lab.simulation import advance_push

        push = scene.choose_push(0)
        advance_push(scene.world, push, 0.0, 0.55 * push.seconds)
        shots.append(scene.frame_images(1))
        rgb = np.hstack([shot["rgb"][..., ::-1] for shot in shots])
        z = np.hstack([np.nan_to_num(shot["depth"]) for shot in shots])
        far = np.clip((z - 0.4) / 1.2, 0, 1)
        depth = cv2.applyColorMap((255 * far).astype(np.uint8), cv2.COLORMAP_TURBO)
        depth[z == 0] = 0
        rows += [rgb, depth]
    whole = np.vstack(rows)
    size = (1280, round(1280 * whole.shape[0] / whole.shape[1]))
    cv2.imwrite(str(folder / "scenes.jpg"), cv2.resize(whole, size, interpolation=cv2.INTER_AREA), [1, 85])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "results")
    parser.add_argument("--scenes", type=int, default=20, help="seeds 0, 1, ... of each family")
    parser.add_argument("--families", default=",".join(FAMILIES), help="which, separated by commas")
    parser.add_argument("--only", choices=("counts", "difficulty", "pictures"))
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    assert options.scenes <= FIRST_REPORTED_SEED // 10, "tuning seeds are 0 - 99"
    options.out.mkdir(parents=True, exist_ok=True)
    small = {"width": 160, "height": 120, "n_actions": 1} if options.smoke else {}
    names, scenes = (("s1",), 2) if options.smoke else (options.families.split(","), options.scenes)
    jobs = [(replace(scene_family(name), **small), seed) for seed in range(scenes) for name in names]
    parts = (options.only,) if options.only else ("counts", "difficulty", "pictures")
    tables = []
    if "difficulty" in parts:
        tables.append(fill(options.out / "difficulty.csv", judge, jobs))
    if "counts" in parts:
        tables.append(fill(options.out / "counts.csv", count, jobs))
    if len(tables) == 2:
        summarise(options.out / "summary.csv", tables)
    if "pictures" in parts and not options.smoke:
        picture(options.out, small)


if __name__ == "__main__":
    main()
