"""Properties of the terms that score built hypotheses."""

from __future__ import annotations

from typing import Any

import numpy as np

from mstfilter.fusion import Evidence
from mstfilter.scene import Hypothesis
from mstfilter.testing.properties import Broken, Example, Suite, Untouched, guarded

__all__ = ["EVIDENCE"]

EVIDENCE = Suite("evidence")


def _scene(example: Example, n: int) -> tuple[tuple[Hypothesis, ...], Any]:
    population, clip = example(np.random.default_rng(0), n)
    return tuple(population.realised().particles), clip


def _score(component: Evidence, hypotheses: tuple[Hypothesis, ...], clip: Any) -> np.ndarray:
    with guarded(f"{len(hypotheses)} hypotheses"):
        found = np.asarray(component.log_score(hypotheses, clip))
    if found.shape != (len(hypotheses),):
        raise Broken(
            f"scores of {len(hypotheses)} hypotheses have shape {found.shape}, expected ({len(hypotheses)},)"
        )
    return found


def _differ(a: np.ndarray, b: np.ndarray) -> bool:
    return not np.allclose(a, b, rtol=1e-9, atol=1e-9)


@EVIDENCE.property("it gives one finite number a hypothesis", essential=True)
def scores_are_finite(component: Evidence, example: Example) -> None:
    """For one, two and nine hypotheses."""
    for n in (1, 2, 9):
        scores = _score(component, *_scene(example, n))
        if not np.isfinite(scores).all():
            raise Broken(f"a score is {scores[~np.isfinite(scores)][0]}: rule nothing out for certain")


@EVIDENCE.property("equal hypotheses have equal scores")
def copies_score_the_same(component: Evidence, example: Example) -> None:
    """Every hypothesis given twice, the copy made anew."""
    hypotheses, clip = _scene(example, 5)
    copies = tuple(Hypothesis.from_labels(h.labels.copy(), h.grid) for h in hypotheses)
    scores = _score(component, hypotheses + copies, clip)
    if _differ(scores[:5], scores[5:]):
        raise Broken("a hypothesis and its copy have different scores")


@EVIDENCE.property("the order of the hypotheses does not matter")
def order_of_hypotheses_is_irrelevant(component: Evidence, example: Example) -> None:
    """The same nine in another order."""
    hypotheses, clip = _scene(example, 9)
    order = np.random.default_rng(1).permutation(9)
    shuffled = _score(component, tuple(hypotheses[k] for k in order), clip)
    if _differ(shuffled, _score(component, hypotheses, clip)[order]):
        raise Broken("the same hypotheses in another order have other scores")


@EVIDENCE.property("what the labels are called does not matter")
def names_of_labels_are_irrelevant(component: Evidence, example: Example) -> None:
    """Labels exchanged, with gaps between them."""
    hypotheses, clip = _scene(example, 9)
    rng, renamed = np.random.default_rng(2), []
    for hypothesis in hypotheses:
        n = int(hypothesis.labels.max())
        table = np.concatenate([[0], 3 + 5 * rng.permutation(n)]).astype(np.uint16)
        renamed.append(Hypothesis.from_labels(table[hypothesis.labels], hypothesis.grid))
    if _differ(_score(component, tuple(renamed), clip), _score(component, hypotheses, clip)):
        raise Broken("other names for the same labels give other scores")


@EVIDENCE.property("it leaves hypotheses and clip alone and keeps no memory")
def evidence_has_no_memory(component: Evidence, example: Example) -> None:
    """Asked again it says the same."""
    hypotheses, clip = _scene(example, 9)
    before = Untouched(hypotheses=list(hypotheses), frames=list(clip.frames))
    scores = [_score(component, hypotheses, clip) for _ in range(2)]
    before.verify()
    if _differ(*scores):
        raise Broken("asked again its scores are others")
