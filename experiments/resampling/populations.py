"""Weighted candidates to resample: from the four models, and from MST on real particles."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from schemes import Names, Table, schemes
from worlds import World

from mstfilter.base.errors import InputError
from mstfilter.mst.belief import SameSegmentation, WeightedCoverage
from mstfilter.runs.presets import REGISTRY, load_config
from mstfilter.scene import Camera, Clip, Frame, Hypothesis, NoFreeSpace, VoxelGrid
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import ParticleFilter, Population, Resampler, Systematic, WeightResampler, energy_distance


@dataclass(frozen=True, eq=False)
class Candidates:
    """m weighted candidates, and the schemes that are compared on them.

    Parameters
    ----------
    population : Population
        The particles are numbers, or the row numbers of m objects.
    arms : mapping
        Name -> resampler.
    alike : (m, m)
        Similarities.
    distance : callable or None
        Argument of `energy_distance`: 1 - similarity for objects, None for numbers.
    quality : (m,) or None
        Quality of each candidate against the truth.
    """

    population: Population
    arms: dict[str, Resampler]
    alike: np.ndarray
    distance: Callable[[Any], np.ndarray] | None
    quality: np.ndarray | None = None

    @classmethod
    def of(cls, population: Population, similarity: Any, equivalence: Any, quality: Any = None) -> Candidates:
        """Candidates with the similarities of all pairs of particles."""
        found = population.realised()
        particles, log_weights = found.particles, found.log_weights
        matrix = np.asarray(similarity.matrix(particles))
        alike = (matrix + matrix.T) / 2
        if isinstance(particles, np.ndarray):
            return cls(Population(particles, log_weights), schemes(similarity, equivalence), alike, None)
        arms = schemes(Table(alike), Names(equivalence.classes(particles)))
        scores = None if quality is None else np.array([quality(p) for p in particles])
        rows = Population(np.arange(len(found)), log_weights)
        return cls(rows, arms, alike, lambda rows: 1 - alike[np.ix_(rows, rows)], scores)


class Catch(WeightResampler):
    """Systematic resampling that keeps the latest population before selection in `seen`."""

    def __init__(self) -> None:
        self.seen: list[Population] = []

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> Any:
        """Select by `Systematic`."""
        return Systematic().select(rng, log_weights, n)

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Keep the population, then select."""
        self.seen = [population]
        return super().resample(rng, population, n)


def of_world(world: World, filter: Callable[..., ParticleFilter], n: int, seed: int) -> Candidates | None:
    """The population that a filter resamples last; None if it resamples none."""
    catch = Catch()
    with suppress(InputError):  # the run is lost
        filter(world, catch, n).run(world.data(seed).observations, seed)
    return Candidates.of(catch.seen[0], world.similarity, world.equivalence) if catch.seen else None


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
        """Quality against a partition of the candidate's voxels into can and carton, which was made for scoring."""
        return weighted_coverage(candidate.labels, np.where(candidate.labels > 0, np.where(can, 2, 1), 0))

    return Candidates.of(fused, WeightedCoverage(), SameSegmentation(), quality)


def choose(candidates: Candidates, n: int, draws: int, seed: int) -> dict[str, dict[str, float]]:
    """Measures of each scheme, averaged over `draws` selections of n; draw k has the same seed for all schemes.

    For a scheme that makes new particles, which are not copies, only the energy distance is measured.
    """
    population, quality, out = candidates.population, candidates.quality, {}
    m, expected = len(population), n * population.weights
    for name, scheme in candidates.arms.items():
        found: dict[str, list[float]] = {}
        counts = np.zeros((draws, m))
        for k in range(draws):
            chosen = scheme.resample(np.random.default_rng([seed, k]), population, n)
            measured = {"energy_distance": energy_distance(population, chosen, candidates.distance)}
            if "kdpp" in chosen.notes:
                measured["fallback"] = chosen.notes["kdpp"].endswith("fallback")
            if "ancestor" in chosen.parents:
                index = chosen.parents["ancestor"]
                counts[k] = np.bincount(index, minlength=m)
                mass = n * np.bincount(index, chosen.weights, minlength=m)
                alike = candidates.alike[np.ix_(index, index)][np.triu_indices(len(index), 1)]
                measured["mass_error"] = float(((mass - expected) ** 2).sum() / n)
                measured["unique_ancestors"] = float((counts[k] > 0).sum())
                measured["diversity"] = 1 - alike.mean() if len(alike) else 0.0
                if quality is not None:
                    measured |= {"best_of_n": quality[index].max(), "mean_quality": chosen.weights @ quality[index]}
            for measure, value in measured.items():
                found.setdefault(measure, []).append(value)
        out[name] = {measure: float(np.mean(values)) for measure, values in found.items()}
        if "mass_error" in found:
            out[name]["offspring_variance"] = float(counts.var(axis=0, ddof=1).sum() / n)
    return out
