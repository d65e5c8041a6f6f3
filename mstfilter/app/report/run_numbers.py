"""Numerical results of a run, for the report and the command line.

>>> numbers = read_numbers(RunFolder.open("runs/demo"))
>>> numbers.value_of_the_past, numbers.steps[-1].mean

The numbers are read from the run folder alone. The run may be finished or interrupted.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from mstfilter.runs import RunFolder
from mstfilter.scene import project, render
from mstfilter.scoring import (
    BeliefScore,
    PauseEstimate,
    PauseScore,
    PauseTruth,
    pause_metrics,
    score_belief,
    score_pauses,
    shown_objects,
    status_of,
    weighted_coverage,
)

SLOT_TITLES = {
    "initial": "Initial particles",
    "transition": "Transition",
    "proposal": "Proposal",
    "update": "Update",
    "resampler": "Resampling",
    "build": "Building the resampled hypotheses",
}
_BASELINES = {"one blob": "quality_one_blob", "connected components": "quality_components"}


@dataclass(frozen=True)
class PauseNumbers:
    """Numerical results at one pause."""

    info: Mapping[str, Any]  #: contents of info.json
    seconds: Mapping[str, float]  #: contents of seconds.json
    objects: Sequence[int]  #: number of objects of each hypothesis
    n_distinct: int  #: number of distinct hypotheses
    metrics: Mapping[str, float] | None  #: of `mstfilter.scoring.pause_metrics`; None without ground truth
    in_image: float | None  #: mean quality of the projected hypotheses; None without ground truth
    image_score: PauseScore | None  #: scores in the image, if only a true label image is known
    compared: Mapping[str, float]  #: mean quality of the compared runs, where it is known
    compared_losses: Mapping[str, float]  #: log loss of the compared runs in nats, where it is known
    belief: BeliefScore | None  #: scores of the weighted hypotheses; None without ground truth
    time: float  #: time of the pause in the recording
    clip_seconds: float | None  #: time since the last pause; None for the first pause

    @property
    def weights(self) -> list[float]:
        """Normalised weights."""
        return list(self.info["weights"])

    @property
    def quality(self) -> Sequence[float] | None:
        """Quality of each hypothesis; None without ground truth."""
        return None if self.info["quality"] is None else self.info["quality"]["objects"]

    @property
    def baselines(self) -> dict[str, float]:
        """Mean quality of the trivial baselines; empty without ground truth."""
        return {} if self.metrics is None else {name: self.metrics[key] for name, key in _BASELINES.items()}

    @property
    def true_objects(self) -> int | None:
        """Number of objects in the ground truth."""
        return None if self.metrics is None else int(self.metrics["true_objects"])

    @property
    def step_seconds(self) -> float:
        return float(sum(self.seconds.values()))

    @property
    def mean_objects(self) -> float:
        """Mean number of objects."""
        return float(np.mean(self.objects))

    @property
    def distinct_text(self) -> str:
        """Number of distinct hypotheses, in words."""
        if self.n_distinct == len(self.weights):
            return "all distinct"
        return "all the same" if self.n_distinct == 1 else f"{self.n_distinct} distinct"

    @property
    def mean(self) -> float | None:
        """Unweighted mean quality of the hypotheses; None without ground truth."""
        return None if self.quality is None else float(np.mean(self.quality))

    @property
    def best(self) -> float | None:
        """Quality of the best hypothesis; None without ground truth."""
        return None if self.quality is None else max(self.quality)

    def notes(self, slot: str) -> Mapping[str, Any]:
        """Extra values that the component of `slot` stored, except values that an earlier component also stored."""
        notes: Mapping[str, Mapping[str, Any]] = self.info["notes"]
        earlier = [notes[name] for name in itertools.takewhile(lambda name: name != slot, notes)]
        return {k: v for k, v in notes.get(slot, {}).items() if not any(k in e and e[k] == v for e in earlier)}


@dataclass(frozen=True)
class RunNumbers:
    """Numerical results of a run."""

    description: Mapping[str, Any]
    steps: Sequence[PauseNumbers] = field(default_factory=tuple)

    @property
    def status(self) -> str:
        """Status of the run: running, interrupted, failed, done."""
        return str(self.description["status"])

    @cached_property
    def slots(self) -> list[str]:
        """Names of the slots of the filter that have times or extra values, in the order of a step."""
        used = {s for step in self.steps for s in (*step.seconds, *step.info["notes"])}
        return [s for s in SLOT_TITLES if s in used] + sorted(used - set(SLOT_TITLES))

    def component(self, slot: str) -> str:
        """Name of the component in a slot of the filter; empty if unknown."""
        part = self.description["config"].get(slot)
        name = part.get("component", "") if isinstance(part, Mapping) else part
        return str(name).rsplit(":", 1)[-1] if name else ""

    @property
    def with_truth(self) -> list[int]:
        """Indices of the pauses with known quality."""
        return [t for t, step in enumerate(self.steps) if step.quality is not None]

    @property
    def with_images(self) -> list[int]:
        """Indices of the pauses at which only the quality in the image is known."""
        return [t for t, step in enumerate(self.steps) if step.image_score is not None]

    @property
    def compared(self) -> list[str]:
        """Names of the compared runs with known quality."""
        return list(dict.fromkeys(name for step in self.steps for name in step.compared))

    @property
    def value_of_the_past(self) -> list[str]:
        """What earlier images changed on this recording, a sentence in a list; empty if a score is unknown."""
        name = "single frame"
        known = [step for step in self.steps[1:] if step.belief is not None and name in step.compared_losses]
        if not known:
            return []
        quality = float(np.mean([s.mean for s in known])), float(np.mean([s.compared[name] for s in known]))
        losses = [s.belief.row["log_loss"] for s in known if s.belief is not None]
        loss = float(np.mean(losses)), float(np.mean([s.compared_losses[name] for s in known]))
        return [
            f"Over the pauses after the first, mean quality is {quality[0]:.2f} with earlier images and "
            f"{quality[1]:.2f} from each image alone, and log loss is {loss[0]:.2f} and {loss[1]:.2f} nats. "
            "One recording cannot tell whether such a difference is chance."
        ]


def read_numbers(run: RunFolder, beliefs: bool = True) -> RunNumbers:
    """The numerical results of a run folder. `beliefs` adds the log losses, which take long to compute."""
    description = run.description
    times = description["recording"]["times"]
    steps = []
    shown: set[int] = set()  # true objects that an image has shown
    for t in range(run.n_pauses):
        info, hypotheses, truth = run.info(t), run.hypotheses(t), run.truth(t)
        questions = run.questions(t) if beliefs else None
        belief = None
        if questions is not None and truth is not None:
            belief = score_belief(questions, hypotheses, info["weights"], truth)
        metrics, in_image = None, None
        if truth is not None:
            labels, weights = [h.labels for h in hypotheses], np.array(info["weights"], float)
            grid, camera = hypotheses[0].grid, run.camera(t)
            seen = render(truth, grid, camera).labels
            visible = shown_objects(seen)
            metrics = pause_metrics(
                labels, weights, truth, status_of(truth, visible, shown), run.belief(t).estimate_index
            )[0]
            shown |= visible
            in_image = float(np.mean([weighted_coverage(project(h, camera), seen) for h in hypotheses]))
        beside, losses = {}, {}
        for name, other in run.compared().items():
            if t >= other.n_pauses or (q := other.info(t)["quality"]) is None:
                continue
            beside[name] = float(np.mean(q["objects"]))
            if questions is not None and truth is not None:
                score = score_belief(questions, other.hypotheses(t), other.info(t)["weights"], truth)
                losses[name] = float(score.row["log_loss"])
        steps.append(
            PauseNumbers(
                info=info,
                seconds=run.seconds(t),
                objects=[h.n_objects for h in hypotheses],
                n_distinct=len({h.key for h in hypotheses}),
                metrics=metrics,
                in_image=in_image,
                image_score=None if truth is not None else _image_score(run, t),
                compared=beside,
                compared_losses=losses,
                belief=belief,
                time=float(times[t]),
                clip_seconds=None if t == 0 else float(times[t]) - float(times[t - 1]),
            )
        )
    return RunNumbers(description, tuple(steps))


def _image_score(run: RunFolder, t: int) -> PauseScore | None:
    """Scores of pause `t` in the image, with the ``objects`` quality; None without a true label image."""
    image = run.instance(t)
    if image is None:
        return None
    hypotheses, weights = run.hypotheses(t), np.asarray(run.info(t)["weights"], dtype=float)
    estimate = PauseEstimate(hypotheses, weights, t, hypotheses[0].grid, run.belief(t).estimate_index)
    scores = score_pauses([estimate], [PauseTruth(image, t, camera=run.camera(t))])
    return next(score for score in scores if score.form == "objects")
