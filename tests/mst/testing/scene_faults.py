"""Completers, motion rules, evidence and other parts of scenes with one fault each.

Each table maps the name of a fault to a faulty component and to words of the error, or of the warning, that names it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.mst.completion import Completer, Extrude
from mstfilter.mst.crossover import SpanningTree, Structure
from mstfilter.mst.partition import PairOdds
from mstfilter.mst.segmentation import (
    BoundaryModel,
    ColourDepthBoundary,
    CutSampler,
    CutValue,
    ExactCuts,
    LearnedTree,
    MergeLogOdds,
    TreeBuilder,
)
from mstfilter.mst.tracking import IDENTITY, Candidate, MaskTracker, MotionRule, Registration, SmallGicp
from mstfilter.scene import Evidence, Projection
from tests.mst.testing import of, plainly

#: What a faulty component does with a correct result.
Change = Callable[..., Any]


def with_value(p: np.ndarray, value: float) -> np.ndarray:
    """An array with another value in one place."""
    out = np.array(p, dtype=np.float64)
    out.flat[0] = value
    return out


def logits(p: np.ndarray) -> np.ndarray:
    p = np.clip(p, 1e-3, 1 - 1e-3)
    return np.log(p / (1 - p))


def one_over_zero(p: np.ndarray) -> Any:
    raise ZeroDivisionError("my own fault")


@dataclass(frozen=True)
class Completes(Completer):
    """Extrudes, then changes the result."""

    change: Change = field(default=lambda p: p)

    def fill(self, rng, seen):
        return self.change(Extrude().fill(rng, seen))


@dataclass(frozen=True)
class CompletesMany(Completes):
    """The same in the method for several boxes."""

    def fill(self, rng, seen):
        return Extrude().fill(rng, seen)

    def fill_many(self, rngs, seen):
        return [self.change(self.fill(rng, one)) for rng, one in zip(rngs, seen, strict=True)]


@dataclass(frozen=True)
class CompletesEach(Completes):
    """The same in the method for whole masks."""

    def fill(self, rng, seen):
        return Extrude().fill(rng, seen)

    def complete_each(self, rngs, frame, masks, grid, views=None):
        found = super().complete_each(rngs, frame, masks, grid, views)
        return [replace(one, probability=self.change(one.probability)) for one in found]


def writes_into_the_box(rng, seen):
    seen.surface[:] = True
    return seen.surface.astype(float)


WritesIntoTheBox = of(Completer, fill=plainly)(writes_into_the_box)
DrawsUndeclared = of(Completer, fill=lambda f, rng, seen: Extrude().fill(rng, seen) * f(rng))(
    lambda rng: rng.uniform(0.9, 1.0)
)
#: Its results differ from call to call; a run cannot know.
DrawsFromItsOwn = of(Completer, {"stochastic": True}, fill=lambda f, rng, seen: Extrude().fill(rng, seen) * f())(
    lambda: np.random.default_rng().uniform(0.9, 1.0)
)


@dataclass(frozen=True)
class DependsOnCalls(Completer):
    calls: list = field(default_factory=list)

    def fill(self, rng, seen):
        self.calls.append(1)
        return Extrude().fill(rng, seen) / len(self.calls)


#: Changes of the probabilities (a, b, c) of a box that a run reports.
PROBABILITIES: dict[str, tuple[Change, str]] = {
    "logits": (logits, "of logits"),
    "log probabilities": (lambda p: np.log(np.maximum(p, 1e-9)), "of log probabilities"),
    "percent": (lambda p: 100 * p, "divide by 100"),
    "one nan": (lambda p: with_value(p, np.nan), "returns nan in 1 of"),
    "too large": (lambda p: with_value(p, 1.2), "to 1.2, expected 0 to 1"),
    "axes": (lambda p: p.transpose(2, 1, 0), "are the axes exchanged?"),
    "flat": (lambda p: p.ravel(), "is it flattened?"),
    "none": (lambda p: None, "does every branch of the method return it?"),
    "list": (lambda p: p.tolist(), "returns a list"),
    "exception": (one_over_zero, "my own fault"),
}
#: Other types of the same numbers, which are correct.
GOOD_PROBABILITIES: dict[str, Change] = {
    "float16": lambda p: p.astype(np.float16),
    "bool": lambda p: p > 0.5,
    "rounded": lambda p: p.astype(np.float32) * np.float32(1.0000002),
    "read-only": lambda p: np.broadcast_to(p, p.shape),
}
#: Changes that a run warns about once.
STRANGE_PROBABILITIES: dict[str, tuple[Change, str]] = {
    "constant": (lambda p: np.full_like(p, 0.3), "returns a constant: 0.3"),
    "below a half": (lambda p: 0.45 * p, "leaves the visible surface empty"),
    "complement": (lambda p: 1 - p, "leaves the visible surface empty"),
}
#: Completers, and words of the failure of their contract.
COMPLETERS: dict[str, tuple[Completer, str]] = {
    "writes": (WritesIntoTheBox(), "in place"),
    "draws": (DrawsUndeclared(), "`stochastic` is False"),
    "own generator": (DrawsFromItsOwn(), "does not come from `rng`"),
    "state": (DependsOnCalls(), "keeps state"),
    "reversed": (Completes(change=lambda p: p[::-1]), "if the axes (0,) of the result are reversed"),
    "upside down": (Completes(change=lambda p: p[:, :, ::-1]), "if the axes (2,) of the result are reversed"),
    **{name: (Completes(change=change), words) for name, (change, words) in STRANGE_PROBABILITIES.items()},
}

SHIFT = RigidTransform.from_translation([0.01, 0.0, 0.0])


def matrix(scale: float = 1.0, reflect: bool = False) -> RigidTransform:
    T = np.diag([-scale if reflect else scale, scale, scale, 1.0])
    T[0, 3] = 0.02
    return RigidTransform(T, normalize=False)


@dataclass(frozen=True)
class Moves(MotionRule):
    """Returns what a function of a correct result gives."""

    change: Change = field(default=lambda found: found)

    def candidates(self, rng, track):
        return self.change((IDENTITY, Candidate("mine", SHIFT, 3, 0.5)))

    def choose(self, rng, candidates):
        return candidates[-1]


@dataclass(frozen=True)
class Chooses(MotionRule):
    """Chooses what a function of the candidates gives."""

    change: Change = field(default=lambda found: found[0])

    def candidates(self, rng, track):
        return IDENTITY, Candidate("mine", SHIFT)

    def choose(self, rng, candidates):
        return self.change(candidates)


def one_with(**fields: Any) -> Change:
    return lambda found: (replace(found[1], **fields),)


def nan_shift() -> RigidTransform:
    return RigidTransform.from_translation([np.nan, 0, 0])


#: Changes of the candidates of a rule.
MOTIONS: dict[str, tuple[Change, str]] = {
    "none": (lambda found: None, "returns None, expected a tuple of Candidate"),
    "empty": (lambda found: (), "returns no candidate"),
    "one candidate": (lambda found: found[0], "return (candidate,)"),
    "candidate of a matrix": (one_with(T=np.eye(4)), "whose T is an array of shape (4, 4)"),
    "nan shift": (lambda found: (replace(found[1], T=nan_shift()),), "not finite"),
    "reflection": (one_with(T=matrix(reflect=True)), "it is a reflection"),
    "kind": (one_with(kind=3), "whose kind is 3"),
    "share as support": (one_with(support=0.4), "whose support is 0.4"),
    "exception": (one_over_zero, "my own fault"),
}
CHOICES: dict[str, tuple[Change, str]] = {
    "none": (lambda found: None, "returns None, expected a Candidate"),
}
#: A motion in millimetres, of which a run warns once.
TOO_FAR = one_with(T=RigidTransform.from_translation([15.0, 0, 0]))


def writes_into_the_track(rng, track):
    track.points[:, 0] += 0.1
    return (IDENTITY,)


WritesIntoTheTrack = of(MotionRule, candidates=plainly, choose=lambda f, rng, candidates: candidates[0])(
    writes_into_the_track
)


@dataclass(frozen=True)
class RuleDependsOnCalls(MotionRule):
    calls: list = field(default_factory=list)

    def candidates(self, rng, track):
        self.calls.append(1)
        return (Candidate("mine", RigidTransform.from_translation([1e-4 * len(self.calls), 0, 0])),)

    def choose(self, rng, candidates):
        return candidates[0]


@dataclass(frozen=True)
class Scores(Evidence):
    """Prefers hypotheses with many objects; then changes the scores."""

    change: Change = field(default=lambda s: s)

    def log_score(self, hypotheses, clip):
        return self.change(np.array([float(h.n_objects) for h in hypotheses]))


#: Changes of scores (n,).
SCORES: dict[str, tuple[Change, str]] = {
    "none": (lambda s: None, "returns None"),
    "nan": (lambda s: with_value(s, np.nan), "returns nan in 1 of"),
    "all -inf": (lambda s: np.full_like(s, -np.inf), "bound it from below"),
    "exception": (one_over_zero, "my own fault"),
}
GOOD_SCORES: dict[str, Change] = {
    "int": lambda s: s.astype(int),
    "strided": lambda s: np.repeat(s, 2)[::2],
}


def faulty(interface: type, method: str, correct: Any, change: Change) -> Any:
    """A component of an interface whose method changes the result of a correct component."""

    def changed(self, *arguments, **named):
        return change(getattr(correct, method)(*arguments, **named))

    def unchanged(name):
        return lambda self, *arguments: getattr(correct, name)(*arguments)

    others = {name: unchanged(name) for name in interface.__abstractmethods__ if name != method}
    return dataclass(frozen=True)(type("Faulty", (interface,), {method: changed, **others}))()


class _Known:
    """Correct parts without behaviour of their own."""

    def track(self, clip, masks):
        return list(masks)

    def project(self, hypothesis, frame):
        return hypothesis, 1.0

    def divide(self, clip):
        return np.zeros(clip.after.depth.shape, np.int32)

    def log_odds(self, cells, weights, clip):
        return np.zeros(len(cells.pairs))


#: Interface, method and correct component of other parts of scenes, by the first word of the faults below.
PARTS: dict[str, tuple[type, str, Any]] = {
    "boundary": (BoundaryModel, "boundary", ColourDepthBoundary()),
    "tree": (TreeBuilder, "build", LearnedTree()),
    "values": (CutValue, "values", MergeLogOdds()),
    "cuts": (CutSampler, "sample", ExactCuts()),
    "masks": (MaskTracker, "track", _Known()),
    "registration": (Registration, "register", SmallGicp()),
    "projection": (Projection, "project", _Known()),
    "pairs": (PairOdds, "log_odds", _Known()),
    "structure": (Structure, "draw", SpanningTree()),
}


def cut_short(sample: Any) -> Any:
    return replace(sample, cuts=tuple(cut[:-1] for cut in sample.cuts))


def scaled(found: Any) -> Any:
    return None if found is None else replace(found, T=np.diag([2.0, 2, 2, 1]))


#: Changes of their results.
OTHERS: dict[str, tuple[Change, str]] = {
    "boundary 0..255": (lambda b: 255 * b, "expected 0 to 1"),
    "tree parents": (lambda t: t.parent, "expected a Tree"),
    "values nan": (lambda w: with_value(w, np.nan), "returns nan"),
    "cuts partial": (cut_short, "no partition of the image"),
    "masks stacked": (np.array, "expected a list of masks"),
    "registration scale": (scaled, "its scale is 2"),
    "projection alone": (lambda p: p[0], "expected a hypothesis and a share"),
    "projection percent": (lambda p: (p[0], 98.0), "expected a number from 0 to 1"),
    "pairs nan": (lambda o: np.full_like(o, np.nan), "returns nan"),
    "structure backwards": (lambda d: (d[0], [(b, a) for a, b in d[1]]), "painted after its parent"),
}

CORRECT = (Extrude(), Completes(), CompletesMany(), CompletesEach(), Moves(), Chooses(), Scores())


def _errors() -> Iterator[tuple[str, tuple[Any, str, str]]]:
    """Name, component, method, words."""
    for kind, method, table in (
        (Completes, "fill", PROBABILITIES),
        (Moves, "candidates", MOTIONS),
        (Chooses, "choose", CHOICES),
        (Scores, "log_score", SCORES),
    ):
        for name, (change, words) in table.items():
            yield f"{method}: {name}", (kind(change=change), method, words)
    for name, (change, words) in OTHERS.items():
        part = PARTS[name.split()[0]]
        yield name, (faulty(*part, change), part[1], words)


#: Components whose results are errors of a run and of the contract.
ERRORS = dict(_errors())
#: Components that a run warns of once.
WARNINGS = {
    **{name: (Completes(change=change), words) for name, (change, words) in STRANGE_PROBABILITIES.items()},
    "too far": (Moves(change=TOO_FAR), "motions are in metres"),
}


@dataclass(frozen=True)
class DrawsGlobally(BoundaryModel):
    """A boundary map with random numbers of the global generator."""

    def boundary(self, frame):
        strength = ColourDepthBoundary().boundary(frame)
        return np.clip(strength + np.random.rand(*strength.shape), 0, 1).astype(np.float32)  # noqa: NPY002


#: Components that only the contract finds, or also a run.
ONLY_BROKEN: dict[str, tuple[Any, str]] = {
    **COMPLETERS,
    "global generator": (DrawsGlobally(), "does not come from `rng`"),
    "track": (WritesIntoTheTrack(), "in place"),
    "state of a rule": (RuleDependsOnCalls(), "keeps state"),
    "far": (Moves(change=TOO_FAR), "moves an object too far: by 15 m"),
}
#: Components with correct results of other types.
OTHER_TYPES = [
    *(kind(change=change) for kind in (Completes, CompletesMany) for change in GOOD_PROBABILITIES.values()),
    *(Scores(change=change) for change in GOOD_SCORES.values()),
]
