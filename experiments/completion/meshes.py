"""Completion of single masks of household meshes: every completer on the same masks, by kind, size and visible share.

    python experiments/completion/meshes.py make --out FOLDER [--scenes 40]     # needs MSTFILTER_OBJECTS; resumable
    python experiments/completion/meshes.py score --out FOLDER [--results experiments/completion/results/meshes]
    python experiments/completion/meshes.py score --out FOLDER --also mine=WEIGHTS --results FOLDER  # other weights

`make` writes one file a scene with the crops of its masks: scenes of the families m1, m2 and m3 at rest, seen by one
camera each, whose height and distance vary. The objects are those of the tuning pool, or with --reported those of the
reported pool; no network was trained on either. The masks are true ones with displaced borders, and segments of
sampled cuts of the segmentation tree, which also hold parts of objects, and several objects. `score` completes the
crops and writes two tables: IoU, log loss, calibration, volume and surface distance by completer and group, and
differences from the network, paired by scene.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from mstfilter.base.errors import InputError
from mstfilter.base.files import atomic_path, write_csv
from mstfilter.base.resources import training_program
from mstfilter.lab.simulation import SimulatedScene, scene_family
from mstfilter.lab.simulation.families import FIRST_REPORTED_SEED
from mstfilter.lab.simulation.objects import open_objects
from mstfilter.lab.simulation.shapes import Shape
from mstfilter.mst.completion import Completer, Extrude, NetworkCompleter, ObservedBox, Pooled, Posterior
from mstfilter.mst.completion.crops import LATTICE, crop_box
from mstfilter.mst.completion.observed import decode_signed, encode_box, observed_again
from mstfilter.scene import Camera, Frame, Seen, VoxelGrid, scene_cache
from mstfilter.scoring.forecasts import ForecastTable
from mstfilter.scoring.statistics import compare

HERE = Path(__file__).resolve().parent
FAMILIES = ("m1", "m2", "m3")
MASK_KINDS = ("whole", "part", "several")
N_MASKS = 15  # of a scene, besides the true ones
LEAST_PIXELS, LEAST_SHARE, WHOLE = 80, 0.1, 0.8  # as in the training data, of images with four times the pixels
N_POINTS = 800  # on the true surface of an object
CLIPPED = (
    0.01  # forecasts of the log loss are clipped to .01 .. .99: a voxel outside of all candidates is not certain
)
ASKED = 0.02  # a voxel is in question if it is on or behind the mask's surface, or some completer gives it as much
NEAR = 0.005  # metres, for the share of the surface that is right
_STEPS = np.argwhere(np.ones((3, 3, 3)))[14:] - 1  # to half of the neighbours of a voxel


@dataclass(frozen=True, eq=False)
class MeshSample:
    """The crop of one mask, what fills it, and what is known about the main object of the mask."""

    bits: np.ndarray  #: (a, b, c) uint8, flags of `Seen`
    signed: np.ndarray  #: (a, b, c) int8
    points: np.ndarray  #: (a, b, c) uint8: readings, at most 255
    truth: np.ndarray  #: (a, b, c) bool
    surface: np.ndarray  #: (n, 3) float32, metres in the crop: points of the true surface; empty unless whole
    about: np.ndarray  #: (7,) str: scene, kind of mask, kind, name and source of object, length (m), visible share

    def box(self) -> ObservedBox:
        own, other, free, behind, hidden = (flag.among(self.bits) for flag in Seen)
        height = (np.arange(self.bits.shape[2]) + 0.5) * LATTICE
        return ObservedBox(
            self.points.astype(np.int32), own, other, free, behind, hidden, decode_signed(self.signed), height
        )


class _Crop(Extrude):
    """The crop of the network, whole."""

    def box(self, voxels: np.ndarray, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
        return crop_box(voxels, grid)


def make_scene(family: str, seed: int) -> list[MeshSample]:
    """The samples of a scene."""
    rng = np.random.default_rng([seed, FAMILIES.index(family)])
    changes = {"camera_distance": float(rng.uniform(0.6, 1.15)), "camera_higher": float(rng.uniform(-18, 22))}
    scene = SimulatedScene(replace(scene_family(family), n_actions=0, arm=False, supersample=False, **changes), seed)
    images = scene.frame_images(0)
    frame, instance = Frame(images["rgb"], images["depth"], scene.camera), images["instance"]
    truth, visible = scene.truth(), _visible_shares(scene)
    sources = {one.name: one.source for one in open_objects(scene.family.objects).objects}
    data = training_program("completion_data")
    masks = [_displaced(rng, instance == k) for k in range(1, scene.world.n_objects + 1)]
    drawn = data.draw_masks(rng, frame, instance, scene.grid, N_MASKS)
    made = []
    for mask in [*masks, *drawn[len(drawn) // 3 :]]:
        counts = np.bincount(instance[mask & frame.valid], minlength=256)
        whole = np.bincount(instance[frame.valid], minlength=256)
        counts[0] = 0
        found = [k for k in np.flatnonzero(counts).tolist() if counts[k] >= LEAST_SHARE * max(counts.sum(), whole[k])]
        main = int(counts.argmax())
        shape = scene.world.shapes[main - 1] if main else None
        if shape is None or counts[main] < LEAST_PIXELS or main not in found or shape.surface is None:
            continue
        offset, _, seen, _ = observed_again(frame, mask, (), scene.grid, _Crop(), refute=False)
        if not seen.surface.any():
            continue
        box = tuple(slice(int(o), int(o) + n) for o, n in zip(offset, seen.surface.shape, strict=True))
        filled, near = np.zeros(seen.surface.shape, bool), ndimage.binary_dilation(mask, np.ones((3, 3)), 2)
        for k in found:
            filled |= data.claimed_voxels(frame, instance == k, near, truth[box] == k, scene.grid, offset)
        kind = 2 if len(found) > 1 else int(counts[main] < WHOLE * whole[main])
        points = _surface_points(rng, shape, scene.poses()[main - 1]) if kind == 0 else np.zeros((0, 3))
        at = (points - (np.asarray(scene.grid.origin) + np.asarray(offset) * LATTICE)).astype(np.float32)
        about = (f"{family}-{seed}", MASK_KINDS[kind], shape.family, shape.name, sources.get(shape.name, ""))
        numbers = f"{2 * shape.half.max():.3f}", f"{visible[main - 1]:.3f}"
        bits, signed = encode_box(seen)
        made.append(
            MeshSample(
                bits, signed, np.minimum(seen.points, 255).astype(np.uint8), filled, at, np.array(about + numbers)
            )
        )
    return made


def _displaced(rng: np.random.Generator, mask: np.ndarray) -> np.ndarray:
    """A mask with its border displaced by up to two pixels."""
    change = int(rng.integers(-2, 3))
    if not change:
        return mask
    return (ndimage.binary_dilation if change > 0 else ndimage.binary_erosion)(mask, np.ones((3, 3)), abs(change))


def _visible_shares(scene: SimulatedScene) -> np.ndarray:
    """Visible share (n,) of the silhouette of each object."""
    scenes, world = training_program("scenes"), scene.world
    small: Camera = scene.camera.scaled(0.25)

    def seen() -> np.ndarray:
        geom, _, _ = scenes.cast(world, small, (0, 1, 4))
        return np.bincount(np.where(geom >= 0, world.geom_object[np.maximum(geom, 0)], 0), minlength=256)

    together, shares = seen(), np.zeros(world.n_objects)
    state, positions, rotations = world.save(), world.positions(), world.rotations()
    for k in range(world.n_objects):
        for other in set(range(world.n_objects)) - {k}:
            scenes.put_away(world, other)
        world.place(k, positions[k], rotations[k])
        world.forward()
        shares[k] = together[k + 1] / max(seen()[k + 1], 1)
        world.restore(state)
    return shares


def _surface_points(rng: np.random.Generator, shape: Shape, pose: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the surface of a mesh in the world, uniform by area."""
    assert shape.surface is not None
    a, b, c = (shape.surface.vertices[shape.surface.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(area), N_POINTS, p=area / area.sum())
    u, v = np.sqrt(rng.uniform(size=N_POINTS)), rng.uniform(size=N_POINTS)
    weights = (1 - u)[:, None], (u * (1 - v))[:, None], (u * v)[:, None]
    points = shape.scale * sum(w * corner[face] for w, corner in zip(weights, (a, b, c), strict=True))
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def make(out: Path, n_scenes: int, first: int) -> None:
    """Write the missing files of scenes with seeds from `first` on."""
    out.mkdir(parents=True, exist_ok=True)
    for k in range(n_scenes):
        family, seed = FAMILIES[k % len(FAMILIES)], first + k // len(FAMILIES)
        path = out / f"{family}-{seed}.npz"
        if path.exists():
            continue
        try:
            samples = make_scene(family, seed)
        except InputError as error:  # the objects of some scenes do not fit on the table
            print(f"{family}-{seed}: {error.message}", flush=True)
            continue
        scene_cache.clear()
        arrays = {f"{name}_{i}": value for i, one in enumerate(samples) for name, value in vars(one).items()}
        with atomic_path(path) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **arrays)
        print(f"{family}-{seed}: {len(samples)} masks", flush=True)


def read(path: Path) -> list[MeshSample]:
    """The samples of a scene."""
    with np.load(path) as z:
        n = sum(name.startswith("about_") for name in z.files)
        return [MeshSample(**{name: z[f"{name}_{i}"] for name in MeshSample.__dataclass_fields__}) for i in range(n)]


def opinions(
    completer: Completer, samples: Sequence[MeshSample], path: Path
) -> tuple[list[tuple[np.ndarray, float]], float]:
    """`Completer.opinions` of a scene's samples, 0 in free space, and milliseconds a mask; from the file if there."""
    if path.exists():
        with np.load(path) as z:
            found = [z[f"p_{k}"].astype(np.float32) for k in range(len(samples))]
            return list(zip(found, z["factor"].tolist(), strict=True)), float(z["ms"])
    boxes, rng = [one.box() for one in samples], np.random.default_rng(0)
    began = time.process_time()
    found, factor = zip(*completer.opinions([rng] * len(boxes), boxes), strict=True)
    ms = 1000 * (time.process_time() - began) / len(samples)
    found = [np.where(box.free, 0, p).astype(np.float16) for box, p in zip(boxes, found, strict=True)]
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, ms=ms, factor=factor, **{f"p_{k}": p for k, p in enumerate(found)})
    return opinions(completer, samples, path)


def surface_distances(p: np.ndarray, surface: np.ndarray) -> tuple[float, float]:
    """Mean distance in mm between the true and the estimated surface, and the share that is within 5 mm.

    The estimated surface is where p crosses one half on the way to one of the 26 neighbours of a voxel, by linear
    interpolation. Both values are means of the two directions, and distances are to the nearest point: the spacing of
    the points (4 mm of the estimated surface, more of the true one of large objects) adds 1 to 4 mm for all alike.
    """
    padded = np.pad(p, 1)
    found = []
    for step in _STEPS:
        here = tuple(slice(max(-d, 0), n - max(d, 0)) for d, n in zip(step, padded.shape, strict=True))
        there = tuple(slice(max(d, 0), n - max(-d, 0)) for d, n in zip(step, padded.shape, strict=True))
        a, b = padded[here], padded[there]
        index = np.argwhere((a >= 0.5) != (b >= 0.5))
        first, second = a[tuple(index.T)], b[tuple(index.T)]
        start = index + [one.start for one in here]
        found.append(start + ((0.5 - first) / (second - first))[:, None] * step)
    points = (np.concatenate(found) - 0.5) * LATTICE  # the padding is a voxel, and centres are at one half
    if not len(points):
        return np.nan, 0.0
    there, back = cKDTree(points).query(surface)[0], cKDTree(surface).query(points)[0]
    return 500 * float(there.mean() + back.mean()), float((there < NEAR).mean() + (back < NEAR).mean()) / 2


def groups_of_masks(samples: Sequence[MeshSample]) -> dict[str, np.ndarray]:
    """Masks (n,) bool of each group. Groups by object have masks of whole objects only."""
    _, mask, kind, _, source, length, visible = np.array([one.about for one in samples]).T
    whole, length, visible = mask == "whole", length.astype(float), visible.astype(float)
    groups = {"all": np.ones(len(samples), bool), **{f"mask: {name}": mask == name for name in MASK_KINDS}}
    groups |= {f"kind: {name}": whole & (kind == name) for name in sorted(set(kind.tolist()))}
    groups |= {
        f"size: {100 * a:.0f} - {100 * b:.0f} cm": whole & (length >= a) & (length < b)
        for a, b in pairwise((0.04, 0.12, 0.20, 0.30, 0.45))
    }
    limits = {"90 - 100 %": (0.9, 9), "50 - 90 %": (0.5, 0.9), "below 50 %": (0, 0.5)}
    groups |= {f"visible: {name}": whole & (visible >= a) & (visible < b) for name, (a, b) in limits.items()}
    return groups | {"scans": whole & (source == "urdf_models")}


def score(out: Path, results: Path, also: dict[str, str]) -> None:
    """Complete all samples and write the tables. `also` has the weights of further networks by name."""
    completers: dict[str, Completer] = {
        "extrude": Extrude(),
        "network": NetworkCompleter(),
        "prior": NetworkCompleter(weights="completion_prior"),
        "posterior": Posterior(),
        **{name: NetworkCompleter(weights=weights) for name, weights in also.items()},
    }
    samples: list[MeshSample] = []
    said: dict[str, list[tuple[np.ndarray, float]]] = {name: [] for name in completers}
    ms: dict[str, list[float]] = {name: [] for name in completers}
    for path in sorted(out.glob("*.npz")):
        of_scene = read(path)
        samples += of_scene
        for name, completer in completers.items():
            of_all, cost = opinions(completer, of_scene, out / name / path.name)
            said[name] += of_all
            ms[name] += [cost] * len(of_scene)
    found = {name: [p for p, _ in of_all] for name, of_all in said.items()}
    pairs = zip(said["posterior"], found["extrude"], strict=True)
    found["posterior"] = [fits * p + (1 - fits) * otherwise for (p, fits), otherwise in pairs]
    found["pooled"] = [Pooled().mean(both) for both in zip(said["network"], said["posterior"], strict=True)]
    ms["pooled"] = [a + b for a, b in zip(ms["network"], ms["posterior"], strict=True)]
    asked = [
        ~Seen.FREE.among(one.bits) & ((Seen.SURFACE | Seen.BEHIND).among(one.bits) | (np.max(p, axis=0) > ASKED))
        for one, *p in zip(samples, *found.values(), strict=True)
    ]
    values = {name: _scores(p, samples, asked) for name, p in found.items()}
    groups, rows, differences = groups_of_masks(samples), [], []
    scene = np.array([one.about[0] for one in samples])
    for name, value in values.items():
        for group, of in groups.items():
            if not of.any():
                continue
            chosen = np.flatnonzero(of)
            every = np.concatenate([found[name][k][asked[k]] for k in chosen])
            truth = np.concatenate([samples[k].truth[asked[k]] for k in chosen])
            reliability = ForecastTable.of(np.round(every, 3), truth).reliability(20)
            with_surface = of & np.isfinite(value["distance_mm"])
            rows.append(
                {
                    **{"completer": name, "group": group, "n": int(of.sum()), "iou": value["iou"][of].mean()},
                    **{"log_loss": value["log_loss"][of].mean(), "calibration_error": reliability.error},
                    **{"bias": float(every.mean() - truth.mean()), "volume": np.median(value["volume"][of])},
                    "distance_mm": value["distance_mm"][with_surface].mean() if with_surface.any() else None,
                    "within_5_mm": value["within_5_mm"][with_surface].mean() if with_surface.any() else None,
                    "ms": float(np.mean(ms[name])),
                }
            )
            if name != "network":
                for measure in ("iou", "log_loss"):
                    own, other = (
                        {s: float(v[measure][of & (scene == s)].mean()) for s in np.unique(scene[of])}
                        for v in (value, values["network"])
                    )
                    if len(own) > 2:
                        d = compare(own, other)
                        about = {"completer": name, "group": group, "measure": measure, "scenes": len(own)}
                        differences.append({**about, "minus_network": d.mean, "low": d.low, "high": d.high})
    write_csv(results / "summary.csv", rows, float_format=".4g")
    write_csv(results / "differences.csv", differences, float_format=".4g")
    for row in rows:
        if row["group"] == "all" or row["group"].startswith("mask"):
            print("  ".join(f"{v:.3f}" if isinstance(v, float) else f"{v!s:18}" for v in row.values()))


def _scores(
    found: Sequence[np.ndarray], samples: Sequence[MeshSample], asked: Sequence[np.ndarray]
) -> dict[str, np.ndarray]:
    """Scores (n,) of the probabilities of each mask."""
    rows = []
    for p, one, question in zip(found, samples, asked, strict=True):
        shape, q = p >= 0.5, np.clip(p[question], CLIPPED, 1 - CLIPPED)
        loss = -np.log(np.where(one.truth[question], q, 1 - q)).mean()
        far, near = surface_distances(p, one.surface) if len(one.surface) else (np.nan, np.nan)
        both, either, volume = (shape & one.truth).sum(), (shape | one.truth).sum(), max(int(one.truth.sum()), 1)
        rows.append((both / max(int(either), 1), loss, shape.sum() / volume, far, near))
    columns = np.array(rows).T
    return dict(zip(("iou", "log_loss", "volume", "distance_mm", "within_5_mm"), columns, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "score"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", type=int, default=48)
    parser.add_argument("--results", type=Path, default=HERE / "results" / "meshes")
    parser.add_argument("--reported", action="store_true", help="scenes with objects of the reported pool")
    parser.add_argument("--also", action="append", default=[], metavar="NAME=WEIGHTS", help="a further network")
    options = parser.parse_args()
    if options.what == "make":
        make(options.out, options.scenes, FIRST_REPORTED_SEED if options.reported else 0)
    else:
        score(options.out, options.results, dict(text.split("=", 1) for text in options.also))


if __name__ == "__main__":
    main()
