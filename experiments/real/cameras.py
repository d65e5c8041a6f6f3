"""How good is `mst` on single images of cameras other than the Xtion of the other real data?

Constants were set by eye on some of these images (see README.md), so the figures are not held out.

    python experiments/real/cameras.py                        # a few minutes of one core
    python experiments/real/cameras.py --only uoc_4,camera1 --sheets DIR --out FILE
    python experiments/real/cameras.py --tables               # only: which plane is taken for the table?

Reads `other_cameras` (single images, with a marked pixel on every object) and `two_cameras` (each camera as a
recording of its own, without poses). A refused recording finds nothing. Writes results/cameras.csv, one row for each
recording:

- `found`: different objects that cover a marked pixel, so two true objects in one estimate count once;
- `estimated`: objects in the projected label image; both are means over the hypotheses and the pauses;
- `noise`: 98th percentile of the distances of readings below the table, in the unit of its tolerance, where nothing
  is.

With --tables, every image of `real` is opened alone and without pose. The table that is found is compared with the
one of the given pose, if there is one. With --sheets, the images are drawn into a folder outside of the repository.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from run import overlay
from scipy.spatial.transform import RigidTransform
from sequences import POINTS, SHARED

from mstfilter.base.errors import InputError
from mstfilter.base.files import write_csv
from mstfilter.formats import PairedImages
from mstfilter.runs.presets import preset
from mstfilter.scene import Frame, Recording, above_table, posed_camera, project

HERE = Path(__file__).resolve().parent
PAUSES = ("v000", "v004")  #: of `two_cameras`
_SAME_TABLE = 0.05, 3.0  # metres and degrees between two tables that are the same
_DEEPEST = 12.0  # sensor units: readings farther below are of other things


@dataclass(frozen=True)
class Case:
    """A recording without poses, and the marked pixels (u, v) of the objects at its pauses."""

    name: str
    folder: Path
    frames: tuple[str, ...]
    n_objects: tuple[int, ...]
    points: tuple[tuple[tuple[int, int], ...], ...]  #: of each pause; empty where none are marked

    def open(self) -> Recording:
        """The recording. Raises InputError if it is refused."""
        recording = PairedImages(frames=self.frames).open(self.folder)
        recording.check()
        return recording


def cases(folder: Path) -> Iterator[Case]:
    """The recordings of `other_cameras` and `two_cameras`."""
    for path in sorted((folder / "other_cameras").glob("*/info.json")):
        marked = json.loads(path.read_text())["frames"]
        points = tuple(tuple((u, v) for u, v in frame["points"].values()) for frame in marked)
        names, counts = tuple(f["name"] for f in marked), tuple(f["n_objects"] for f in marked)
        yield Case(path.parent.name, path.parent, names, counts, points)
    for camera in ("camera1", "camera2"):
        first = camera == "camera1"
        points = tuple(tuple(of[int(p[1:])] for of in POINTS.values()) if first else () for p in PAUSES)
        yield Case(camera, folder / "two_cameras" / camera, PAUSES, (len(POINTS),) * len(PAUSES), points)


def noise_below(frame: Frame) -> float:
    """98th percentile of the distances of the readings below the table, in sensor units."""
    with np.errstate(invalid="ignore"):
        below = -above_table(frame)[frame.valid]
    below = below[(below > 0) & (below < _DEEPEST)]
    return float(np.percentile(below, 98)) if len(below) else np.nan


def run(case: Case, seed: int, sheets: Path | None) -> dict[str, object]:
    """The row of a recording."""
    row: dict[str, object] = {"recording": case.name, "true": sum(case.n_objects) / len(case.n_objects)}
    row |= {"marked": len(case.points[0]), "refused": "", "found": 0.0, "estimated": "", "noise": ""}
    try:
        clips = case.open().clips()
    except InputError as error:
        return row | {"refused": str(error).splitlines()[0]}
    found, estimated = [], []
    for (state, info), clip, points in zip(preset("mst").iterate(clips, seed), clips, case.points, strict=True):
        assert state.population is not None
        images = [project(h, clip.after.camera) for h in state.population.particles]
        found += [len({int(image[v, u]) for u, v in points} - {0}) for image in images]
        estimated += [len(np.unique(image[image > 0])) for image in images]
        if sheets is not None:
            drawn = np.hstack([clip.after.rgb, overlay(clip.after.rgb, images[0].astype(np.int64))])
            cv2.imwrite(str(sheets / f"{case.name}_{info.t}.png"), drawn[..., ::-1])
    row |= {"found": round(float(np.mean(found)), 2), "estimated": round(float(np.mean(estimated)), 2)}
    return row | {"noise": round(float(np.mean([noise_below(clip.after) for clip in clips])), 2)}


def tables(folder: Path) -> Iterator[dict[str, object]]:
    """For every image of `real` alone and without pose: is it refused, and is the table that of the given pose?"""
    poses = json.loads((folder / "two_cameras" / "poses.json").read_text())
    known = {f"camera{k}": RigidTransform.from_matrix(poses[f"T_world_camera{k}"]) for k in (1, 2)}
    for path in sorted(folder.glob("**/info.json")):
        for rgb in sorted(path.parent.glob("*_rgb.png")):
            name = rgb.name.removesuffix("_rgb.png")
            row: dict[str, object] = {"image": f"{path.parent.name}/{name}", "refused": "", "height": "", "tilt": ""}
            try:
                recording = PairedImages(frames=(name,)).open(path.parent)
                recording.check()
            except InputError as error:
                yield row | {"refused": str(error).splitlines()[0]}
                continue
            yield row | _difference(posed_camera(recording.frames[0]).pose, known.get(path.parent.name))


def _difference(found: RigidTransform, true: RigidTransform | None) -> dict[str, object]:
    """Height of the camera (m) above the found table, and tilt (degrees) and height (m) relative to the true one."""
    row: dict[str, object] = {"height": round(float(found.translation[2]), 3)}
    if true is None:
        return row
    up, expected = (pose.rotation.inv().apply([0.0, 0.0, 1.0]) for pose in (found, true))
    tilt = float(np.degrees(np.arccos(np.clip(up @ expected, -1, 1))))
    higher = abs(float(found.translation[2] - true.translation[2]))
    return row | {"tilt": round(tilt, 2), "wrong": higher > _SAME_TABLE[0] or tilt > _SAME_TABLE[1]}


def main() -> None:
    """Run the recordings, print their rows and the sums."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "cameras.csv")
    parser.add_argument("--only", default="", help="names of recordings, separated by commas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tables", action="store_true", help="only open every image alone and without pose")
    parser.add_argument("--sheets", type=Path, help="draw the images into this folder")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.tables:
        for row in tables(SHARED):
            print(*row.values(), sep="\t", flush=True)
        return
    if options.sheets:
        options.sheets.mkdir(parents=True, exist_ok=True)
    rows = []
    for case in cases(SHARED):
        if not options.only or case.name in options.only.split(","):
            rows.append(run(case, options.seed, options.sheets))
            print(*rows[-1].values(), sep="\t", flush=True)
    for group in ("uoc", "camera"):
        own = [row for row in rows if str(row["recording"]).startswith(group)]
        ran = [row for row in own if not row["refused"]]
        true, estimated = (sum(float(str(row[key])) for row in ran) for key in ("true", "estimated"))
        found, marked = (sum(float(str(row[key])) for row in own) for key in ("found", "marked"))
        print(
            f"{group}: {len(own) - len(ran)} of {len(own)} refused, {found:.1f} of {marked:.0f} marked objects found,"
        )
        print(f"  {estimated:.1f} objects estimated for {true:.0f}: {estimated / max(true, 1):.2f} times")
    write_csv(options.out, rows)


if __name__ == "__main__":
    main()
