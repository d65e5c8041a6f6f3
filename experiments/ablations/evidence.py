"""What does each term that scores built candidates bring to `mst`?

    python experiments/ablations/evidence.py [--minutes 25] [--smoke] [--out FOLDER]

Every arm is `mst` with other `update.evidence`; `remains` is `mst` with a step after the update that clears the
pieces of objects that lie apart from the rest and that the last frame does not show. Tuning scenes, one filter seed,
the primary endpoint: mean over pauses t >= 1 of the mean quality (form objects) of the hypotheses, against `mst`
scene by scene. Scenes are begun while there is time; runs that are in the table already are not repeated, and where
support scores all candidates of a run alike, the run without it is the same run.
Writes results/runs.csv (a row a scene and arm) and results/evidence.csv (a row an arm).
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from mstfilter.presets import build_filter, load_config
from mstfilter.scene.evidence import Evidence
from mstfilter.scene.frame_geometry import frame_geometry
from mstfilter.scene.quality import weighted_coverage
from mstfilter.scene.recording import Recording
from mstfilter.scene.voxels import Hypothesis
from mstfilter.simulation.cache import cached_recording
from mstfilter.smc.interfaces import Update
from mstfilter.smc.population import Population
from mstfilter.study.statistics import adjusted, compare, said

SCENES = [f"{family}-{seed}" for family, n in (("s1", 6), ("table", 4), ("s2", 4)) for seed in range(n)]
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
ARMS = {
    "+support": ["agreement", "support"],
    "mst": ["agreement"],
    "+depth +support": ["agreement", "depth", "support"],
    "+depth": ["agreement", "depth"],
    "+motions": ["agreement", "motions"],
    "+boundaries": ["agreement", "boundaries"],
    "-agreement": [],
    "remains": ["agreement"],
}
WITHOUT_SUPPORT = {"+support": "mst", "+depth +support": "+depth"}


@dataclass(frozen=True)
class Heard(Evidence):
    """A term, and whether it ever told candidates apart."""

    inner: Evidence
    spread: list[float] = field(default_factory=list)

    def log_score(self, hypotheses, clip):
        """As `inner`."""
        scores = self.inner.log_score(hypotheses, clip)
        self.spread.append(float(np.ptp(scores)))
        return scores


def remains(hypothesis: Hypothesis, clip) -> np.ndarray:
    """(X, Y, Z) bool: pieces of an object, its largest apart, without a voxel at the surface that the frame shows."""
    from scipy.ndimage import find_objects, label

    with np.errstate(invalid="ignore"):
        seen = np.abs(frame_geometry(clip.after, clip.grid).signed) < 1.5 * clip.grid.voxel_size
    found = np.zeros(hypothesis.labels.shape, bool)
    for k, box in enumerate(find_objects(hypothesis.labels.astype(np.int32)), start=1):
        if box is None:
            continue
        pieces, n = label(hypothesis.labels[box] == k, np.ones((3, 3, 3)))
        if n > 1:
            sizes = np.bincount(pieces.ravel(), minlength=n + 1)
            known = np.bincount(pieces[seen[box]], minlength=n + 1)
            gone = [p for p in range(1, n + 1) if p != 1 + sizes[1:].argmax() and known[p] == 0]
            found[box] |= np.isin(pieces, gone)
    return found


@dataclass(frozen=True)
class WithoutRemains(Update):
    """An update, and then `remains` cleared from its scored candidates."""

    inner: Update

    properly_weighted: ClassVar[bool] = False

    def update(self, rng, predicted, proposed, observation):
        """As `inner`, but for the remains; proposed samples that pass alone are left as they are."""
        fused = self.inner.update(rng, predicted, proposed, observation)
        if predicted is None:
            return fused
        kept = tuple(h.with_labels(np.where(remains(h, observation), 0, h.labels)) for h in fused.particles)
        return Population(kept, fused.log_weights, fused.parents, fused.notes)


def endpoint(arm: str, recording: Recording) -> tuple[float, bool]:
    """Mean quality after the first pause, and whether the last term told any candidates apart."""
    terms = ", ".join(f'"{term}"' for term in ARMS[arm])
    mst = build_filter(load_config("mst", [f"update.evidence=[{terms}]"]))
    heard = [Heard(term) for term in mst.update.evidence[-1:]]
    mst = replace(mst, update=replace(mst.update, evidence=(*mst.update.evidence[:-1], *heard)))
    if arm == "remains":
        mst = replace(mst, update=WithoutRemains(mst.update))
    state, quality = mst.start(0), []
    for clip in recording.clips():
        state, _ = mst.step(state, clip)
        if clip.index:
            truth = recording.truth(clip.index)
            quality.append(np.mean([weighted_coverage(h.labels, truth) for h in state.population.particles]))
    return float(np.mean(quality)), bool(heard) and any(heard[-1].spread)


def main(out: Path, smoke: bool, minutes: float) -> None:
    """Run what is not there yet, then compare."""
    out.mkdir(parents=True, exist_ok=True)
    file, begun = out / "runs.csv", time.monotonic()
    found: dict[tuple[str, str], float] = {}
    if file.exists():
        with file.open(newline="") as lines:
            found = {(r["arm"], r["scene"]): float(r["quality"]) for r in csv.DictReader(lines)}
    for scene in SCENES[:1] if smoke else SCENES:
        if time.monotonic() - begun > 60 * minutes:
            break
        family, _, seed = scene.partition("-")
        recording = Recording.open(cached_recording(family, int(seed), **(SMALL if smoke else {})))
        for arm in ARMS:
            if (arm, scene) in found:
                continue
            start = time.process_time()
            found[arm, scene], told = endpoint(arm, recording)
            without = WITHOUT_SUPPORT.get(arm)
            if without and not told:
                found.setdefault((without, scene), found[arm, scene])
            print(
                f"{scene:10} {arm:16} {found[arm, scene]:.4f} {told!s:5} {time.process_time() - start:.1f} s",
                flush=True,
            )
            with file.open("w", newline="") as lines:
                writer = csv.writer(lines, lineterminator="\n")
                writer.writerow(["scene", "arm", "quality"])
                writer.writerows([s, a, round(q, 5)] for (a, s), q in found.items())
    scenes = [s for s in SCENES if all((arm, s) in found for arm in ARMS)]
    own = {arm: {s: found[arm, s] for s in scenes} for arm in ARMS}
    others = [arm for arm in ARMS if arm != "mst"]
    differences = adjusted([compare(own[arm], own["mst"]) for arm in others])
    with (out / "evidence.csv").open("w", newline="") as lines:
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerow(["arm", "n", "quality", "difference to mst", "low", "high", "p", "says"])
        writer.writerow(["mst", len(scenes), round(np.mean(list(own["mst"].values())), 4), *[""] * 5])
        for arm, d in zip(others, differences, strict=True):
            figures = [round(v, 4) for v in (np.mean(list(own[arm].values())), d.mean, d.low, d.high, d.p)]
            writer.writerow([arm, d.n, *figures, said(d, arm, "mst")])
            print(arm, d.n, *figures)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--minutes", type=float, default=25.0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    main(arguments.out, arguments.smoke, arguments.minutes)
