"""The folder of a run, written pause by pause. Reports read it, and a run that was stopped resumes from it.

>>> run = RunFolder.open("runs/demo")
>>> run.n_pauses, run.hypotheses(0), run.info(0)

Layout::

    run.json                 configuration, seed, versions, recording, status
    pauses/000/rgb.png       the image at the pause          pauses/000/state.npz        particles and log weights
    pauses/000/info.json     record of the step              pauses/000/camera.json      pose at the pause
    pauses/000/truth.npz     true labels, if known           pauses/000/seconds.json     wall time by component
    pauses/000/instance.png  true label image, if known
    metrics.csv              one row per pause and hypothesis
    compare/without-past     run folders of other filters on the same recording, if asked for

A pause is written under a temporary name and renamed when it is complete, so a run that was stopped at any moment
holds complete pauses only. `filter_recording` resumes from state.npz of the last one. Its arrays ``particles/...``
are those of `mstfilter.scene.encode_hypotheses`. The same seed gives the same bytes in all files except seconds.json.
"""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.files import atomic_folder, reading, write_csv, write_text
from mstfilter.scene import (
    Camera,
    Clip,
    Hypothesis,
    decode_hypotheses,
    encode_hypotheses,
    read_labels,
    read_rgb,
    rigid_from_matrix,
    write_image,
)
from mstfilter.scoring import FORMS, Questions, weighted_coverage
from mstfilter.smc import Codec, Info, State, load_state, save_state

_FORMAT = 2


def as_json(value: Any) -> Any:
    """Convert a value for JSON: arrays to lists, NaN and infinities to None, other objects to strings."""
    if isinstance(value, Mapping):
        return {str(k): as_json(v) for k, v in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return as_json(value.tolist())
    if isinstance(value, (list, tuple)):
        return [as_json(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    return str(value)


def write_json(path: Path, value: Any) -> None:
    """Write JSON in one step."""
    write_text(path, json.dumps(as_json(value), indent=1) + "\n")


def _read_json(path: Path) -> Any:
    with reading(path, "a run folder", "a run folder is made by `mstfilter run`"):
        return json.loads(path.read_text())


@dataclass(frozen=True)
class HypothesisCodec(Codec):
    """Hypotheses on one grid as arrays, bit for bit."""

    def encode(self, particles: Any) -> Mapping[str, np.ndarray]:
        return encode_hypotheses(particles)

    def decode(self, arrays: Mapping[str, np.ndarray]) -> Any:
        return decode_hypotheses(arrays)


@dataclass(frozen=True)
class RunFolder:
    """A run on disk.

    Parameters
    ----------
    path : Path
        The folder.
    """

    path: Path

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """An existing run folder."""
        folder = cls(Path(path))
        if folder.description.get("format") != _FORMAT:
            raise InputError(f"{path}: run folder has format {folder.description.get('format')}, expected {_FORMAT}")
        return folder

    @classmethod
    def create(cls, path: Path, description: Mapping[str, Any]) -> RunFolder:
        """A new run folder that holds only its description."""
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot write run folder {path}: {error.strerror}") from error
        write_json(path / "run.json", {"format": _FORMAT, "status": "running", **description})
        return cls(path)

    @property
    def description(self) -> dict[str, Any]:
        """The content of run.json."""
        return dict(_read_json(self.path / "run.json"))

    @property
    def n_pauses(self) -> int:
        """Number of complete pauses."""
        return next(t for t in itertools.count() if not self.pause(t).is_dir())

    def pause(self, t: int) -> Path:
        """Folder of a pause."""
        return self.path / "pauses" / f"{t:03d}"

    def compared(self) -> dict[str, RunFolder]:
        """Runs of other filters on the same recording, by name: the run folders in ``compare/``."""
        found = sorted(path.parent for path in self.path.glob("compare/*/run.json"))
        return {path.name.replace("-", " "): RunFolder(path) for path in found}

    def set_status(self, status: str) -> None:
        """Set the status of the run: running, interrupted, failed or done."""
        write_json(self.path / "run.json", {**self.description, "status": status})

    def write_pause(
        self,
        clip: Clip,
        state: State,
        info: Info,
        truth: np.ndarray | None,
        questions: Questions | None = None,
        instance: np.ndarray | None = None,
    ) -> None:
        """Write the results of a step, and of the pause, if known: true labels, questions, true label image.

        An interrupted call writes nothing.
        """
        assert state.population is not None
        camera, hypotheses = clip.after.camera, tuple(state.population.particles)
        (self.path / "pauses").mkdir(exist_ok=True)
        with atomic_folder(self.pause(info.t)) as folder:
            folder.mkdir()
            write_image(folder / "rgb.png", clip.after.rgb)
            if instance is not None:
                write_image(folder / "instance.png", instance)
            write_json(
                folder / "camera.json",
                {
                    "K": camera.K,
                    "width": camera.width,
                    "height": camera.height,
                    "T_world_camera": camera.pose.as_matrix(),
                },
            )
            save_state(folder / "state.npz", state, HypothesisCodec(), compress=True)
            quality: dict[str, list[float]] | None = None
            if truth is not None:
                pairs = np.zeros((2, 0)) if questions is None else np.stack([questions.first, questions.second])
                np.savez_compressed(folder / "truth.npz", labels=truth, questions=pairs.astype(np.int32))
                quality = {form: [weighted_coverage(h.labels, truth, form) for h in hypotheses] for form in FORMS}
            record = {
                "t": info.t,
                "n": info.n,
                "n_frames": len(clip),
                "n_candidates": info.n_candidates,
                "ess": info.ess,
                "resampled": info.resampled,
                "unique_ancestors": info.unique_ancestors,
                "ancestors": info.ancestors,
                "parents": info.parents,
                "log_weights": info.log_weights,
                "weights": state.population.weights,
                "quality": quality,
                "notes": info.notes,
            }
            write_json(folder / "info.json", record)
            write_json(folder / "seconds.json", info.seconds)

    def remove_partial_pauses(self) -> None:
        """Remove the incomplete folder of a pause that a killed run left."""
        for partial in (self.path / "pauses").glob(".*.partial"):
            shutil.rmtree(partial, ignore_errors=True)

    def info(self, t: int) -> dict[str, Any]:
        """Record of the step that ended at pause `t`."""
        return dict(_read_json(self.pause(t) / "info.json"))

    def seconds(self, t: int) -> dict[str, float]:
        """Wall time of the step by component, in seconds."""
        return dict(_read_json(self.pause(t) / "seconds.json"))

    def instance(self, t: int) -> np.ndarray | None:
        """True label image (H, W) at a pause, 255 for the robot; None if it is not known."""
        path = self.pause(t) / "instance.png"
        return read_labels(path) if path.is_file() else None

    def rgb(self, t: int) -> np.ndarray:
        """Image (H, W, 3) at a pause."""
        return read_rgb(self.pause(t) / "rgb.png")

    def camera(self, t: int) -> Camera:
        """Camera at a pause."""
        data = _read_json(self.pause(t) / "camera.json")
        pose = rigid_from_matrix(np.array(data["T_world_camera"]))
        return Camera(np.array(data["K"]), data["width"], data["height"], pose)

    def truth(self, t: int) -> np.ndarray | None:
        """True labels (X, Y, Z) at a pause; None if unknown."""
        return self._truth(t).get("labels")

    def questions(self, t: int) -> Questions | None:
        """The questions of a pause with ground truth; None if unknown."""
        data = self._truth(t)
        pairs = data.get("questions", np.zeros((2, 0))).astype(np.int64)
        return Questions(data["labels"].shape, *pairs) if pairs.size else None

    def _truth(self, t: int) -> dict[str, np.ndarray]:
        path = self.pause(t) / "truth.npz"
        if not path.exists():
            return {}
        with np.load(path, allow_pickle=False) as data:
            return dict(data)

    def hypotheses(self, t: int) -> tuple[Hypothesis, ...]:
        """The particles after the step."""
        population = self.state(t).population
        assert population is not None
        return tuple(population.particles)

    def state(self, t: int) -> State:
        """The state after pause `t`, from which the run is resumed."""
        return load_state(self.pause(t) / "state.npz", HypothesisCodec())[0]

    def write_metrics(self) -> None:
        """Write metrics.csv from the pauses."""
        rows = []
        for t in range(self.n_pauses):
            info = self.info(t)
            for k, hypothesis in enumerate(self.hypotheses(t)):
                row = {
                    "pause": t,
                    "hypothesis": k,
                    "weight": f"{info['weights'][k]:.6g}",
                    "n_objects": hypothesis.n_objects,
                    "voxels": sum(hypothesis.volumes().values()),
                }
                for form in FORMS:
                    row[f"quality_{form}"] = "" if info["quality"] is None else f"{info['quality'][form][k]:.6f}"
                rows.append(row)
        write_csv(self.path / "metrics.csv", rows)
