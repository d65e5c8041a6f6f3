"""Which object is which, over hypotheses and over time, so that the same object keeps its colour.

>>> identities = identity_colours(run)              # Identities of a whole run
>>> identities.of(t, hypothesis_index)              # {label: identity 0, 1, 2, ...}
>>> identities.colours(t, hypothesis_index)         # {label: (r, g, b)}

Hypotheses number their objects on their own, so labels say nothing across them. Within one pause, objects are
alike where their voxels overlap. From pause to pause an object is followed through the hypothesis it descends
from by its stable id, wherever it has moved; else by the overlap with what was seen there at the last pause.
Truth, where present, takes part first, as one more hypothesis whose labels persist. The assignment is for the
eye alone: it enters no number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mstfilter.report.palette import Colour, colour
from mstfilter.scene import Hypothesis
from mstfilter.scoring import overlap
from mstfilter.study import RunFolder

__all__ = ["Identities", "by_weight", "identity_colours"]

TRUTH = -1  # stands where the index of a hypothesis stands

_INHERITED = 0.5  # what descent is worth beside an overlap (Jaccard index) of 1 at this pause
_EARLIER = 0.4  # what an overlap of 1 with the last pause is worth
_LEAST = 0.2  # less evidence than this makes a new identity
_PERSISTS = 2.0  # labels of the truth outweigh any overlap
_REFERENCES = 6  # hypotheses of a pause that later ones are compared with


@dataclass(frozen=True)
class Identities:
    """Identity of every object of every hypothesis.

    Parameters
    ----------
    table : mapping
        ``(pause, hypothesis) -> {label: identity}``; hypothesis -1 is the truth.
    """

    table: Mapping[tuple[int, int], Mapping[int, int]] = field(default_factory=dict)

    def of(self, t: int, k: int) -> Mapping[int, int]:
        """``{label: identity}`` of hypothesis `k` (-1: the truth) at pause `t`."""
        return self.table.get((t, k), {})

    def colours(self, t: int, k: int) -> dict[int, Colour]:
        """``{label: (r, g, b)}`` of hypothesis `k` (-1: the truth) at pause `t`."""
        return {label: colour(identity) for label, identity in self.of(t, k).items()}


def identity_colours(run: RunFolder) -> Identities:
    """Identities of all objects of a run, pause by pause."""
    book = _Book()
    for t in range(run.n_pauses):
        info = run.info(t)
        parents = dict(info.get("parents") or {}).get("previous")
        book.add(t, run.hypotheses(t), info["weights"], parents, run.truth(t))
    return Identities(book.table)


class _Book:
    """Identities so far, and where each was last seen."""

    def __init__(self) -> None:
        self.table: dict[tuple[int, int], dict[int, int]] = {}
        self._ids: dict[tuple[int, int], dict[int, int]] = {}  # (pause, hypothesis) -> {stable id: identity}
        # Voxels with identity + 1 (0 none) of the truth and the heaviest hypotheses: of this pause, of the last.
        self._now: list[np.ndarray] = []
        self._before: list[np.ndarray] = []
        self._n = 0

    def add(
        self,
        t: int,
        hypotheses: Sequence[Hypothesis],
        weights: Sequence[float],
        parents: Sequence[int] | None,
        truth: np.ndarray | None,
    ) -> None:
        """All hypotheses of a pause: truth first, then by weight."""
        self._before, self._now = self._now, []
        if truth is not None:
            labels = np.flatnonzero(np.bincount(truth.ravel(), minlength=1)[1:]) + 1
            ids = {int(k): int(k) for k in labels}
            self._assign(t, TRUTH, truth, ids, self._ids.get((t - 1, TRUTH), {}), _PERSISTS)
        first: dict[bytes, int] = {}
        for k in by_weight(weights):
            h = hypotheses[k]
            ids = {o.label: o.id for o in h.objects}
            same = first.setdefault(h.key, k)
            if same != k:
                self.table[t, k] = self.table[t, same]
                self._ids[t, k] = {ids[label]: identity for label, identity in self.table[t, k].items()}
                continue
            parent = -2 if parents is None else int(parents[k])
            self._assign(t, k, h.labels, ids, self._ids.get((t - 1, parent), {}), _INHERITED)

    def _assign(
        self,
        t: int,
        k: int,
        labels: np.ndarray,
        ids: Mapping[int, int],
        inherited: Mapping[int, int],
        descent: float,
    ) -> None:
        from scipy.optimize import linear_sum_assignment

        own = list(ids)
        score = np.zeros((len(own), self._n))
        if own and self._n:
            for images, worth in ((self._now, 1.0), (self._before, _EARLIER)):
                overlaps = [_overlaps(labels, image, own, self._n) for image in images]
                if overlaps:
                    score += worth * np.max(overlaps, axis=0)
        for row, label in enumerate(own):
            identity = inherited.get(ids[label])
            if identity is not None:
                score[row, identity] += descent
        rows, columns = linear_sum_assignment(-score)
        pairs = zip(rows.tolist(), columns.tolist(), strict=True)
        found = {own[r]: int(c) for r, c in pairs if score[r, c] >= _LEAST}
        for label in own:
            if label not in found:
                found[label] = self._n
                self._n += 1
        self.table[t, k] = {label: found[label] for label in own}
        self._ids[t, k] = {ids[label]: found[label] for label in own}
        if len(self._now) < _REFERENCES:
            lookup = np.zeros(int(labels.max()) + 1, np.int64)
            for label, identity in found.items():
                lookup[label] = identity + 1
            self._now.append(lookup[labels])


def by_weight(weights: Sequence[float]) -> list[int]:
    """Indices from the heaviest to the lightest; equal ones in their order."""
    return sorted(range(len(weights)), key=lambda k: -weights[k])


def _overlaps(labels: np.ndarray, image: np.ndarray, own: list[int], n: int) -> np.ndarray:
    """Jaccard indices (len(own), n) of objects and identities."""
    table = overlap(labels, image)
    jaccard = table.jaccard()
    out = np.zeros((len(own), n))
    where = {int(label): row for row, label in enumerate(table.labels_a)}
    present = table.labels_b > 0
    for row, label in enumerate(own):
        if label in where:
            out[row, table.labels_b[present] - 1] = jaccard[where[label], present]
    return out
