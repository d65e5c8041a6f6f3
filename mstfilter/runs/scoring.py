"""Scores of a run, or of label volumes, against the ground truth.

>>> rows = score_pauses(read_estimate(Path("runs/mine")), read_truth(Path("recordings/mine/voxels.npz")))
>>> rows[0].form, rows[0].mean, rows[0].best, rows[0].one_blob

There is one row for each pause and form of weighted coverage (`mstfilter.scoring`). It has the mean over the
hypotheses, the weighted mean, the maximum, and the values of the hypothesis of largest weight and of the one of least
expected loss. It also has two floors: the occupied voxels of the same hypotheses as one blob, and as connected
components. If the ground truth has instance images but no volumes, hypotheses are rendered and compared in the image;
pixels of the robot (255) are ignored. For a recording with volumes, rows also have the scores of the weighted set:
Brier score, log loss and that of the base rate, calibration error and energy score
(`mstfilter.scoring.score_belief`), the same for all forms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.files import reading, write_csv, writing
from mstfilter.reading import read_arrays
from mstfilter.runs.run_folder import RunFolder
from mstfilter.scene import Camera, Hypothesis, Recording, VoxelGrid, as_labels, render
from mstfilter.scoring import (
    FORMS,
    Questions,
    ask,
    connected_components,
    diversity,
    least_loss,
    object_status,
    one_blob,
    pause_metrics,
    score_belief,
    weighted_coverage,
)

_ROBOT = 255


@dataclass(frozen=True, eq=False)
class PauseEstimate:
    """Hypotheses at one pause of a run.

    Parameters
    ----------
    labels : sequence of (X, Y, Z) arrays
        One array for each hypothesis.
    weights : (n,) array
        Their sum is 1.
    frame : int, optional
        Frame of the recording at this pause.
    grid : VoxelGrid, optional
        Grid of the volumes.
    hypotheses : sequence of Hypothesis
        The hypotheses of a run, which also say how sure they are of each voxel.
    """

    labels: Sequence[np.ndarray]
    weights: np.ndarray
    frame: int | None = None
    grid: VoxelGrid | None = None
    hypotheses: Sequence[Hypothesis] = ()


@dataclass(frozen=True, eq=False)
class PauseTruth:
    """True labels at one pause: volumes, or an image with its camera.

    Parameters
    ----------
    labels : (X, Y, Z) array, or (H, W) if `camera` is given
        0: no object.
    frame : int, optional
        Frame of the recording.
    grid : VoxelGrid, optional
        Grid of a volume.
    camera : Camera, optional
        Camera of an image.
    questions : Questions, optional
        Questions about a volume.
    """

    labels: np.ndarray
    frame: int | None = None
    grid: VoxelGrid | None = None
    camera: Camera | None = None
    questions: Questions | None = None


@dataclass(frozen=True)
class PauseScore:
    """Quality at one pause in one form of weighted coverage."""

    pause: int
    where: str
    form: str
    n: int
    mean: float
    weighted: float
    best: float
    top: float
    estimate: float
    one_blob: float
    components: float
    brier: float = float("nan")
    log_loss: float = float("nan")
    calibration_error: float = float("nan")
    energy: float = float("nan")
    base_rate: float = float("nan")


def read_estimate(path: Path) -> list[PauseEstimate]:
    """Hypotheses of a run folder, or label volumes: .npz with ``labels`` as voxels.npz has them, or .npy."""
    if not path.is_dir():
        volumes, frames, grid = _read_volumes(path, "label volumes")
        return [PauseEstimate([one], np.ones(1), frame, grid) for one, frame in zip(volumes, frames, strict=True)]
    run = RunFolder.open(path).check()
    if run.n_pauses == 0:
        raise InputError(f"{path}: the run has no complete pause yet")
    frames = run.description["recording"]["pauses"]
    found = []
    for t in range(run.n_pauses):
        hypotheses, weights = run.hypotheses(t), np.asarray(run.info(t)["weights"], dtype=float)
        labels = [h.labels for h in hypotheses]
        found.append(PauseEstimate(labels, weights, frames[t], hypotheses[0].grid, hypotheses))
    return found


def read_truth(source: Path | Recording) -> list[PauseTruth]:
    """Ground truth of a recording (its volumes, else its instance images), or of a .npz or .npy file of volumes."""
    if isinstance(source, Path):
        volumes, frames, grid = _read_volumes(source, "true volumes")
        return [PauseTruth(one, frame, grid) for one, frame in zip(volumes, frames, strict=True)]
    found = []
    for t, index in enumerate(source.pauses):
        volume, image = source.truth(t), source.instance(index)
        if volume is not None:
            found.append(PauseTruth(volume, index, source.grid, questions=ask(source, t)))
        elif image is not None:
            found.append(PauseTruth(image, index, None, source.frames[index].camera))
    if not found:
        raise InputError(
            f"recording {source.name} has no ground truth: neither volumes (voxels.npz) nor instance images",
            "give volumes as .npz: labels (S, X, Y, Z), frame (S,), origin (3,), voxel_size",
        )
    return found


def _read_volumes(path: Path, what: str) -> tuple[np.ndarray, list[int | None], VoxelGrid | None]:
    """Labels (S, X, Y, Z), the frame of each or None, and the grid or None."""
    if not path.exists():
        raise InputError(f"{what}: file does not exist: {path}")
    hint = "expected .npz with an array `labels` (S, X, Y, Z), or .npy"
    data = read_arrays(path, what, hint)
    with reading(path, what, hint):
        data = {"labels": data[""]} if "" in data else data
        if "particles/labels" in data:
            raise InputError(f"{path} holds the hypotheses of one pause of a run", "give the run folder")
        labels = data["labels"]
        labels = as_labels(labels, f"{path}: labels")
        labels = labels[None] if labels.ndim == 3 else labels
        if labels.ndim != 4 or len(labels) == 0:
            raise InputError(f"{path}: labels have shape {labels.shape}, expected (S, X, Y, Z), one volume a pause")
        frames: list[int | None] = [int(f) for f in data["frame"]] if "frame" in data else [None] * len(labels)
        if len(frames) != len(labels):
            raise InputError(f"{path}: there are {len(labels)} label grids for {len(frames)} frames")
        grid = None
        if "origin" in data and "voxel_size" in data:
            grid = VoxelGrid(data["origin"], float(data["voxel_size"]), labels.shape[1:])
    return labels, frames, grid


def measure_pause(run: RunFolder, recording: Recording, t: int) -> tuple[dict[str, Any], np.ndarray | None]:
    """Metrics of a run at pause `t`, and the counts of its forecasts.

    Returns
    -------
    row : dict
        Metrics of `mstfilter.scoring.metrics` and `mstfilter.scoring.score_belief`; without ground truth only those
        that need none. ``qualities`` and ``energy_noise`` are lists, which tables leave out.
    counts : (r, 1001, 7) int32, or None without ground truth
        As in `mstfilter.scoring.BeliefScore`.
    """
    info, hypotheses = run.info(t), run.hypotheses(t)
    labels, weights = [h.labels for h in hypotheses], np.array(info["weights"], dtype=float)
    row: dict[str, Any] = {"pause": t, "time_s": recording.times[recording.pauses[t]], "n": info["n"]}
    row["n_objects"] = float(np.mean([h.n_objects for h in hypotheses]))
    truth = recording.truth(t)
    if truth is None:
        return {**row, "diversity": diversity(labels)}, None
    known = all(recording.instance(p) is not None for p in recording.pauses[: t + 1])
    status = object_status(recording, t) if known else {}
    found, q = pause_metrics(labels, weights, truth, status)
    belief = score_belief(run.questions(t) or ask(recording, t), hypotheses, weights, truth, status)
    return {**row, **found, **belief.row, "qualities": q.tolist()}, belief.counts


def score_pauses(estimates: Sequence[PauseEstimate], truths: Sequence[PauseTruth]) -> list[PauseScore]:
    """Scores of all pauses that have both; pauses are matched by frame if both have frames, else by order."""
    by_frame = {t.frame: t for t in truths}
    named = None not in by_frame and all(e.frame is not None for e in estimates)
    if not named and len(estimates) != len(truths):
        raise InputError(
            f"there are {len(estimates)} pauses with hypotheses and {len(truths)} with truth, and no frame numbers",
            "add an array `frame` (S,) to the .npz files",
        )
    rows = []
    for pause, estimate in enumerate(estimates):
        truth = by_frame.get(estimate.frame) if named else truths[pause]
        if truth is not None:
            rows += _score_pause(pause, estimate, truth)
    if not rows:
        raise InputError(
            f"no pause has both: hypotheses are at frames {[e.frame for e in estimates]}, truth at {list(by_frame)}",
            "check that they belong to the same recording",
        )
    return rows


def _score_pause(pause: int, estimate: PauseEstimate, truth: PauseTruth) -> list[PauseScore]:
    true = truth.labels
    if truth.camera is not None:
        if estimate.grid is None:
            raise InputError(
                "label volumes without a grid cannot be projected", "add origin and voxel_size to the .npz"
            )
        known = true != _ROBOT
        camera, grid = truth.camera, estimate.grid
        true = true[known]

        def seen(labels: np.ndarray) -> np.ndarray:
            return render(labels, grid, camera).labels[known]
    else:
        if estimate.grid is not None and truth.grid is not None and not _same_grid(estimate.grid, truth.grid):
            raise InputError(
                f"pause {pause}: hypotheses are on a grid {_grid_text(estimate.grid)}, "
                f"truth on {_grid_text(truth.grid)}",
                "run the filter on the recording that has the ground truth, or give it the same workspace",
            )

        def seen(labels: np.ndarray) -> np.ndarray:
            return labels

    found = [seen(labels) for labels in estimate.labels]
    floors = [
        [seen(floor(labels).astype(np.uint16)) for labels in estimate.labels]
        for floor in (one_blob, connected_components)
    ]
    w = np.asarray(estimate.weights, dtype=float)
    belief = {}
    if truth.questions is not None:
        scores = score_belief(truth.questions, estimate.hypotheses or estimate.labels, w, true)
        belief = {name: scores.row[name] for name in ("brier", "log_loss", "calibration_error", "energy")}
        belief["base_rate"] = scores.base_rate_loss
    best_guess = least_loss(found, w)
    rows = []
    for form in FORMS:
        q = np.array([weighted_coverage(labels, true, form) for labels in found])
        low = [float(w @ [weighted_coverage(labels, true, form) for labels in floor]) for floor in floors]
        where = "volume" if truth.camera is None else "image"
        values = float(q.mean()), float(w @ q), float(q.max()), float(q[w.argmax()]), float(q[best_guess])
        rows.append(PauseScore(pause, where, form, len(q), *values, *low, **belief))
    return rows


def _same_grid(a: VoxelGrid, b: VoxelGrid) -> bool:
    return (
        a.shape == b.shape and np.allclose(a.origin, b.origin, atol=1e-6) and abs(a.voxel_size - b.voxel_size) < 1e-9
    )


def _grid_text(grid: VoxelGrid) -> str:
    return f"{' x '.join(map(str, grid.shape))} at {np.round(grid.origin, 4).tolist()} of {grid.voxel_size:g} m"


def write_scores(path: Path, rows: Sequence[PauseScore]) -> None:
    """Write scores as a CSV table.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    if not path.parent.is_dir():
        raise InputError(f"cannot write {path}: its folder does not exist")
    with writing(str(path)):
        write_csv(path, [asdict(row) for row in rows], float_format=".6f")
