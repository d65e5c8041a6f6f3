"""Do the terms know good candidates, and do the remains of objects spoil them?

    python experiments/ablations/candidates.py [--kept FOLDER] [--smoke] [--out FOLDER]

The scored candidates of `mst` (20 a pause) on tuning scenes, with their true quality.

- A term: the spread of its scores among the candidates of a pause, their correlation with quality, and the quality
  that is expected to be gained by weighting the candidates with it, alone and on top of agreement; by how much it
  prefers the truth to the best of them, at least. "best" always takes the candidate of best quality. This is one
  step: what a better choice brings to later pauses is not in it.
- Pieces of an object that lie apart from its largest one: those that the last frame does not show, and of these
  those that nothing carries. How many voxels, how many of them are occupied in truth, and what clearing them does to
  the quality of a candidate.

Intervals are over scenes. Writes results/terms.csv and results/pieces.csv; candidates are kept in FOLDER, if one is
given, and found there again.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import find_objects, label

import mstfilter
from mstfilter.formats import open_recording
from mstfilter.fusion import Agreement, DepthAgreement, Support, stands
from mstfilter.scene import Clip, Evidence, Hypothesis, frame_geometry
from mstfilter.scoring import weighted_coverage
from mstfilter.simulation import cached_recording
from mstfilter.study import interval

SCENES = ("s1-6", "s1-7", "s1-8", "s1-9", "s2-4", "s2-5", "s2-6")
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
TERMS: dict[str, Evidence] = {"agreement": Agreement(), "depth": DepthAgreement(), "support": Support()}


@dataclass(frozen=True)
class Keep(Evidence):
    """Says nothing and keeps what it is asked about."""

    kept: dict[str, np.ndarray] = field(default_factory=dict)

    def log_score(self, hypotheses, clip):
        """Zeros."""
        self.kept[f"c{clip.index}"] = np.array([h.labels for h in hypotheses])
        return np.zeros(len(hypotheses))


def candidates(scene: str, smoke: bool, kept: Path | None) -> Iterator[tuple[Clip, list[Hypothesis], np.ndarray]]:
    """Clip, scored candidates and true labels of every pause after the first."""
    family, _, seed = scene.partition("-")
    recording = open_recording(cached_recording(family, int(seed), **(SMALL if smoke else {})))
    clips, file = list(recording.clips()), kept / f"{scene}.npz" if kept else None
    if file and file.exists():
        found = dict(np.load(file))
    else:
        keep, mst = Keep(), mstfilter.preset("mst")
        mst = replace(mst, update=replace(mst.update, evidence=(*mst.update.evidence, keep)))
        mst.run(clips, seed=0)
        found = keep.kept
        if file:
            np.savez_compressed(file, **found)
    for clip in clips[1:]:
        grids = found[f"c{clip.index}"].astype(np.uint16)
        yield clip, [Hypothesis.from_labels(g, clip.grid) for g in grids], recording.truth(clip.index)


def weighted(log_weights: np.ndarray, values: np.ndarray) -> float:
    """Mean of values by weights."""
    w = np.exp(log_weights - log_weights.max())
    return float(w @ values / w.sum())


def pieces(hypothesis: Hypothesis, clip: Clip) -> dict[str, np.ndarray]:
    """(X, Y, Z) bool by rule: pieces apart that are not seen; those of them that nothing carries."""
    with np.errstate(invalid="ignore"):
        seen = np.abs(frame_geometry(clip.after, clip.grid).signed) < 1.5 * clip.grid.voxel_size
    whole, n_all, apart = np.zeros(hypothesis.labels.shape, np.uint16), 0, []
    for k, box in enumerate(find_objects(hypothesis.labels.astype(np.int32)), start=1):
        if box is not None:
            parts, n = label(hypothesis.labels[box] == k, np.ones((3, 3, 3)))
            whole[box][parts > 0] = parts[parts > 0] + n_all
            largest = n_all + int(np.bincount(parts.ravel())[1:].argmax()) + 1
            apart += [p for p in range(n_all + 1, n_all + n + 1) if p != largest]
            n_all += n
    unseen = [p for p in apart if not seen[whole == p].any()]
    stand = stands(Hypothesis.from_labels(whole, hypothesis.grid)) if unseen else {}
    loose = [p for p in unseen if stand[p].gap > 0]
    return {"not seen": np.isin(whole, unseen), "not seen, not carried": np.isin(whole, loose)}


def summary(values: list[tuple[str, float]]) -> list[float]:
    """Mean over scenes, and its interval."""
    by_scene = defaultdict(list)
    for scene, value in values:
        by_scene[scene].append(value)
    means = np.array([np.mean(v) for v in by_scene.values()])
    return [round(float(v), 5) for v in (means.mean(), *interval(means))]


def main(out: Path, smoke: bool, kept: Path | None) -> None:
    """All scenes; two tables."""
    spread, alone, upon, fits = (defaultdict(list) for _ in range(4))
    found, ahead = defaultdict(list), defaultdict(list)
    for scene in SCENES[:1] if smoke else SCENES:
        for clip, hypotheses, truth in candidates(scene, smoke, kept):
            quality = np.array([weighted_coverage(h.labels, truth) for h in hypotheses])
            scores = {name: term.log_score(hypotheses, clip) for name, term in TERMS.items()}
            scores["best"] = 1e4 * quality
            right = Hypothesis.from_labels(truth.astype(np.uint16), clip.grid)
            for name in ("depth", "support"):
                ahead[name].append(float(TERMS[name].log_score([right], clip)[0] - scores[name].max()))
            for name, score in scores.items():
                spread[name].append((scene, float(score.std())))
                alone[name].append((scene, weighted(score, quality) - quality.mean()))
                if name != "agreement":
                    both = weighted(score + scores["agreement"], quality)
                    upon[name].append((scene, both - weighted(scores["agreement"], quality)))
                if min(score.std(), quality.std()) > 1e-9:
                    fits[name].append(float(np.corrcoef(score, quality)[0, 1]))
            for h in hypotheses[::4]:
                for rule, where in pieces(h, clip).items():
                    cleared = weighted_coverage(np.where(where, 0, h.labels), truth)
                    change = cleared - weighted_coverage(h.labels, truth)
                    found[rule].append((scene, int(where.sum()), int((where & (truth > 0)).sum()), change))
        print(scene, flush=True)
    out.mkdir(parents=True, exist_ok=True)
    with (out / "terms.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        gains = [f"{gain} {what}" for gain in ("alone", "upon agreement") for what in ("gain", "low", "high")]
        writer.writerow(
            ["term", "scenes", "pauses", "spread (nats)", "pauses told apart", "correlation", *gains, "truth ahead"]
        )
        for name in (*TERMS, "best"):
            n, r = len({s for s, _ in spread[name]}), fits[name]
            row = [
                name,
                n,
                len(spread[name]),
                "" if name == "best" else summary(spread[name])[0],
                len(r),
                round(np.mean(r), 3) if r else "",
            ]
            row += [*summary(alone[name]), *(summary(upon[name]) if upon[name] else ["", "", ""])]
            row.append(round(min(ahead[name]), 2) if ahead[name] else "")
            writer.writerow(row)
            print(*row)
    with (out / "pieces.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(
            ["pieces", "scenes", "candidates", "have any", "voxels", "occupied in truth", "gain", "low", "high"]
        )
        for rule, rows in found.items():
            voxels, right = (np.array([r[k] for r in rows]) for k in (1, 2))
            share = round(right.sum() / voxels.sum(), 3) if voxels.any() else ""
            row = [rule, len({r[0] for r in rows}), len(rows), round(np.mean(voxels > 0), 3), round(voxels.mean(), 2)]
            row += [share, *summary([(r[0], r[3]) for r in rows])]
            writer.writerow(row)
            print(*row)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--kept", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    main(arguments.out, arguments.smoke, arguments.kept)
