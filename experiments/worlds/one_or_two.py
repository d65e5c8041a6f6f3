"""One object or several? What the samples of an image say about groups of objects that touch.

    python experiments/worlds/one_or_two.py [--presets mst,single_frame] [--seeds 0-79] [--out FOLDER] [PATH=VALUE]...
    python experiments/worlds/one_or_two.py --out /tmp/mine proposal.tree.weights=my_tree
    python experiments/worlds/one_or_two.py --out /tmp/mine 'proposal.prior={share}'    # a field that gets the share

Only the first pause of each scene is simulated, and the recordings stay in the cache. The seeds are dealt to the
shares of "one" in turn. A *question* is a group of `row` or `stack` of which at least two parts are visible. Its
*forecast* is the weight of the candidates of the first pause in which all visible parts have one object. The object
of a part is that of most of its readings. The candidates and their weights are those of the update, so a resampler
has no influence. The shapes of the objects do not matter either, so the proposal does not complete them.

A *reading of the group* is present if one candidate contains it: "one" is an object whose readings overlap with those
of all visible parts by more than .8 (intersection over union), "several" has such an object for every visible part.

one_or_two.csv: for each preset and share, and for all shares: number of questions, mean forecast, frequency of "one",
difference and its standard error over scenes, mean forecast where the truth is "one" and where it is "several",
calibration error in bins of equal size, log loss (forecasts are softened by .02), log loss of the constant forecast
that is the share, and the shares of questions in which a reading is present. Then the same by what the group looks
like: equal parts with one print over all, with the same print or with prints of their own, or different parts.
bins.csv: the reliability diagrams. groups.csv: every question.

Seeds up to 79 are for work. Later seeds are looked at once; --look says that this is meant.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mstfilter
from mstfilter.base.errors import InputError
from mstfilter.base.files import cache_folder, write_csv
from mstfilter.lab.simulation import cached_recording, part_image
from mstfilter.mst.partition.cells import Readings
from mstfilter.scene import Clip, Recording, foreground, scaled_area
from mstfilter.scoring.forecasts import SOFTENING, ForecastTable
from mstfilter.smc import ParticleFilter

FAMILIES, SHARES, PRESETS = "row,stack", ".3,.5,.7", "mst,single_frame"
LAST_SEED = 79  # of those to work on
OVERLAP = 0.8  # intersection over union from which a reading of the group is present
VISIBLE = 200  # readings of a visible part, in an image of 640 x 480 pixels
LOOKS = ("one print", "same print", "own prints", "different")


def candidates(filter: ParticleFilter, clip: Clip) -> tuple[Readings, np.ndarray, np.ndarray]:
    """The readings of the image, the object (n, m) of each in the candidates (0 for none), and the weights (n,)."""
    samples = filter.proposal.sample(np.random.default_rng(0), clip, filter.n_proposed)
    samples = replace(samples, parents={"proposed": np.arange(len(samples))})
    found = filter.update.update(np.random.default_rng(0), None, samples, clip)
    if "proposed" in found.parents:  # the partition of a candidate is that of its sample, and costs nothing
        hypotheses = [samples.particles[k] for k in found.parents["proposed"]]
    else:
        hypotheses = list(found.particles)
    readings = Readings.of(clip.after, clip.grid)
    raised = readings.of_image(foreground(clip.after, clip.grid).pixels)
    distinct = {id(h): h for h in hypotheses}
    labels = {key: np.where(raised, readings.labels(h.labels, 1.0), 0) for key, h in distinct.items()}
    return readings, np.stack([labels[id(h)] for h in hypotheses]), found.weights


def questions(recording: Recording, filter: ParticleFilter) -> Iterator[dict[str, Any]]:
    """The forecast of each group of a recording with at least two visible parts."""
    clip = next(iter(recording.clips()))
    readings, objects, weights = candidates(filter, clip)
    image, groups = part_image(recording, recording.pauses[0]), recording.manifest["groups"]
    parts = visible_parts(readings.of_image(image), groups, scaled_area(VISIBLE, image.size))
    for number, own in parts.items():
        group = groups[number]
        joined = np.array([is_one(row, own) for row in objects])
        yield {
            "group": number,
            "look": group["look"],
            "parts": len(own),
            "one": int(group["one"]),
            "forecast": round(float(np.clip(weights @ joined, 0, 1)), 4),
            "has_one": int(any(shows(row, [np.any(own, axis=0)]) for row in objects)),
            "has_several": int(any(shows(row, own) for row in objects)),
        }


def visible_parts(part: np.ndarray, groups: Sequence[Mapping[str, Any]], least: float) -> dict[int, list[np.ndarray]]:
    """The parts as masks (m,) bool of each group with at least two visible ones, from the part (m,) of each pixel.

    A part is visible if it has `least` pixels. Parts are numbered from 1, in the order of the groups.
    """
    found, last = {}, 0
    for number, group in enumerate(groups):
        first, last = last + 1, last + len(group["parts"])
        own = [part == k for k in range(first, last + 1)]
        own = [one for one in own if one.sum() >= least]
        if len(own) > 1:
            found[number] = own
    return found


def is_one(objects: np.ndarray, parts: Sequence[np.ndarray]) -> bool:
    """Whether most readings of each part have the same object, from objects (m,) and parts (m,) bool."""
    most = {int(np.bincount(objects[part]).argmax()) for part in parts}
    return len(most) == 1 and 0 not in most


def shows(objects: np.ndarray, regions: Sequence[np.ndarray]) -> bool:
    """Whether each region (m,) bool has an object with almost the same readings."""
    sizes = np.bincount(objects)
    for region in regions:
        shared = np.bincount(objects[region], minlength=len(sizes))
        overlap = shared / (sizes + region.sum() - shared)
        if len(overlap) < 2 or overlap[1:].max() <= OVERLAP:
            return False
    return True


def line(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Scores of some questions, one row of the table."""
    p, y = (np.array([row[name] for row in rows], float) for name in ("forecast", "one"))
    share = np.array([row["share"] for row in rows], float)
    table = ForecastTable.of(p, y)
    scene = np.unique([f"{row['family']} {row['share']} {row['seed']}" for row in rows], return_inverse=True)[1]
    residual = np.bincount(scene, p - y - (p - y).mean())
    both = [row["has_one"] and row["has_several"] for row in rows]
    found: dict[str, float] = {
        "forecast": p.mean(),
        "frequency": y.mean(),
        "difference": (p - y).mean(),
        "standard_error": np.sqrt((residual**2).sum()) / len(rows),
        "where_one": p[y == 1].mean() if (y == 1).any() else np.nan,
        "where_several": p[y == 0].mean() if (y == 0).any() else np.nan,
        "calibration_error": table.reliability(bins(len(rows))).error,
        "log_loss": table.log_loss(SOFTENING),
        "log_loss_of_share": ForecastTable.of(share, y).log_loss(),
        "both_readings": np.mean(both),
        "has_one": np.mean([row["has_one"] for row in rows]),
        "has_several": np.mean([row["has_several"] for row in rows]),
    }
    return {"questions": len(rows), **{name: round(float(value), 3) for name, value in found.items()}}


def bins(n: int) -> int:
    """Number of bins: five, or fewer if they would have fewer than ten questions."""
    return max(1, min(5, n // 10))


def tables(rows: Sequence[dict[str, Any]], out: Path) -> list[dict[str, Any]]:
    """Write one_or_two.csv and bins.csv."""
    summary, diagrams = [], []
    for preset in dict.fromkeys(row["preset"] for row in rows):
        own = [row for row in rows if row["preset"] == preset]
        chosen: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
        for family in ("all", *dict.fromkeys(row["family"] for row in rows)):
            of_family = [row for row in own if family in ("all", row["family"])]
            for share in ("all", *dict.fromkeys(row["share"] for row in rows)):
                chosen[family, str(share), "all"] = [row for row in of_family if share in ("all", row["share"])]
            for look in LOOKS:
                chosen[family, "all", look] = [row for row in of_family if row["look"] == look]
        for (family, share, look), these in chosen.items():
            if not these:
                continue
            about = {"preset": preset, "family": family, "share": share, "look": look}
            summary.append(about | line(these))
            if look == "all":
                p, y = (np.array([row[name] for row in these], float) for name in ("forecast", "one"))
                found = ForecastTable.of(p, y).reliability(bins(len(these)))
                for n, forecast, frequency in zip(found.count, found.forecast, found.frequency, strict=True):
                    values = {"forecast": round(float(forecast), 3), "frequency": round(float(frequency), 3)}
                    diagrams.append(about | {"questions": int(n)} | values)
    write_csv(out / "one_or_two.csv", summary)
    write_csv(out / "bins.csv", diagrams)
    return summary


def main() -> None:
    """Ask all questions, then write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "overrides", nargs="*", metavar="PATH=VALUE", help="changes to every preset; {share} is filled"
    )
    parser.add_argument("--presets", default=PRESETS)
    parser.add_argument("--families", default=FAMILIES)
    parser.add_argument("--shares", default=SHARES)
    parser.add_argument("--seeds", default=f"0-{LAST_SEED}", help="first-last; dealt to the shares in turn")
    parser.add_argument("--look", action="store_true", help="seeds beyond those to work on are meant")
    parser.add_argument("--recordings", type=Path, help="folder of the recordings; default: that of the cache")
    parser.add_argument("--smoke", action="store_true", help="three scenes of small images; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    first, last = (int(n) for n in (options.seeds.split("-") * 2)[:2])
    if options.smoke:
        first, last, options.families = 0, 2, "row"
    if last > LAST_SEED and not options.look:
        parser.error(f"seeds above {LAST_SEED} are looked at once, when the work on them is done: add --look")
    small: dict[str, Any] = {"width": 320, "height": 240} if options.smoke else {}
    shares = [float(share) for share in options.shares.split(",")]
    folder = options.recordings or cache_folder() / "recordings"
    filters = {
        (name, share): mstfilter.preset(
            name, "proposal.completer=surface", *(o.replace("{share}", f"{share:g}") for o in options.overrides)
        )
        for name in options.presets.split(",")
        for share in shares
    }
    rows: list[dict[str, Any]] = []
    seconds = 0.0
    for family in options.families.split(","):
        for seed in range(first, last + 1):
            share = shares[seed % len(shares)]
            try:
                path = cached_recording(family, seed, folder, n_actions=0, one_share=share, **small)
            except InputError as error:  # the objects of some seeds cannot be arranged
                print(family, seed, error, flush=True)
                continue
            recording, began = mstfilter.open_recording(path), time.process_time()
            for name in options.presets.split(","):
                about = {"preset": name, "family": family, "share": share, "seed": seed}
                rows += [about | row for row in questions(recording, filters[name, share])]
            seconds += time.process_time() - began
    options.out.mkdir(parents=True, exist_ok=True)
    write_csv(options.out / "groups.csv", rows)
    for row in tables(rows, options.out):
        if row["look"] == "all" and row["family"] == "all":
            print(*(f"{name} {value}" for name, value in row.items() if name not in ("look", "family")), sep=", ")
    print(f"{seconds / max(1, len({(r['family'], r['seed']) for r in rows})):.1f} s of processor time for each scene")


if __name__ == "__main__":
    main()
