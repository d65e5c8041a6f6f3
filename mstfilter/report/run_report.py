"""The report of a run: one self-contained HTML file.

>>> write_report("runs/demo")                     # runs/demo/report.html
>>> write_report("runs/demo", "demo.html")

The report is made from the run folder alone, of a finished or an interrupted run, and loads no code of the user.
Pictures are embedded, figures are inline SVG, there are no scripts and no links. The same run gives the same bytes,
except for the times of the steps.

`read_numbers` collects the numbers and sentences of the report.

>>> numbers = read_numbers(run)
>>> numbers.summary, numbers.tiles
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.report.figures import genealogy_figure, health_figure, quality_figure, reliability_figure
from mstfilter.report.identities import assign_identities, cards_of_pause, truth_card
from mstfilter.report.page import (
    counts_by_key,
    fill_template,
    flatten,
    note_rows,
    seconds_text,
    short_text,
    write_page,
)
from mstfilter.report.pictures import close_up, data_uri, jpeg_bytes, viewpoint
from mstfilter.runs import RunFolder
from mstfilter.scoring import (
    BeliefScore,
    connected_components,
    forecast_table,
    one_blob,
    score_belief,
    weighted_coverage,
)

_TITLES = {
    "initial": "Initial particles",
    "transition": "Transition",
    "proposal": "Proposal",
    "update": "Update",
    "resampler": "Resampling",
    "build": "Building the resampled hypotheses",
}
_BASELINES = {"one blob": one_blob, "connected components": connected_components}


@dataclass(frozen=True)
class PauseNumbers:
    """Numbers of one pause."""

    info: Mapping[str, Any]  #: contents of info.json
    seconds: Mapping[str, float]  #: contents of seconds.json
    objects: Sequence[int]  #: number of objects of each hypothesis
    n_distinct: int  #: number of distinct hypotheses
    baselines: Mapping[str, float] | None  #: weighted mean quality of trivial baselines; None without ground truth
    true_objects: int | None  #: number of objects in the ground truth
    belief: BeliefScore | None  #: scores of the weighted set; None without ground truth
    time: float  #: time of the pause in the recording
    clip_seconds: float | None  #: time since the last pause; None for the first pause

    @property
    def weights(self) -> list[float]:
        """Normalised weights."""
        return list(self.info["weights"])

    @property
    def quality(self) -> Mapping[str, Sequence[float]] | None:
        """Quality of each hypothesis, by form; None without ground truth."""
        return self.info["quality"]

    @property
    def step_seconds(self) -> float:
        return float(sum(self.seconds.values()))

    @property
    def mean_objects(self) -> float:
        """Weighted mean number of objects."""
        return float(np.dot(self.objects, self.weights))

    @property
    def distinct_text(self) -> str:
        """How many hypotheses differ, in words."""
        if self.n_distinct == len(self.weights):
            return "all different"
        return "all the same" if self.n_distinct == 1 else f"{self.n_distinct} different"

    def mean(self, form: str = "objects") -> float | None:
        """Weighted mean quality; None without ground truth."""
        return None if self.quality is None else float(np.dot(self.quality[form], self.weights))

    @property
    def best(self) -> float | None:
        """Quality of the best hypothesis; None without ground truth."""
        return None if self.quality is None else max(self.quality["objects"])

    def parents(self, kind: str) -> list[int] | None:
        """``"previous"`` or ``"proposed"`` parents; None if they were not recorded."""
        return self.info["parents"].get(kind)

    def notes(self, slot: str) -> Mapping[str, Any]:
        """Notes of a component, without those that it only passed on from an earlier one."""
        notes: Mapping[str, Mapping[str, Any]] = self.info["notes"]
        earlier = itertools.takewhile(lambda name: name != slot, notes)
        chosen = notes.get(slot, {})
        return {} if chosen in [notes[name] for name in earlier] else chosen


@dataclass(frozen=True)
class RunNumbers:
    """Numbers of a run."""

    description: Mapping[str, Any]
    steps: Sequence[PauseNumbers] = field(default_factory=tuple)

    @property
    def title(self) -> str:
        """Name of the recording."""
        return str(self.description["recording"]["name"])

    @property
    def status(self) -> str:
        """Status of the run: running, interrupted, failed, done."""
        return str(self.description["status"])

    @property
    def truth_users(self) -> list[str]:
        """Classes of the components that use the ground truth."""
        return list(self.description["uses_truth"])

    @cached_property
    def slots(self) -> list[str]:
        """Slots with times or notes, in the order of a step."""
        used = {s for step in self.steps for s in (*step.seconds, *step.info["notes"])}
        return [s for s in _TITLES if s in used] + sorted(used - set(_TITLES))

    def component(self, slot: str) -> str:
        """Name of the component of a slot; empty if unknown."""
        part = self.description["config"].get(slot)
        name = part.get("component", "") if isinstance(part, Mapping) else part
        return str(name).rsplit(":", 1)[-1] if name else ""

    @property
    def with_truth(self) -> list[int]:
        """Pauses whose quality is known."""
        return [t for t, step in enumerate(self.steps) if step.quality is not None]

    @property
    def summary(self) -> list[str]:
        """The run in one to four sentences."""
        planned = len(self.description["recording"]["pauses"])
        done = len(self.steps)
        sentences = []
        if self.status != "done":
            verbs = {"running": "has not ended", "interrupted": "was interrupted", "failed": "failed"}
            sentences.append(f"The run {verbs[self.status]}: {done} of {planned} pauses are complete.")
        if not done:
            return sentences or ["The run has no pauses."]
        last = self.steps[-1]
        n = len(last.weights)
        same = "" if last.n_distinct == n else f" ({last.distinct_text})"
        objects = sorted(set(last.objects))
        count = _count(objects[0], "object") if len(objects) == 1 else f"{objects[0]} to {objects[-1]} objects"
        truth = "" if last.true_objects is None else f"; the ground truth has {last.true_objects}"
        hypotheses = _count(n, "hypothesis", "hypotheses")
        sentences.append(f"{hypotheses}{same} after {_count(done, 'pause')}, with {count}{truth}.")
        mean = last.mean()
        if mean is not None and last.baselines is not None:
            baselines = " and ".join(f"{name} {value:.2f}" for name, value in last.baselines.items())
            sentences.append(f"Their mean quality is {mean:.2f}; trivial baselines: {baselines}.")
            if mean <= max(last.baselines.values()) + 0.005:
                sentences.append("That is no better than the baselines.")
        return sentences

    @property
    def tiles(self) -> list[tuple[str, str, str]]:
        """Key numbers of the last pause: name, value, remark."""
        if not self.steps:
            return []
        last = self.steps[-1]
        n = len(last.weights)
        truth = "" if last.true_objects is None else f", true {last.true_objects}"
        tiles = [
            ("hypotheses", str(n), last.distinct_text),
            ("objects", f"{last.mean_objects:.1f}", f"weighted mean{truth}"),
        ]
        mean = last.mean()
        if mean is not None and last.baselines is not None:
            baseline = max(last.baselines.values())
            tiles.append(("quality", f"{mean:.3f}", f"best {last.best:.3f}, baseline {baseline:.3f}"))
        if last.belief is not None:
            row = last.belief.row
            tiles.append(("Brier score", f"{row['brier']:.3f}", f"calibration error {row['calibration_error']:.3f}"))
        tiles.append(
            ("effective sample size", f"{last.info['ess']:.3g}", f"of {last.info['n_candidates']} candidates")
        )
        if len(self.steps) > 1:
            tiles.append(("unique ancestors", str(last.info["unique_ancestors"]), f"of {n} particles"))
        seconds = [step.step_seconds for step in self.steps]
        slowest = f"slowest {seconds_text(max(seconds))}"
        tiles.append(("time per step", seconds_text(float(np.mean(seconds))), slowest))
        return tiles


def _count(n: int, one: str, several: str = "") -> str:
    return f"{n} {one if n == 1 else several or one + 's'}"


def read_numbers(run: RunFolder) -> RunNumbers:
    """Numbers of a run folder."""
    description = run.description
    times = description["recording"]["times"]
    steps = []
    for t in range(run.n_pauses):
        info, hypotheses, truth = run.info(t), run.hypotheses(t), run.truth(t)
        questions = run.questions(t)
        belief = None
        if questions is not None and truth is not None:
            belief = score_belief(questions, [h.labels for h in hypotheses], info["weights"], truth)
        baselines = None
        if truth is not None:
            weight: dict[bytes, float] = {}
            for h, w in zip(hypotheses, info["weights"], strict=True):
                weight[h.key] = weight.get(h.key, 0.0) + w
            distinct = {h.key: h.labels for h in hypotheses}
            baselines = {
                name: sum(w * weighted_coverage(baseline(distinct[key]), truth) for key, w in weight.items())
                for name, baseline in _BASELINES.items()
            }
        steps.append(
            PauseNumbers(
                info=info,
                seconds=run.seconds(t),
                objects=[h.n_objects for h in hypotheses],
                n_distinct=len({h.key for h in hypotheses}),
                baselines=baselines,
                true_objects=None if truth is None else len(set(np.unique(truth).tolist()) - {0}),
                belief=belief,
                time=float(times[t]),
                clip_seconds=None if t == 0 else float(times[t]) - float(times[t - 1]),
            )
        )
    return RunNumbers(description, tuple(steps))


def write_report(run: RunFolder | str | Path, out: str | Path | None = None) -> Path:
    """Write the report of a run, finished or not, as HTML. Default: ``report.html`` in the run folder.

    Returns the file. Raises InputError if the folder is no run folder, or the file cannot be written.
    """
    run = RunFolder.open(run.path if isinstance(run, RunFolder) else run)
    numbers = read_numbers(run)
    filters: dict[str, Callable[..., Any]] = {
        "short_text": short_text,
        "seconds": seconds_text,
        "percent": lambda x: f"{100 * x:.3g} %",
    }
    page = fill_template(
        "report.html",
        filters,
        run=numbers,
        pauses=_pauses(run, numbers),
        figures=_figures(numbers),
        parts=[_part(numbers, slot) for slot in numbers.slots],
        config=_config_rows(numbers.description["config"]),
        facts=_facts(numbers.description),
    )
    return write_page(run.path / "report.html" if out is None else Path(out), page)


def _pauses(run: RunFolder, numbers: RunNumbers) -> list[dict[str, Any]]:
    if not numbers.steps:
        return []
    identities = assign_identities(run)
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


def _figures(numbers: RunNumbers) -> dict[str, Any]:
    """Inline SVG by name."""
    from markupsafe import Markup

    steps = numbers.steps
    found = {}
    known = numbers.with_truth
    if known:
        at = [steps[t] for t in known]
        names = at[0].baselines or ()
        baselines = {name: [step.baselines[name] for step in at if step.baselines] for name in names}
        qualities = [step.quality["objects"] for step in at if step.quality]
        found["quality"] = Markup(quality_figure(known, qualities, [step.weights for step in at], baselines))
    beliefs = [step.belief.counts[0].astype(np.int64) for step in steps if step.belief is not None]
    if beliefs:
        found["reliability"] = Markup(reliability_figure({"all pauses": forecast_table(sum(beliefs))}))
    if len(steps) <= 1:
        return found
    health = health_figure(
        range(len(steps)),
        [(step.info["ess"], step.info["n_candidates"]) for step in steps],
        [None if t == 0 else (step.info["unique_ancestors"], step.info["n"]) for t, step in enumerate(steps)],
    )
    genealogy = genealogy_figure(
        [step.weights for step in steps],
        [step.parents("previous") for step in steps],
        [step.parents("proposed") for step in steps],
    )
    return {**found, "health": Markup(health), "genealogy": Markup(genealogy)}


def _part(numbers: RunNumbers, slot: str) -> dict[str, Any]:
    """Notes and times of a component over all pauses."""
    notes = [step.notes(slot) for step in numbers.steps]
    bars = []
    for key, table in counts_by_key(notes).items():
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


def _config_rows(config: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Configuration as ``path = value``, grouped by slot; first the values of the filter."""
    plain = [(k, short_text(v)) for k, v in config.items() if not isinstance(v, Mapping)]
    groups = [("filter", plain)] if plain else []
    for slot, part in config.items():
        if isinstance(part, Mapping):
            rows = [(k.removesuffix(".component"), short_text(v)) for k, v in flatten(part, slot).items()]
            groups.append((_TITLES.get(slot, slot), rows))
    return groups


def _facts(description: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Preset, seed, recording and versions."""
    recording = description["recording"]
    facts = [
        ("preset", str(description["description"])),
        ("seed", short_text(description["seed"])),
        ("status", str(description["status"])),
        ("recording", str(recording["name"])),
        ("recording key", str(recording["key"])),
        ("generator", short_text(recording["generator"])),
    ]
    facts += [(name, str(version)) for name, version in description["versions"].items()]
    return [fact for fact in facts if fact[1] not in ("", "–")]
