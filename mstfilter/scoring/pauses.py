"""Scores of hypotheses, or of label volumes, at the pauses of a recording against the ground truth.

>>> rows = score_pauses(RunFolder.open("runs/mine").estimates(), read_truth(open_recording("recordings/mine")))
>>> rows[0].form, rows[0].mean, rows[0].best, rows[0].one_blob

`score_pauses` makes one row for each pause and form of weighted coverage (`mstfilter.scoring.quality`). A row has the
mean quality of the hypotheses, the weighted mean and the maximum. It also has the quality of the hypothesis of
largest weight (of equal weights, the first: a random draw) and of the hypothesis of least expected loss. A row also
has the values of two trivial baselines: the occupied voxels as one object, and as connected components. If the
ground truth has instance images but no volumes, hypotheses are rendered and compared in the image. Pixels of the
robot (label 255) are ignored. For a recording with volumes, rows also have the scores of the forecasts: Brier score,
log loss, log loss of the base rate and calibration error (`score_belief`). The scores of the forecasts are the same
for all forms of weighted coverage.

`measure_pause` computes all metrics of a pause, for the tables of a study.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.scene import Camera, Hypothesis, Recording, VoxelGrid, render
from mstfilter.scoring.log_loss import check_normalised, score_belief
from mstfilter.scoring.metrics import diversity, least_loss, pairwise_quality, pause_metrics
from mstfilter.scoring.quality import FORMS, connected_components, object_status, one_blob, weighted_coverage
from mstfilter.scoring.questions import Questions, ask

_ROBOT = 255


@dataclass(frozen=True, eq=False)
class PauseEstimate:
    """Hypotheses at one pause.

    Parameters
    ----------
    hypotheses : sequence of Hypothesis or of (X, Y, Z) arrays
        A `Hypothesis` also has probabilities of its voxels, and an array has only labels.
    weights : (n,) array
        The sum of the weights is 1.
    frame : int
        Frame of the recording at this pause.
    grid : VoxelGrid, optional
        Grid of the arrays. The default is the grid of the first `Hypothesis`.
    answer : int, optional
        Index of the one answer, such as `Belief.estimate`. Default: the hypothesis of least expected loss.
    """

    hypotheses: Sequence[Hypothesis | np.ndarray]
    weights: np.ndarray
    frame: int
    grid: VoxelGrid | None = None
    answer: int | None = None

    def __post_init__(self) -> None:
        check_normalised(self.weights, len(self.hypotheses), f"hypotheses at frame {self.frame}")
        grids = [one.grid for one in self.hypotheses if isinstance(one, Hypothesis)]
        object.__setattr__(self, "grid", self.grid or next(iter(grids), None))
        for one in grids:
            _check_grid(one, self.grid, f"a hypothesis at frame {self.frame}", "its estimate")

    @property
    def labels(self) -> list[np.ndarray]:
        """Labels (X, Y, Z) of each hypothesis."""
        return [one.labels if isinstance(one, Hypothesis) else one for one in self.hypotheses]


@dataclass(frozen=True, eq=False)
class PauseTruth:
    """True labels at one pause, as volumes or as an image with its camera.

    Parameters
    ----------
    labels : (X, Y, Z) array, or (H, W) if `camera` is given
        Label 0 is no object.
    frame : int
        Frame of the recording.
    grid : VoxelGrid, optional
        Grid of a volume.
    camera : Camera, optional
        Camera of an image.
    questions : Questions, optional
        Questions about a volume.
    """

    labels: np.ndarray
    frame: int
    grid: VoxelGrid | None = None
    camera: Camera | None = None
    questions: Questions | None = None


@dataclass(frozen=True)
class PauseScore:
    """Quality at one pause, measured by one form of weighted coverage."""

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
    base_rate: float = float("nan")


def read_truth(recording: Recording) -> list[PauseTruth]:
    """Ground truth of a recording: volumes, or else instance images."""
    found = []
    for t, index in enumerate(recording.pauses):
        volume, image = recording.truth(t), recording.instance(index)
        if volume is not None:
            found.append(PauseTruth(volume, index, recording.grid, questions=ask(recording, t)))
        elif image is not None:
            found.append(PauseTruth(image, index, None, recording.frames[index].camera))
    if not found:
        raise InputError(
            f"recording {recording.name} has no ground truth: neither volumes (voxels.npz) nor instance images",
            "add one in Python: dataclasses.replace(recording, truth=volume, instance=image)",
        )
    return found


def measure_pause(
    recording: Recording,
    t: int,
    hypotheses: Sequence[Hypothesis],
    weights: np.ndarray,
    questions: Questions | None = None,
    answer: int | None = None,
) -> tuple[dict[str, Any], np.ndarray | None]:
    """Metrics of weighted hypotheses at pause `t` of a recording, and the counts of their forecasts.

    Parameters
    ----------
    weights : (n,) float
        Sum 1.
    questions : Questions, optional
        Questions of the pause, if they are already known.
    answer : int, optional
        Index of the one answer, such as `Belief.estimate`. Default: that of `least_loss`.

    Returns
    -------
    row : dict
        Metrics of `mstfilter.scoring.metrics` and `score_belief`. Metrics that need a missing ground truth are left
        out. ``qualities`` is a list, which tables leave out.
    counts : (r, 1001, 2) int32, or None without ground truth
        The field `counts` of `BeliefScore`.
    """
    for h in hypotheses:
        _check_grid(h.grid, recording.grid, f"a hypothesis at pause {t}", f"recording {recording.name}")
    labels = [h.labels for h in hypotheses]
    row: dict[str, Any] = {"pause": t, "time_s": recording.times[recording.pauses[t]], "n": len(labels)}
    row["n_objects"] = float(np.mean([h.n_objects for h in hypotheses]))
    truth = recording.truth(t)
    if truth is None:
        return {**row, "diversity": diversity(pairwise_quality(labels))}, None
    known = all(recording.instance(p) is not None for p in recording.pauses[: t + 1])
    status = object_status(recording, t) if known else {}
    found, q = pause_metrics(labels, weights, truth, status, answer)
    belief = score_belief(questions or ask(recording, t), hypotheses, weights, truth)
    return {**row, **found, **belief.row, "qualities": q.tolist()}, belief.counts


def score_pauses(estimates: Sequence[PauseEstimate], truths: Sequence[PauseTruth]) -> list[PauseScore]:
    """Scores of all pauses with an estimate and ground truth. Pauses are matched by their frames."""
    by_frame = {truth.frame: truth for truth in truths}
    rows = []
    for pause, estimate in enumerate(estimates):
        if estimate.frame in by_frame:
            rows += _score_pause(pause, estimate, by_frame[estimate.frame])
    if not rows:
        raise InputError(
            f"no pause has both: hypotheses are at frames {[e.frame for e in estimates]}, truth at {list(by_frame)}",
            "check that they belong to the same recording",
        )
    return rows


def _score_pause(pause: int, estimate: PauseEstimate, truth: PauseTruth) -> list[PauseScore]:
    seen, true = _comparable(pause, estimate, truth)
    labels, w = estimate.labels, np.asarray(estimate.weights, dtype=float)
    found = [seen(one) for one in labels]
    floors = [[seen(floor(one)) for one in labels] for floor in (one_blob, connected_components)]
    belief = {}
    if truth.questions is not None:
        scores = score_belief(truth.questions, estimate.hypotheses, w, true)
        belief = {**scores.row, "base_rate": scores.base_rate_loss}
    best_guess = least_loss(found, w) if estimate.answer is None else estimate.answer
    where = "volume" if truth.camera is None else "image"
    rows = []
    for form in FORMS:
        q = np.array([weighted_coverage(one, true, form) for one in found])
        low = [float(w @ [weighted_coverage(one, true, form) for one in floor]) for floor in floors]
        values = float(q.mean()), float(w @ q), float(q.max()), float(q[w.argmax()]), float(q[best_guess])
        rows.append(PauseScore(pause, where, form, len(q), *values, *low, **belief))
    return rows


def _comparable(
    pause: int, estimate: PauseEstimate, truth: PauseTruth
) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """A function that converts a label volume for comparison with the truth, and the truth in the same form."""
    grid, camera = estimate.grid, truth.camera
    if camera is None:
        if grid is not None:
            _check_grid(grid, truth.grid, f"pause {pause}: the hypotheses", "the truth")
        return lambda labels: labels, truth.labels
    if grid is None:
        raise InputError("label volumes without a grid cannot be projected", "give the field `grid`")
    known = truth.labels != _ROBOT
    return lambda labels: render(labels, grid, camera).labels[known], truth.labels[known]


def _check_grid(a: VoxelGrid, b: VoxelGrid | None, name: str, other: str) -> None:
    """Raise InputError if two workspaces differ by more than single precision."""
    if b and not (a.shape == b.shape and np.allclose([a.origin, a.upper], [b.origin, b.upper], atol=1e-6)):
        hint = "run the filter on the recording that has the ground truth, or give it the same workspace"
        raise InputError(f"{name}: the workspace is {a}, but {other} has {b}", hint)
