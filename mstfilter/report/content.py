"""What the report says, in numbers and words, from a run folder alone.

>>> content = numbers_of(run)
>>> content.summary, content.tiles
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from mstfilter.scoring import components, one_blob, weighted_coverage
from mstfilter.study import RunFolder

__all__ = ["Numbers", "Step", "different", "numbers_of", "seconds_text"]

_SLOTS = ("initial", "transition", "proposal", "update", "resampler", "build")


@dataclass(frozen=True)
class Step:
    """One pause: what info.json and seconds.json say, and the floors.

    Parameters
    ----------
    info, seconds : mapping
        As in the run folder.
    objects : list of int
        Number of objects of each hypothesis.
    distinct : int
        Different hypotheses.
    floors : mapping or None
        Weighted mean quality of trivial baselines; None without truth.
    true_objects : int or None
        Number of objects of the truth.
    time, clip_seconds : float or None
        Time of the pause, and since the last one, in the recording.
    """

    info: Mapping[str, Any]
    seconds: Mapping[str, float]
    objects: Sequence[int]
    distinct: int
    floors: Mapping[str, float] | None
    true_objects: int | None
    time: float | None
    clip_seconds: float | None

    @property
    def weights(self) -> list[float]:
        """Normalised weights."""
        return list(self.info["weights"])

    @property
    def quality(self) -> Mapping[str, Sequence[float]] | None:
        """Quality of each hypothesis, by form."""
        return self.info.get("quality")

    @property
    def wall(self) -> float:
        """Seconds of the whole step."""
        return float(sum(self.seconds.values()))

    @property
    def mean_objects(self) -> float:
        """Weighted mean number of objects."""
        return float(np.dot(self.objects, self.weights))

    def mean(self, form: str = "objects") -> float | None:
        """Weighted mean quality; None without truth."""
        return None if self.quality is None else float(np.dot(self.quality[form], self.weights))

    @property
    def best(self) -> float | None:
        """Quality of the hypothesis that is nearest to the truth: what choosing perfectly would give."""
        return None if self.quality is None else max(self.quality["objects"])

    @property
    def floor(self) -> float | None:
        """The better of the floors."""
        return None if self.floors is None else max(self.floors.values())

    def parents(self, kind: str) -> list[int] | None:
        """``"previous"`` or ``"proposed"`` parents, None where they were not recorded."""
        found = (self.info.get("parents") or {}).get(kind)
        return None if found is None else list(found)

    def notes(self, slot: str) -> Mapping[str, Any]:
        """What a component recorded; nothing where it only passed another's notes on."""
        notes = self.info.get("notes") or {}
        own = notes.get(slot) or {}
        for earlier in notes:
            if earlier == slot:
                break
            if notes[earlier] == own:
                return {}
        return own if isinstance(own, Mapping) else {"notes": own}


@dataclass(frozen=True)
class Numbers:
    """A whole run in numbers."""

    description: Mapping[str, Any]
    steps: Sequence[Step] = field(default_factory=tuple)

    @property
    def title(self) -> str:
        """Name of the recording."""
        return str(self._recording.get("name") or "A run")

    @property
    def status(self) -> str:
        """How far the run went: running, interrupted, failed, done."""
        return str(self.description.get("status", "unknown"))

    @property
    def _recording(self) -> Mapping[str, Any]:
        found = self.description.get("recording")
        return found if isinstance(found, Mapping) else {}

    @cached_property
    def slots(self) -> list[str]:
        """Parts that took time or recorded something, in the order of a step."""
        used = {s for step in self.steps for s in (*step.seconds, *(step.info.get("notes") or {}))}
        return [s for s in _SLOTS if s in used] + sorted(used - set(_SLOTS))

    def component(self, slot: str) -> str:
        """Name of the component of a slot, empty where unknown."""
        config = self.description.get("config")
        part = config.get(slot) if isinstance(config, Mapping) else None
        name = part.get("component", "") if isinstance(part, Mapping) else part
        return str(name).rsplit(":", 1)[-1] if name else ""

    @property
    def with_truth(self) -> list[int]:
        """Pauses whose quality is known."""
        return [t for t, step in enumerate(self.steps) if step.quality is not None]

    @property
    def summary(self) -> list[str]:
        """The run in one to four sentences."""
        planned = len(self._recording.get("pauses") or ())
        done = len(self.steps)
        first = []
        if self.status != "done":
            said = {"running": "has not ended", "interrupted": "was interrupted", "failed": "failed"}
            first.append(f"The run {said.get(self.status, self.status)}: {done} of {planned or '?'} pauses are here.")
        if not done:
            return first or ["The run holds no pause."]
        last = self.steps[-1]
        n = len(last.weights)
        same = "" if last.distinct == n else f" ({different(last)})"
        objects = sorted(set(last.objects))
        held = _count(objects[0], "object") if len(objects) == 1 else f"{objects[0]} to {objects[-1]} objects"
        there = "" if last.true_objects is None else f"; there are {last.true_objects}"
        hypotheses = _count(n, "hypothesis", "hypotheses")
        first.append(f"{hypotheses}{same} after {_count(done, 'pause')}, holding {held}{there}.")
        if last.quality is not None and last.floors is not None:
            mean, floor = last.mean(), last.floor
            assert mean is not None and floor is not None
            floors = " and ".join(f"{name} {value:.2f}" for name, value in last.floors.items())
            first.append(f"Their mean quality against the truth is {mean:.2f}; trivial baselines: {floors}.")
            if mean <= floor + 0.005:
                first.append("That is no better than the baselines.")
        return first

    @property
    def tiles(self) -> list[tuple[str, str, str]]:
        """Key numbers of the last pause: name, value, remark."""
        if not self.steps:
            return []
        last = self.steps[-1]
        n = len(last.weights)
        tiles = [
            ("hypotheses", str(n), different(last)),
            ("objects", f"{last.mean_objects:.1f}", _truth_remark(last)),
        ]
        mean, floor = last.mean(), last.floor
        if mean is not None and floor is not None:
            tiles.append(("quality", f"{mean:.3f}", f"best {last.best:.3f}, floor {floor:.3f}"))
        tiles.append(
            ("effective sample size", f"{last.info['ess']:.3g}", f"of {last.info['n_candidates']} candidates")
        )
        if len(self.steps) > 1:
            tiles.append(("unique ancestors", str(last.info["unique_ancestors"]), f"of {n} particles"))
        walls = [step.wall for step in self.steps]
        tiles.append(("time per step", seconds_text(float(np.mean(walls))), f"slowest {seconds_text(max(walls))}"))
        return tiles


def different(step: Step) -> str:
    """How many hypotheses differ, in words."""
    n = len(step.weights)
    return (
        "all different"
        if step.distinct == n
        else "all the same"
        if step.distinct == 1
        else f"{step.distinct} different"
    )


def _count(n: int, one: str, many: str = "") -> str:
    return f"{n} {one if n == 1 else many or one + 's'}"


def _truth_remark(step: Step) -> str:
    return "weighted mean" if step.true_objects is None else f"weighted mean, true {step.true_objects}"


def seconds_text(value: float) -> str:
    """Seconds in a readable unit."""
    if 0 < value < 0.0005:
        return "< 1 ms"
    if value < 0.0995:
        return f"{1000 * value:.0f} ms"
    return f"{value:.2f} s" if value < 9.95 else f"{value:.0f} s"


def numbers_of(run: RunFolder) -> Numbers:
    """Read all that is no picture."""
    description = run.description
    recording = description.get("recording") or {}
    times = list(recording.get("times") or ())
    steps = []
    for t in range(run.n_pauses):
        info, hypotheses, truth = run.info(t), run.hypotheses(t), run.truth(t)
        floors = None
        if truth is not None:
            floors = {"one blob": 0.0, "connected components": 0.0}
            known: dict[bytes, tuple[float, float]] = {}
            for h, w in zip(hypotheses, info["weights"], strict=True):
                if h.key not in known:
                    both = (one_blob(h.labels), components(h.labels))
                    known[h.key] = tuple(weighted_coverage(b, truth) for b in both)  # type: ignore[assignment]
                for name, value in zip(floors, known[h.key], strict=True):
                    floors[name] += w * value
        time = float(times[t]) if t < len(times) else None
        steps.append(
            Step(
                info=info,
                seconds=run.seconds(t),
                objects=[h.n_objects for h in hypotheses],
                distinct=len({h.key for h in hypotheses}),
                floors=floors,
                true_objects=None if truth is None else len(set(np.unique(truth).tolist()) - {0}),
                time=time,
                clip_seconds=None if time is None or t == 0 else time - float(times[t - 1]),
            )
        )
    return Numbers(description, tuple(steps))
