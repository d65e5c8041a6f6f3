"""Fingerprints: hashes of results that a change of the code's structure must not change.

    python experiments/fingerprints/run.py before.json               # before the change
    python experiments/fingerprints/run.py after.json --against before.json

There are hashes of the hypotheses (labels, weights, parents) for each preset, scene and pause, and of their
metrics to nine digits. There are also hashes of the simulated images and true volumes, and of particles and log
evidence of filters of `mstfilter.smc`. If the data of `experiments/real` are there, there are hashes of the
hypotheses of `mst` at the first two pauses of each real sequence. Hashes can be compared only on one machine
with one set of library versions, so the repository stores no hashes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

import mstfilter
from mstfilter.base.resources import preset_names
from mstfilter.runs import filter_recording
from mstfilter.runs.presets import REGISTRY, load_config
from mstfilter.runs.study import write_measures
from mstfilter.smc import Population, Proposal, Transition, Update

#: Scene families and seeds. Three small scenes: 5 objects, 9 objects, and the demo.
SCENES = (("demo", 3), ("s1", 7), ("s2", 4))
SCHEMES = ("multinomial", "stratified", "systematic", "residual", "ssp", "killing", "fearnhead_clifford")
SCHEMES += ("clusters", "coalesced", "tempered", "shuffled")


@dataclass(frozen=True)
class Prior(Proposal):
    """x_0 ~ N(0, 1)."""

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        return Population(rng.standard_normal(n))


@dataclass(frozen=True)
class Walk(Transition):
    """x_t ~ N(x_{t-1}, 1)."""

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        return population.moved(population.particles + rng.standard_normal(len(population)))


@dataclass(frozen=True)
class Noise(Update):
    """y_t ~ N(x_t, 0.5)."""

    def update(self, rng: np.random.Generator, predicted: Any, proposed: Any, observation: Any) -> Population:
        return predicted.reweighted(-2.0 * (predicted.particles - observation) ** 2)


def digest(*values: Any) -> str:
    """Sixteen hexadecimal digits of the bytes, types and shapes of arrays and numbers."""
    hasher = hashlib.sha256()
    for value in values:
        array = np.ascontiguousarray(value)
        hasher.update(f"{array.dtype.str}{array.shape}".encode())
        hasher.update(array.tobytes())
    return hasher.hexdigest()[:16]


def of_recording(recording: Any) -> dict[str, str]:
    """Fingerprints of images and true volumes."""
    frames = [frame for clip in recording.clips() for frame in clip.frames]
    return {
        "images": digest(*(image for frame in frames for image in (frame.rgb, frame.depth))),
        "truth": digest(*(recording.truth(t) for t in range(len(recording.pauses)))),
    }


def of_population(population: Population) -> str:
    """Fingerprint of hypotheses, their weights and their parents."""
    labels = [hypothesis.labels for hypothesis in population.particles]
    parents = [np.asarray(population.parents[name]) for name in sorted(population.parents) if name != "ancestor"]
    return digest(*labels, population.log_weights, *parents)


def of_run(recording: Any, preset: str) -> dict[str, str]:
    """Fingerprints of the hypotheses after every pause, and of all metrics."""
    with tempfile.TemporaryDirectory() as folder:
        run = filter_recording(recording, load_config(preset), Path(folder) / "run")
        found = {f"pause {t}": of_population(run.state(t).population) for t in range(run.n_pauses)}
        # Without the last digits, which depend on the order of sums.
        metrics = json.loads(
            json.dumps(write_measures(run, recording)), parse_float=lambda text: f"{float(text):.9g}"
        )
        return {**found, "metrics": digest(json.dumps(metrics))}


def of_real(folder: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Fingerprints of `mst` at the first two pauses of the real sequences."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "real"))
    from sequences import sequences

    for sequence in sequences(folder):
        steps = islice(mstfilter.preset("mst").iterate(sequence.recording.clips(), 0), 2)
        yield sequence.name, {f"pause {info.t}": of_population(state.population) for state, info in steps}


def of_smc() -> dict[str, str]:
    """Fingerprints of particles and weights of a random walk observed with noise, for every resampling scheme."""
    observations = np.random.default_rng(0).normal(size=20).cumsum()
    walk, likelihood = Walk(), Noise()
    found = {}
    for name in SCHEMES:
        for resample in ("before", "after"):
            scheme = REGISTRY.build("resampler", name)
            filter = mstfilter.ParticleFilter(
                initial=Prior(), transition=walk, update=likelihood, resampler=scheme, n=30, resample=resample
            )
            values = []
            for state, info in filter.iterate(observations, 5):
                ancestors = state.population.parents.get("ancestor", np.arange(info.n))
                values += [state.population.particles, state.population.log_weights, ancestors, info.ess]
            found[f"{name} {resample}"] = digest(*values)
    return found


def main() -> int:
    """Write the fingerprints; with `--against`, list the differences from an earlier file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--against", type=Path, help="an earlier file; differences are listed and the exit code is 1")
    parser.add_argument("--presets", nargs="*", default=None, help="only these")
    parser.add_argument("--scenes", type=int, default=len(SCENES), help="only the first few scenes")
    options = parser.parse_args()
    found: dict[str, Any] = {"smc": of_smc()}
    with tempfile.TemporaryDirectory() as folder:
        for family, seed in SCENES[: options.scenes]:
            from mstfilter.app.cli import main as command

            path = Path(folder) / f"{family}-{seed}"
            try:
                command(["simulate", family, str(path), "--seed", str(seed)])
            except SystemExit as end:
                if end.code:
                    return int(end.code)
            recording = mstfilter.open_recording(path)
            found[f"{family}-{seed}"] = of_recording(recording)
            for preset in options.presets or preset_names():
                found[f"{family}-{seed} {preset}"] = of_run(recording, preset)
                options.out.write_text(json.dumps(found, indent=1) + "\n")
    real = Path(os.environ.get("MSTFILTER_SHARED", Path(__file__).resolve().parents[3] / "shared")) / "real"
    if real.is_dir():
        found.update(of_real(real))
    options.out.write_text(json.dumps(found, indent=1) + "\n")
    if options.against is None:
        return 0
    expected = json.loads(options.against.read_text())
    changed = [
        f"{group}, {key}: {value} instead of {expected[group][key]}"
        for group in found
        if group in expected
        for key, value in found[group].items()
        if expected[group].get(key) != value
    ]
    print("\n".join(changed) if changed else "all fingerprints agree")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
