"""How good are the methods on real images?

    python experiments/real/run.py                        # all sequences; finished ones are not run again
    python experiments/real/run.py --only mix_1,jack --methods mst,samples_only --out DIR --sheets DIR
    python experiments/real/run.py --smoke --out DIR      # one pause

Needs the data in MSTFILTER_SHARED (default ../shared) under real/. Writes pauses.csv (scores of the one answer, and
means over the hypotheses, at each pause), forecasts.csv (of "do two pixels show one object?", counted by sequence),
sequences.csv (means over pauses), and summary.csv (`mst` minus each method, paired by sequence). With --sheets, the
worst pauses of `mst` are drawn into a folder outside of the repository, since the images are not ours.

A method with one answer is always certain, which costs log loss wherever the answer is wrong. A constant doubt could
gain as much as hypotheses. So `recalibrated_log_loss` is that of forecasts that isotonic regression corrects, fitted
to all other sequences, of every method alike.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from folds import JUDGES, border_model
from scores import identities, image_scores, kept, pixel_forecasts, witness_scores
from sequences import SHARED, Sequence, sequences

from mstfilter import Belief
from mstfilter.base.files import read_csv, write_csv
from mstfilter.mst.segmentation import BorderTree, SeamTree
from mstfilter.runs.presets import preset
from mstfilter.scene import Camera, Clip, Hypothesis, outlined, project
from mstfilter.scoring.forecasts import SOFTENING, ForecastTable, Recalibration
from mstfilter.scoring.log_loss import LOG_LOSS
from mstfilter.scoring.statistics import compare
from mstfilter.smc import Population, State

HERE = Path(__file__).resolve().parent

CONSTANTS = HERE.parent / "osd_frames" / "results" / "constants.csv"
#: Name -> preset and changes. `no past` starts again at every pause.
METHODS: dict[str, tuple[str, ...]] = {
    "mst": ("mst",),
    "mst, no past": ("mst",),
    "seams": ("mst", "proposal.tree=seams"),
    "samples_only": ("samples_only",),
    "single_frame": ("single_frame",),
    "union": ("union",),
    "crossover": ("mst_rules", "proposal.completer=network"),
    "paper": ("paper",),
    "authors": ("authors",),
    "floor_image": ("floor_image",),
    "floor_components": ("floor_components",),
    "floor_one_blob": ("floor_one_blob",),
}
#: What is summarised: quality of the one answer, mean quality of the hypotheses, and log loss of all that is known.
MEASURES = ("quality_answer", "quality", "log_loss", LOG_LOSS, f"{LOG_LOSS}_kept", f"{LOG_LOSS}_answer")
#: What forecasts are of, with the ending of its columns: all that a method knows, the hypotheses that it keeps, and
#: its one answer.
FORECASTS = {"all": "", "kept": "_kept", "answer": "_answer"}
_WORST = 12  # pauses on a contact sheet


def held_out(sequence: Sequence, method: str, by_sequence: bool) -> list[str]:
    """Changes to a method that was fitted to the frames of a sequence: what was fitted without its camera set-up.

    On frames of OSD, constants of the segmentation that were chosen on the other camera set-ups replace the defaults.
    On frames of OSD and HOTS, the border model has the correction that was fitted without the camera set-up. With
    `by_sequence`, the correction for a sequence of HOTS was fitted with the other sequences of the same camera.
    The judge of seams is the one that was trained without the images of the source.
    """
    if sequence.source not in ("osd", "hots") or method.startswith("floor"):
        return []
    changes = []
    tree, border = preset(*METHODS[method]).proposal.tree, border_model(sequence.name, by_sequence)
    if isinstance(tree, BorderTree):
        changes = [f"proposal.tree.weights={border}"]
    elif isinstance(tree, SeamTree):
        changes = [f"proposal.tree.base.weights={border}", f"proposal.tree.weights={JUDGES[sequence.source]}"]
    if sequence.source == "hots":
        return changes
    row = next(r for r in read_csv(CONSTANTS) if r["frames"] == sequence.name)
    contour = method in ("paper", "authors")
    weight = row["colour_weight" if contour else "colour_weight_learned"]
    changes += ["proposal.boundary.component=colour_depth", f"proposal.boundary.colour_weight={weight}"]
    return changes + [f"proposal.tree.{field}={row[field]}" for field in ("centre", "slope") if contour]


def run(
    sequence: Sequence, methods: list[str], seed: int, last: int | None, by_sequence: bool
) -> Iterator[tuple[dict[str, object], dict[str, ForecastTable]]]:
    """For each pause and method, a row of scores, and forecasts."""
    filters = {name: preset(*METHODS[name], *held_out(sequence, name, by_sequence)) for name in methods}
    states: dict[str, State] = {name: f.start(seed) for name, f in filters.items()}
    histories: dict[str, list[list[dict[str, int]]]] = defaultdict(list)  # of each hypothesis and its ancestors
    for clip in sequence.recording.clips()[:last]:
        truth = sequence.truth(clip.index)
        for name, f in filters.items():  # all methods process a pause before the next one: they share cached work
            own = Clip((clip.after,), clip.grid, 0) if name == "mst, no past" else clip
            start = f.start(seed) if name == "mst, no past" else states[name]
            began = time.process_time()
            states[name], info = f.step(start, own)
            seconds = time.process_time() - began
            particles = states[name].population.particles
            images = [project(h, clip.after.camera) for h in particles]
            rows = [image_scores(image, truth, clip.after, clip.grid) for image in images]
            for row, h in zip(rows, particles, strict=True):
                cut = image_scores(outlined(h, clip.after), truth, clip.after, clip.grid)
                row["quality_outlined"] = cut["quality"]
            if sequence.witness is not None:
                pairs = zip(rows, particles, strict=True)
                rows = [row | witness_scores(h, clip.after, sequence.witness(clip.index)) for row, h in pairs]
            parents = states[name].population.parents.get("previous", np.full(len(particles), -1))
            named = (identities(i, h, truth) for i, h in zip(images, particles, strict=True))
            before = histories[name]
            histories[name] = [
                [*(before[j] if before and j >= 0 else []), one] for j, one in zip(parents, named, strict=True)
            ]
            mean = {key: round(float(np.mean([row[key] for row in rows])), 4) for key in rows[0]}
            least = {"least_found": min(row["found"] for row in rows)}
            belief = Belief.of_step(states[name], info)
            answers = {"quality_answer": belief.estimate(), "quality_answer_kept": belief.kept.estimate()}
            mean |= {
                key: round(image_scores(project(h, clip.after.camera), truth, clip.after, clip.grid)["quality"], 4)
                for key, h in answers.items()
            }
            forecasts = forecasts_of(belief, clip.after.camera, truth.labels)
            losses = {
                f"log_loss{suffix}": round(forecasts[name].log_loss(SOFTENING), 4) if forecasts[name].n else ""
                for name, suffix in FORECASTS.items()
            }
            followed = _kept(histories[name])
            about = {"sequence": sequence.name, "source": sequence.source, "pause": clip.index, "method": name}
            yield about | mean | losses | least | followed | {"seconds": round(seconds, 2)}, forecasts


def forecasts_of(belief: Belief, camera: Camera, labels: np.ndarray) -> dict[str, ForecastTable]:
    """`pixel_forecasts` of what `FORECASTS` names; empty ones where fewer than two objects are marked."""
    if len(np.unique(labels[labels > 0])) < 2:
        return dict.fromkeys(FORECASTS, ForecastTable.of([], []))
    named = {"all": belief, "kept": belief.kept, "answer": Belief(Population([belief.estimate()]))}
    return {name: pixel_forecasts(one, camera, labels) for name, one in named.items()}


def forecast_rows(sequence: str, method: str, tables: list[dict[str, ForecastTable]]) -> list[dict[str, object]]:
    """The forecasts of a method in a sequence, counted over its pauses."""
    return [
        {"sequence": sequence, "method": method, "of": name, "p": f"{p:.2f}", "no": int(no), "yes": int(yes)}
        for name in FORECASTS
        for table in [ForecastTable.pooled([one[name] for one in tables])]
        for p, no, yes in zip(table.p, table.no, table.yes, strict=True)
    ]


def recalibrated(rows: list[dict[str, str]]) -> dict[tuple[str, str], dict[str, float]]:
    """Recalibrated log losses of each sequence and method that has forecasts in other sequences too."""
    groups: dict[tuple[str, str], dict[str, list[dict[str, str]]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        groups[row["method"], row["of"]][row["sequence"]].append(row)
    found: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    for (method, of), by_sequence in groups.items():
        tables = {
            name: ForecastTable(*(np.array([float(row[key]) for row in own]) for key in ("p", "no", "yes")))
            for name, own in by_sequence.items()
        }
        for name, table in tables.items():
            if others := [one for other, one in tables.items() if other != name]:
                loss = Recalibration.fit(ForecastTable.pooled(others)).log_loss(table)
                found[name, method][f"{LOG_LOSS}{FORECASTS[of]}"] = round(loss, 4)
    return found


def _kept(lineages: list[list[dict[str, int]]]) -> dict[str, int]:
    """Identities kept up to now in the hypothesis that kept most; `lineages` has those of it and its ancestors."""
    best = max((kept(line) for line in lineages), key=lambda found: found[0] / max(found[1], 1))
    return {"kept": best[0], "named": best[1]}


def sequence_means(rows: list[dict[str, str]]) -> list[dict[str, object]]:
    """Means over pauses, of each sequence and method; `kept` and `named` are those of the last pause."""
    groups: dict[tuple[str, str], list[dict[str, str]]] = defaultdict(list)
    for row in rows:
        groups[row["sequence"], row["method"]].append(row)
    found = []
    for (name, method), own in groups.items():
        numbers = [k for k in own[0] if k not in ("sequence", "source", "pause", "method", "kept", "named")]
        means = {
            k: round(float(np.mean([float(r[k]) for r in own if r[k] != ""])), 4) for k in numbers if own[0][k] != ""
        }
        last = max(own, key=lambda r: int(r["pause"]))
        about = {"sequence": name, "source": own[0]["source"], "method": method, "pauses": len(own)}
        found.append(about | means | {k: last[k] for k in ("kept", "named")})
    return found


def summary(means: list[dict[str, object]]) -> list[dict[str, object]]:
    """Means over the sequences of each source and over those with labels, and `mst` minus each method.

    A row for each of `MEASURES`: the quality of the one answer and the log loss count.
    """
    table: dict[tuple[str, str], dict[str, dict[str, float]]] = defaultdict(lambda: defaultdict(dict))
    for row in means:
        for group in (row["source"], "labelled") if row["source"] in ("hots", "osd") else (row["source"],):
            for measure in MEASURES:
                if (value := row.get(measure)) not in (None, ""):
                    values = table[str(group), measure][str(row["method"])]
                    values[str(row["sequence"])] = float(str(value))
    rows = []
    for (group, measure), methods in table.items():
        for method, values in methods.items():
            row = {"source": group, "measure": measure, "method": method, "sequences": len(values)}
            row["mean"] = round(float(np.mean(list(values.values()))), 4)
            if method != "mst" and "mst" in methods and len(values) > 1:
                d = compare(methods["mst"], values)
                row |= {"mst_minus": round(d.mean, 4), "low": round(d.low, 4), "high": round(d.high, 4)}
            rows.append(row)
    return rows


def overlay(rgb: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Objects of a label image (H, W) in colour over an image (H, W, 3)."""
    colours = np.random.default_rng(5).integers(40, 255, (int(image.max()) + 1, 3))
    colours[0] = 0
    mixed = np.where((image > 0)[..., None], 0.5 * rgb + 0.5 * colours[image], 0.8 * rgb).astype(np.uint8)
    edges = cv2.morphologyEx(image.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0
    mixed[edges & (image > 0)] = 255
    return mixed


def sheet(sequence: Sequence, seed: int, pauses: list[int], out: Path) -> None:
    """Truth, and the first hypotheses of `mst`, at some pauses."""
    lines = []
    for state, info in preset("mst").iterate(sequence.recording.clips()[: max(pauses) + 1], seed):
        if info.t in pauses:
            frame = sequence.recording.clips()[info.t].after
            shown: tuple[Hypothesis, ...] = tuple(state.population.particles[:3])
            images = [np.maximum(sequence.truth(info.t).labels, 0), *(project(h, frame.camera) for h in shown)]
            lines.append(np.hstack([cv2.resize(overlay(frame.rgb, i.astype(np.int64)), (480, 360)) for i in images]))
    cv2.imwrite(str(out / f"{sequence.name}.jpg"), cv2.cvtColor(np.vstack(lines), cv2.COLOR_RGB2BGR))


def main() -> None:
    """Run the missing sequences and methods, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="one pause; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--only", default="", help="names of sequences or sources, separated by commas")
    parser.add_argument("--methods", default=",".join(METHODS).replace("mst, no past", "no past"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--by-sequence", action="store_true", help="for HOTS, fit with its other sequences")
    parser.add_argument("--sheets", type=Path, help="draw the worst pauses of `mst` into this folder")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    cv2.setNumThreads(1)
    methods = [{"no past": "mst, no past"}.get(name, name) for name in options.methods.split(",")]
    if options.smoke:
        options.only, methods = "learn0-1", ["mst", "floor_image"]
    options.out.mkdir(parents=True, exist_ok=True)
    path, forecast_path = options.out / "pauses.csv", options.out / "forecasts.csv"
    rows: list[dict] = read_csv(path) if path.exists() else []
    finished = {(row["sequence"], row["method"]) for row in rows}
    forecasts: list[dict] = read_csv(forecast_path) if forecast_path.exists() else []
    forecasts = [row for row in forecasts if (row["sequence"], row["method"]) in finished]
    wanted = options.only.split(",") if options.only else []
    for sequence in sequences(SHARED):
        if wanted and not {sequence.name, sequence.source} & set(wanted):
            continue
        done = {row["method"] for row in rows if row["sequence"] == sequence.name}
        missing = [name for name in methods if name not in done]
        last = 1 if options.smoke else None
        found = list(run(sequence, missing, options.seed, last, options.by_sequence))
        rows += [row for row, _ in found]
        for name in missing:
            tables = [of_pause for row, of_pause in found if row["method"] == name]
            forecasts += forecast_rows(sequence.name, name, tables)
        write_csv(forecast_path, [{key: str(value) for key, value in row.items()} for row in forecasts])
        columns = dict.fromkeys(key for row in rows for key in row)
        rows = [{key: str(row.get(key, "")) for key in columns} for row in rows]
        write_csv(path, rows)
        own = [row for row in rows if row["sequence"] == sequence.name and row["method"] == "mst"]
        print(sequence.name, f"mst {np.mean([float(row['quality']) for row in own]):.3f}" if own else "", flush=True)
        if options.sheets:
            options.sheets.mkdir(parents=True, exist_ok=True)
            worst = sorted(own, key=lambda row: float(row["quality"]))[:_WORST]
            sheet(sequence, options.seed, [int(row["pause"]) for row in worst], options.sheets)
    losses = recalibrated(forecasts)
    means = [row | losses.get((str(row["sequence"]), str(row["method"])), {}) for row in sequence_means(rows)]
    write_csv(options.out / "sequences.csv", means, list(dict.fromkeys(key for row in means for key in row)))
    table = summary(means)
    write_csv(options.out / "summary.csv", table, list(dict.fromkeys(key for row in table for key in row)))
    for row in table:
        print("  ".join(f"{value!s:>16}" for value in row.values()))


if __name__ == "__main__":
    main()
