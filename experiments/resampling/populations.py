"""Weighted candidates to resample: of the four models, of MST on real particles and on simulated scenes."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from schemes import Names, Table, schemes
from worlds import World, branching

import mstfilter
from mstfilter.errors import InputError
from mstfilter.fusion import Agreement, NoFreeSpace, SameSegmentation, WeightedCoverage
from mstfilter.presets import REGISTRY, load_config
from mstfilter.scene import Camera, Clip, Frame, Hypothesis, VoxelGrid
from mstfilter.scoring import weighted_coverage
from mstfilter.simulation import scene_family, simulate_recording
from mstfilter.smc import Population, Resampler, Systematic, WeightResampler


@dataclass(frozen=True, eq=False)
class Candidates:
    """m candidates: log weights (m,), similarities (m, m), classes of equals (m,), quality against the truth (m,)."""

    log_weights: np.ndarray
    similarity: np.ndarray
    classes: np.ndarray
    quality: np.ndarray | None = None

    @classmethod
    def of(cls, population: Population, similarity: Any, equivalence: Any, quality: Any = None) -> Candidates:
        """Look at the particles once."""
        found = population.realised()
        matrix = np.asarray(similarity.matrix(found.particles))
        scores = None if quality is None else np.array([quality(p) for p in found.particles])
        return cls(found.log_weights, (matrix + matrix.T) / 2, equivalence.classes(found.particles), scores)

    def resamplers(self) -> dict[str, Resampler]:
        """All schemes, on row numbers."""
        return schemes(Table(self.similarity), Names(self.classes))


class Catch(WeightResampler):
    """Systematic, and keeps the candidates that it saw last."""

    def __init__(self) -> None:
        self.seen: list[Population] = []

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> Any:
        """As systematic."""
        return Systematic().select(rng, log_weights, n)

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Keep, then select."""
        self.seen = [population]
        return super().resample(rng, population, n)


def of_world(world: World, n: int, seed: int) -> Candidates:
    """Candidates of the last step of the branching filter; where the run is lost, of the last before."""
    catch = Catch()
    with suppress(InputError):
        branching(world, catch, n).run(world.data(seed).observations, seed)
    return Candidates.of(catch.seen[0], world.similarity, world.equivalence)


def real(eta: int = 5) -> Candidates | None:
    """The 25 * eta candidates of the preset `authors` on the authors' real particles; None if these are missing."""
    named = os.environ.get("MSTFILTER_SHARED")
    shared = Path(named) if named else Path(__file__).resolve().parents[3] / "shared"
    folder = shared / "r1"
    if not folder.exists():
        return None
    measured, refined = (np.load(folder / f"{n}.npz") for n in ("measurement", "freespace_refined"))
    grid = VoxelGrid(measured["region_min"], 0.01, (61, 61, 41))
    samples = tuple(Hypothesis.from_labels(m, grid, 1) for m in measured["labels"][1, :5])
    predictions = tuple(Hypothesis.from_labels(m, grid) for m in refined["labels"][0])
    proposed = Population(samples, measured["weight"][1, :5], {"proposed": np.arange(5)})
    # There is no depth image. The quality Q of the projection came with the data and enters as log Q^3, by hand.
    update = REGISTRY.build(
        "update", load_config("authors", ["update.free_space=none", f"update.eta={eta}"])["update"]
    )
    update = replace(update, free_space=NoFreeSpace())
    log_weights = measured["weight"][0, :5] + update.quality_exponent * np.log(refined["weight"][0])
    predicted = Population(predictions, log_weights, {"previous": np.arange(5)})
    camera = Camera(np.array([[500.0, 0, 2], [0, 500.0, 2], [0, 0, 1]]), 4, 4)
    frame = Frame(np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.float32), camera)
    fused = update.update(np.random.default_rng(0), predicted, proposed, Clip((frame,), grid, 1))
    can = np.load(folder / "pseudo_truth.npz")["can_footprint"][1][:, :, None]

    def quality(candidate: Hypothesis) -> float:
        """Against a partition of the candidate's own voxels into can and carton, made for scoring."""
        return weighted_coverage(candidate.labels, np.where(candidate.labels > 0, np.where(can, 2, 1), 0))

    return Candidates.of(fused, WeightedCoverage(), SameSegmentation(), quality)


#: Filters whose candidates of simulated scenes are kept. `scored` is `mst` with more scored candidates.
SIMULATED = ("mst", "scored", "paper")


def simulated(seed: int, small: bool = False) -> dict[str, Candidates]:
    """Candidates of the last step of three filters on a simulated recording of the family `demo`, by filter.

    A small recording has two objects, one push and a quarter of the pixels, and gives 25 candidates or less.
    """
    family = scene_family("demo")
    if small:
        size = {"n_objects_min": 2, "n_objects_max": 2, "n_twins": 0, "n_actions": 1, "min_moved": 1}
        family = replace(family, **size, n_candidates=6, width=160, height=120, supersample=False)
    out = {}
    with tempfile.TemporaryDirectory() as folder:
        recording = simulate_recording(family, seed, Path(folder) / "recording")
        clips = recording.clips()
        truth = recording.truth(clips[-1].index)
        for name in SIMULATED:
            filter = mstfilter.preset("mst" if name == "scored" else name, *(["update.eta=1"] if small else []))
            if name == "scored":
                n_scored = 12 if small else 60
                filter = replace(filter, update=replace(filter.update, evidence=(Agreement(),), n_scored=n_scored))
            catch = Catch()
            replace(filter, resampler=catch).run(clips, 0)
            out[name] = Candidates.of(
                catch.seen[0], WeightedCoverage(2), SameSegmentation(), lambda h: weighted_coverage(h.labels, truth)
            )
    return out


def choose(candidates: Candidates, n: int, draws: int, seed: int) -> dict[str, dict[str, float]]:
    """Measures of each scheme over repeated draws of n; draw k has the same seed for all schemes."""
    m = len(candidates.log_weights)
    population = Population(np.arange(m), candidates.log_weights)
    expected, out = n * population.weights, {}
    for name, scheme in candidates.resamplers().items():
        counts, mass = np.zeros((draws, m)), np.zeros((draws, m))
        diversity, best, average = np.zeros(draws), np.zeros(draws), np.zeros(draws)
        for k in range(draws):
            chosen = scheme.resample(np.random.default_rng([seed, k]), population, n)
            index = chosen.parents["ancestor"]
            counts[k] = np.bincount(index, minlength=m)
            mass[k] = n * np.bincount(index, chosen.weights, minlength=m)
            upper = np.triu_indices(len(index), 1)
            alike = candidates.similarity[np.ix_(index, index)][upper]
            diversity[k] = 1 - alike.mean() if len(alike) else 0.0
            if candidates.quality is not None:
                best[k], average[k] = candidates.quality[index].max(), chosen.weights @ candidates.quality[index]
        out[name] = {
            "offspring_variance": float(counts.var(axis=0, ddof=1).sum() / n),
            "mass_error": float(((mass - expected) ** 2).mean(axis=0).sum() / n),
            "unique_ancestors": float((counts > 0).sum(axis=1).mean()),
            "diversity": float(diversity.mean()),
        }
        if candidates.quality is not None:
            out[name] |= {"best_of_n": float(best.mean()), "mean_quality": float(average.mean())}
    return out
