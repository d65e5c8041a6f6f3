"""What the report says, in numbers and words, from a run folder alone.

>>> content = numbers_of(run)
>>> content.summary, content.tiles


The report of a run: one HTML file that needs nothing beside it.

>>> write_report("runs/demo")                     # runs/demo/report.html
>>> write_report("runs/demo", "demo.html")

It is made from the run folder alone, of a run that is done or was interrupted, wherever the folder has been moved,
and loads no code of the user: components are known by what they recorded. Pictures are embedded, figures are inline
SVG, there is no script and no link. Times of the steps aside, the same run gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.report.figures import genealogy_figure, health_figure, quality_figure
from mstfilter.report.identities import cards_of_pause, close_up, data_uri, identity_colours, truth_card
from mstfilter.report.page import counts, flatten, note_rows, render, shown, write_page
from mstfilter.report.pictures import jpeg_bytes, viewpoint
from mstfilter.runs import RunFolder
from mstfilter.scoring import connected_components, one_blob, weighted_coverage

__all__ = ["Numbers", "Step", "different", "numbers_of", "seconds_text", "write_report"]

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
                    both = (one_blob(h.labels), connected_components(h.labels))
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


_TITLES = {
    "initial": "Initial particles",
    "transition": "Transition",
    "proposal": "Proposal",
    "update": "Update",
    "resampler": "Resampling",
    "build": "Building the chosen",
}


def write_report(run: RunFolder | str | Path, out: str | Path | None = None) -> Path:
    """Write the report of a run folder.

    Parameters
    ----------
    run : RunFolder or path
        The run, finished or not.
    out : path, optional
        The HTML file. Default: ``report.html`` in the run folder.

    Returns
    -------
    Path
        The file, written under a temporary name and renamed.

    Raises
    ------
    InputError
        The folder is no run folder, or the file cannot be written.
    """
    run = RunFolder.open(run.path if isinstance(run, RunFolder) else run)
    path = run.path / "report.html" if out is None else Path(out)
    return write_page(path, _page(run))


def _page(run: RunFolder) -> str:
    filters: dict[str, Callable[..., Any]] = dict(
        different=different, shown=shown, seconds=seconds_text, percent=lambda x: f"{100 * x:.3g} %"
    )
    numbers = numbers_of(run)
    return render(
        "report.html",
        filters,
        run=numbers,
        pauses=_pauses(run, numbers),
        figures=_figures(numbers),
        parts=[_part(numbers, slot) for slot in numbers.slots],
        config=_config(numbers.description.get("config") or {}),
        facts=_facts(numbers.description),
    )


def _pauses(run: RunFolder, numbers: Numbers) -> list[dict[str, Any]]:
    """Pictures of all pauses."""
    if not numbers.steps:
        return []
    identities = identity_colours(run)
    volumes: list[tuple[Any, Any]] = []
    for t in range(len(numbers.steps)):
        hypotheses, truth = run.hypotheses(t), run.truth(t)
        volumes.extend((h.labels, h.grid) for h in hypotheses)
        if truth is not None:
            volumes.append((truth, hypotheses[0].grid))
    view = viewpoint(volumes, run.camera(0))
    pauses = []
    for t, step in enumerate(numbers.steps):
        camera = run.camera(t)
        cards, hidden = cards_of_pause(run, t, identities, view)
        pauses.append(
            {
                "t": t,
                "step": step,
                "photo": data_uri(jpeg_bytes(run.rgb(t)), "jpeg"),
                "width": camera.width,
                "height": camera.height,
                "close_up": close_up(volumes, camera),
                "cards": cards,
                "hidden": hidden,
                "truth": truth_card(run, t, identities, view),
            }
        )
    return pauses


def _figures(numbers: Numbers) -> dict[str, Any]:
    """Inline SVG by name."""
    from markupsafe import Markup

    steps = numbers.steps
    if not steps:
        return {}
    found = {}
    known = numbers.with_truth
    if known:
        floors = {name: [steps[t].floors[name] for t in known] for name in steps[known[0]].floors or ()}  # type: ignore[index]
        qualities = [steps[t].quality["objects"] for t in known]  # type: ignore[index]
        found["quality"] = quality_figure(known, qualities, [steps[t].weights for t in known], floors)
    if len(steps) == 1:  # the tiles say it all
        return {name: Markup(svg) for name, svg in found.items()}
    found["health"] = health_figure(
        range(len(steps)),
        [(step.info["ess"], step.info["n_candidates"]) for step in steps],
        [None if t == 0 else (step.info["unique_ancestors"], step.info["n"]) for t, step in enumerate(steps)],
    )
    found["genealogy"] = genealogy_figure(
        [step.weights for step in steps],
        [step.parents("previous") for step in steps],
        [step.parents("proposed") for step in steps],
    )
    return {name: Markup(svg) for name, svg in found.items()}


def _part(numbers: Numbers, slot: str) -> dict[str, Any]:
    """What a component did, over all pauses."""
    notes = [step.notes(slot) for step in numbers.steps]
    bars = []
    for key, table in counts(notes).items():
        names = sorted({name for row in table for name in row}, key=lambda n: (-sum(r.get(n, 0) for r in table), n))
        bars.append({"key": key, "names": names, "rows": table})
    barred = {bar["key"] for bar in bars}
    rest = [{k: v for k, v in note.items() if k not in barred} for note in notes]
    return {
        "slot": slot,
        "title": _TITLES.get(slot, slot),
        "component": numbers.component(slot),
        "bars": bars,
        "rows": note_rows(rest),
        "seconds": [step.seconds.get(slot, 0.0) for step in numbers.steps],
    }


def _config(config: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Configuration as ``path = value``, grouped by slot, plain values of the filter first."""
    plain = [(k, shown(v)) for k, v in config.items() if not isinstance(v, Mapping)]
    groups = [("filter", plain)] if plain else []
    for slot, part in config.items():
        if isinstance(part, Mapping):
            rows = [(k.removesuffix(".component"), shown(v)) for k, v in flatten(part, slot).items()]
            groups.append((_TITLES.get(slot, slot), rows))
    return groups


def _facts(description: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What was run, for the end of the page."""
    recording = description.get("recording") or {}
    facts = [
        ("preset", str(description.get("description") or "–")),
        ("seed", shown(description.get("seed"))),
        ("status", str(description.get("status", "–"))),
        ("recording", str(recording.get("name", "–"))),
        ("recording key", str(recording.get("key", "–"))),
        ("generator", shown(recording.get("generator"))),
    ]
    facts += [(name, str(version)) for name, version in (description.get("versions") or {}).items()]
    return [fact for fact in facts if fact[1] not in ("", "–")]
