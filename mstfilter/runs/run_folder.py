"""The folder of a run, written pause by pause, from which reports are made and interrupted runs are resumed.

>>> run = RunFolder.open("runs/demo")
>>> run.n_pauses, run.hypotheses(0), run.info(0)

The page "Runs and reports" of the documentation lists the files.

A pause is written under a temporary name until it is complete, so a run that was stopped has complete pauses only,
and `filter_recording` resumes it from state.npz of the last one. (The arrays ``particles/...`` in there are made by
`mstfilter.scene.encode_hypotheses`.) The same seed gives the same bytes in all files except seconds.json and
run.json.
"""

from __future__ import annotations

import itertools
import json
import re
import shutil
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field, RootModel, model_validator

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.base.files import (
    SUMS,
    atomic_folder,
    damaged_files,
    other_files,
    reading,
    sweep,
    write_csv,
    write_sums,
    write_text,
)
from mstfilter.base.reading import MAX_FILE, read_arrays, read_model
from mstfilter.formats import read_labels, read_rgb, write_image
from mstfilter.formats.folder import CameraFile
from mstfilter.mst.belief import Belief, ObjectTable
from mstfilter.runs.run_tables import TABLE_COLUMNS, metrics_rows, object_rows
from mstfilter.scene import (
    Camera,
    Clip,
    Hypothesis,
    WeightedSegmentations,
    as_labels,
    decode_hypotheses,
    encode_hypotheses,
    memo,
)
from mstfilter.scoring import FORMS, PauseEstimate, Questions, weighted_coverage
from mstfilter.smc import Codec, Info, State, load_state, save_state

_FORMAT = 2
_SEGMENTATIONS = "segmentations"  # note of an update, see `PartitionUpdate`
_RESUME = "repeat the command that made the run, to resume it"
_PAUSE_FILES = (
    rf"(rgb\.png|instance\.png|camera\.json|state\.npz|truth\.npz|segmentations\.npz|info\.json|seconds\.json|{SUMS})"
)
_TABLES = rf"(run\.json|(metrics|objects)\.csv|(report|view)\.html|result\.json|forecasts\.npz|{SUMS})"
RUN_FILES = re.compile(rf"(compare/[^/]+/)?(pauses/\d+/{_PAUSE_FILES}|{_TABLES})")  #: paths in a run folder


def _version(path: Path) -> tuple[str, int, int]:
    """What changes if a file changes: for keys of the cache."""
    with reading(path, "a pause of a run"):
        now = path.stat()
    return str(path.resolve()), now.st_mtime_ns, now.st_size


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
    """Write a JSON file atomically."""
    write_text(path, json.dumps(as_json(value), indent=1) + "\n")


class _RecordingEntry(BaseModel):
    name: str
    key: str
    pauses: list[int]
    times: list[float]

    @model_validator(mode="after")
    def _agree(self) -> _RecordingEntry:
        if len(self.pauses) != len(self.times) or not self.pauses:
            raise ValueError(f"there are {len(self.pauses)} pauses and {len(self.times)} times")
        return self


class _RunFile(BaseModel):
    """The parts of run.json that readers use."""

    format: Literal[2]
    status: Literal["running", "interrupted", "failed", "done"]
    seed: int
    description: str = ""
    config: dict[str, Any]
    uses_truth: list[str]
    files: dict[str, str]
    recording: _RecordingEntry
    versions: dict[str, str]
    machine: dict[str, str | int]


class _InfoFile(BaseModel):
    """The parts of info.json that readers use."""

    t: int
    n: int
    n_frames: int
    n_candidates: int
    ess: float
    resampled: bool
    unique_ancestors: int | None
    parents: dict[str, list[int]]
    weights: Annotated[list[Annotated[float, Field(ge=0)]], Field(min_length=1)]
    quality: dict[str, list[float]] | None
    notes: dict[str, Any]


class _PosedCamera(CameraFile):
    T_world_camera: list[list[float]]


@dataclass(frozen=True)
class HypothesisCodec(Codec):
    """Converts hypotheses on one grid to arrays and back without loss."""

    def encode(self, particles: Any) -> Mapping[str, np.ndarray]:
        return encode_hypotheses(particles)

    def decode(self, arrays: Mapping[str, np.ndarray]) -> Any:
        return decode_hypotheses(arrays)


@dataclass(frozen=True)
class RunFolder:
    """A run on disk: what a filter made of a recording, pause by pause.

    Pauses are counted from 0. If a file is damaged, or missing although each run has it, InputError is raised.

    Parameters
    ----------
    path : Path
        The folder.
    """

    path: Path

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Open an existing run folder."""
        folder = cls(Path(path))
        _ = folder.description
        return folder

    @classmethod
    def create(cls, path: Path, description: Mapping[str, Any]) -> RunFolder:
        """Make a run folder that contains only run.json."""
        write_json(path / "run.json", {"format": _FORMAT, "status": "running", **description})
        return cls(path)

    @property
    def description(self) -> dict[str, Any]:
        """The content of run.json. A missing description of the configuration is empty."""
        return {"description": "", **self._read(self.path / "run.json", _RunFile)}

    def _read(self, path: Path, model: type[BaseModel]) -> dict[str, Any]:
        return read_model(path, model, "a run folder", "a run folder is made by `mstfilter run`")[1]

    def check(self) -> RunFolder:
        """Read every file of the run and of its comparison runs, to find errors before the files are used.

        Raises InputError if a file is missing or damaged, or if files of a pause are inconsistent.
        """
        self.check_origin()
        before = 0
        for t in range(self.n_pauses):
            before = self._check_pause(t, before)
        for other in self.compared().values():
            other.check()
        return self

    def check_origin(self) -> None:
        """Raise InputError if there are more pauses than run.json lists, or a pause is of another run.

        The state of pause t has made t + 1 steps with the seed in run.json.
        """
        description = self.description
        if self.n_pauses > len(description["recording"]["pauses"]):
            raise InputError(
                f"{self.path}: there are more pauses than run.json lists", "remove the folders of the last pauses"
            )
        for t in range(self.n_pauses):
            state = self.state(t)
            found, expected = (state.t - 1, state.key.seed), (t, description["seed"])
            if found != expected:
                raise InputError(
                    f"{self.pause(t)} is of another run or pause: its state is of pause {found[0]} with seed "
                    f"{found[1]}, expected pause {t} with seed {expected[1]}",
                    f"put the right folder there, or remove the folders of pause {t} and all later pauses; the same "
                    "call or command computes them again",
                )

    def check_begun(self) -> RunFolder:
        """Raise InputError if no pause is complete; otherwise the same as `check`."""
        if self.n_pauses == 0:
            raise InputError(f"{self.path}: the run has no complete pause yet", _RESUME)
        return self.check()

    def _check_pause(self, t: int, n_before: int) -> int:
        """Check the files of pause `t` after a pause with `n_before` hypotheses. Returns the number of hypotheses."""
        folder, info, hypotheses = self.pause(t), self.info(t), self.hypotheses(t)
        grid, camera, image, labels = hypotheses[0].grid, self.camera(t), self.rgb(t), self.truth(t)
        _ = self.seconds(t), self.questions(t), self.segmentations(t)
        parents, quality = info["parents"], info["quality"]
        if quality is None:  # no ground truth
            quality = dict.fromkeys(FORMS, info["weights"])
        lists = (info["weights"], *parents.values(), *quality.values())
        wrong = (
            (info["t"] != t, f"info.json is of step {info['t']}"),
            (any(len(values) != len(hypotheses) for values in lists), "info.json has lists of another length"),
            (set(quality) != set(FORMS), f"info.json has the quality {sorted(quality)}, expected {list(FORMS)}"),
            (any(k < -1 for values in parents.values() for k in values), "info.json has a parent below -1"),
            (max(parents.get("previous", [-1])) >= n_before, "info.json has parents that are not there"),
            (image.shape[:2] != (camera.height, camera.width), f"rgb.png has the shape {image.shape}"),
            (
                (labels is None) != (info["quality"] is None),
                "one of truth.npz and the quality in info.json is missing",
            ),
            (labels is not None and labels.shape != grid.shape, "truth.npz has another grid than state.npz"),
        )
        for is_wrong, message in wrong:
            if is_wrong:
                raise InputError(f"{folder}: {message}; state.npz has {len(hypotheses)} hypotheses in {grid.text}")
        return len(hypotheses)

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

    def set_status(self, status: str, **entries: Any) -> None:
        """Set the status of the run (running, interrupted, failed or done), and other entries of run.json."""
        write_json(self.path / "run.json", {**self.description, **entries, "status": status})

    def write_pause(
        self,
        clip: Clip,
        state: State,
        info: Info,
        truth: np.ndarray | None,
        questions: Questions | None = None,
        instance: np.ndarray | None = None,
    ) -> None:
        """Write the results of a step, and the true labels, questions and true label image of the pause, if known.

        `questions` are the pairs of voxels for the log loss. An interrupted call writes nothing. Raises InputError if
        the run folder was removed meanwhile.
        """
        assert state.population is not None
        self._check_kept()
        camera, hypotheses = clip.after.camera, tuple(state.population.particles)
        if instance is not None:
            what, shape = f"true label image of pause {info.t}", clip.after.depth.shape
            instance = instance if instance.dtype == np.uint8 else as_labels(instance, what)
            if instance.shape != shape:
                raise InputError(f"{what} has shape {instance.shape}, expected {shape}")
        with atomic_folder(self.pause(info.t)) as folder:
            write_image(folder / "rgb.png", clip.after.rgb)
            if instance is not None:
                write_image(folder / "instance.png", instance)
            write_json(folder / "camera.json", CameraFile.of(camera.at(camera.pose)).model_dump())
            save_state(folder / "state.npz", state, HypothesisCodec(), compress=True)
            quality: dict[str, list[float]] | None = None
            if truth is not None:
                pairs = np.zeros((2, 0)) if questions is None else np.stack([questions.first, questions.second])
                np.savez_compressed(folder / "truth.npz", labels=truth, questions=pairs.astype(np.int32))
                quality = {form: [weighted_coverage(h.labels, truth, form) for h in hypotheses] for form in FORMS}
            population = state.population
            record = {name: getattr(info, name) for name in ("t", "n", "n_candidates", "ess", "resampled")}
            record |= {
                name: getattr(population, name) for name in ("unique_ancestors", "parents", "log_weights", "weights")
            }
            notes = {slot: dict(found) for slot, found in info.notes.items()}
            seen = notes.get("update", {}).pop(_SEGMENTATIONS, None)
            if seen is not None:
                np.savez_compressed(folder / f"{_SEGMENTATIONS}.npz", **seen.arrays())
            record |= {"n_frames": len(clip), "quality": quality, "notes": notes}
            write_json(folder / "info.json", record)
            write_sums(folder)
            write_json(folder / "seconds.json", info.seconds)

    def _check_kept(self) -> None:
        """Raise InputError if another process has removed the folder of a run that is being written."""
        if not (self.path / "run.json").is_file():
            raise InputError(
                f"run folder {self.path} was removed while the run was written", "repeat the command to run it again"
            )

    def check_replaceable(self) -> None:
        """Raise InputError if the folder contains files that are not part of a run."""
        if others := other_files(self.path, RUN_FILES):
            raise InputError(
                f"run folder {self.path} cannot be replaced: it holds {others[0]}, which is not of a run",
                "move it elsewhere, or choose another folder",
            )

    def repair(self) -> None:
        """Remove temporary files, the first damaged pause and all later pauses. Warns if pauses are removed."""
        sweep(self.path)
        sweep(self.path / "pauses")
        good = 0
        while not (wrong := damaged_files(self.pause(good))):
            good += 1
        later = sorted(path for path in (self.path / "pauses").glob("[0-9]*") if int(path.name) >= good)
        for path in reversed(later):
            shutil.rmtree(path)
        if later:
            text = f"run folder {self.path}: pause {good} is damaged: {wrong[0]}"
            hint = f"pauses {good} to {int(later[-1].name)} are computed again"
            warnings.warn(InputWarning(text, hint), stacklevel=2)

    def info(self, t: int) -> dict[str, Any]:
        """The content of info.json: the statistics of the step that ended at pause `t`."""
        return self._read(self.pause(t) / "info.json", _InfoFile)

    def seconds(self, t: int) -> dict[str, float]:
        """Wall time of the step by component, in seconds. Empty if the file is missing or damaged.

        The times are no part of the result, and SHA256SUMS does not list them.
        """
        try:
            return self._read(self.pause(t) / "seconds.json", RootModel[dict[str, float]])
        except InputError:
            return {}

    def instance(self, t: int) -> np.ndarray | None:
        """True label image (H, W) at a pause, with 255 for the robot; None if unknown."""
        path = self.pause(t) / "instance.png"
        return read_labels(path) if path.is_file() else None

    def rgb(self, t: int) -> np.ndarray:
        """Image (H, W, 3) at a pause."""
        return read_rgb(self.pause(t) / "rgb.png")

    def camera(self, t: int) -> Camera:
        """Camera at a pause."""
        path = self.pause(t) / "camera.json"
        with reading(path, "a run folder"):
            return _PosedCamera.model_validate(self._read(path, _PosedCamera)).camera

    def truth(self, t: int) -> np.ndarray | None:
        """True labels (X, Y, Z) at a pause; None if unknown."""
        return self._truth(t).get("labels")

    def questions(self, t: int) -> Questions | None:
        """The pairs of voxels that score the hypotheses at pause `t`; None if the truth is unknown."""
        pairs = self._truth(t).get("questions")
        return Questions(self._truth(t)["labels"].shape, *pairs) if pairs is not None and pairs.size else None

    def _truth(self, t: int) -> dict[str, np.ndarray]:
        """True labels (key "labels") and questions (key "questions") of a pause; empty if the truth is unknown."""
        path = self.pause(t) / "truth.npz"
        if not path.exists():
            return {}
        data = read_arrays(path, "the truth of a pause")
        with reading(path, "the truth of a pause"):
            labels, pairs = as_labels(data["labels"], "labels"), data["questions"].astype(np.int64)
            if labels.ndim != 3 or pairs.shape[:-1] != (2,) or not ((pairs >= 0) & (pairs < labels.size)).all():
                raise ValueError(f"labels have the shape {labels.shape}, questions {pairs.shape}")
        return {"labels": labels, "questions": pairs}

    def hypotheses(self, t: int) -> tuple[Hypothesis, ...]:
        """The hypotheses after the step that ended at pause `t`."""
        population = self.state(t).population
        assert population is not None
        return tuple(population.particles)

    def state(self, t: int) -> State:
        """The state after pause `t`, from which the run is resumed.

        The state is kept in the cache `scene_cache`, because a report reads it many times.
        """
        path = self.pause(t) / "state.npz"
        return memo("state of a run", _version(path), lambda: load_state(path, HypothesisCodec(), limit=MAX_FILE))

    def segmentations(self, t: int) -> WeightedSegmentations | None:
        """All weighted segmentations of the image of pause `t`; None if the update of the filter has none."""
        path = self.pause(t) / f"{_SEGMENTATIONS}.npz"
        if not path.is_file():
            return None
        arrays = read_arrays(path, "the segmentations of a pause")
        with reading(path, "the segmentations of a pause"):
            return WeightedSegmentations.of_arrays(arrays)

    def belief(self, t: int) -> Belief:
        """The belief after pause `t`: the hypotheses, and the weighted segmentations of its image."""
        population = self.state(t).population
        assert population is not None
        return Belief(population, self.segmentations(t), t)

    def objects(self, t: int) -> ObjectTable:
        """The table of objects at pause `t`, with the numbers that objects have had since pause 0."""
        return self.tables(t + 1)[-1]

    def tables(self, n: int | None = None) -> list[ObjectTable]:
        """The tables of objects of the first `n` pauses, by default of all, in which objects keep their numbers.

        They are kept in the cache `scene_cache`, because a report needs them several times.
        """
        found: list[ObjectTable] = []
        versions: list[Any] = []
        for t in range(self.n_pauses if n is None else n):
            paths = [self.pause(t) / "state.npz", self.pause(t) / f"{_SEGMENTATIONS}.npz"]
            versions += [_version(path) for path in paths if path.is_file()]
            previous = found[-1] if found else None
            found.append(memo("table of objects", tuple(versions), partial(self._table, t, previous)))
        return found

    def _table(self, t: int, previous: ObjectTable | None) -> ObjectTable:
        return self.belief(t).objects(previous=previous)

    def estimates(self) -> list[PauseEstimate]:
        """The weighted hypotheses of all pauses, for `mstfilter.scoring.score_pauses`."""
        run, found = self.check_begun(), []
        for t, frame in zip(range(run.n_pauses), run.description["recording"]["pauses"], strict=False):
            hypotheses, weights = run.hypotheses(t), np.asarray(run.info(t)["weights"], dtype=float)
            answer = self.belief(t).estimate_index
            found.append(PauseEstimate(hypotheses, weights, frame, hypotheses[0].grid, answer))
        return found

    def write_metrics(self) -> None:
        """Write metrics.csv, with one row per pause and hypothesis, and objects.csv, one per pause and object."""
        self._check_kept()
        write_csv(self.path / "metrics.csv", metrics_rows(self))
        write_csv(self.path / "objects.csv", object_rows(self), TABLE_COLUMNS)
        write_sums(self.path, ["metrics.csv", "objects.csv"])
