"""Identities of objects across hypotheses and pauses, by which an object has the same colour everywhere.

>>> identities = assign_identities(run)
>>> identities.of(t, k)                             # {label: identity 0, 1, 2, ...} of hypothesis k at pause t
>>> identities.colours(t, k)                        # {label: (r, g, b)}

Each hypothesis numbers its objects independently. The objects in the tables of the run (`RunFolder.tables`) have the
identity ``number - 1``, so pictures, objects.csv and `RunFolder.objects` have the same numbers. Within a pause, other
objects are matched with these by the overlap of their voxels. From pause to pause, an object is matched by its stable
id if its hypothesis has a known parent, otherwise by overlap with objects of the last pause. A label of the ground
truth, if known, has one identity at all pauses: that of the object of the tables with which it shares most voxels.
Identities are used only for display and affect no score.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mstfilter.app.report.pictures import Colour, colour
from mstfilter.mst.belief import ObjectTable
from mstfilter.runs import RunFolder
from mstfilter.scene import Hypothesis
from mstfilter.scoring import overlap
from mstfilter.smc import first_seen

TRUTH = -1  #: Index of the ground truth in place of a hypothesis

# Scores of descent, with and without a known truth; an overlap (Jaccard index) of 1 at this pause scores 1.
_DESCENT_SCORES = {True: 0.1, False: 0.5}
_EARLIER_SCORE = 0.4  # score of an overlap of 1 with the last pause
_LEAST_SCORE = 0.2  # below, an object gets a new identity
_TRUTH_SCORE = 2.0  # score of the same label of the truth, more than any overlap
_REFERENCES = 6  # hypotheses of a pause that others are compared with


@dataclass(frozen=True)
class Identities:
    """Identity of every object of every hypothesis."""

    #: ``(pause, hypothesis) -> {label: identity}``; hypothesis -1 is the ground truth.
    table: Mapping[tuple[int, int], Mapping[int, int]] = field(default_factory=dict)

    def of(self, t: int, k: int) -> Mapping[int, int]:
        """``{label: identity}`` of hypothesis `k` (-1: the truth) at pause `t`."""
        return self.table.get((t, k), {})

    def colours(self, t: int, k: int) -> dict[int, Colour]:
        """``{label: (r, g, b)}`` of hypothesis `k` (-1: the truth) at pause `t`."""
        return {label: colour(identity) for label, identity in self.of(t, k).items()}


def assign_identities(run: RunFolder) -> Identities:
    """Identities of all objects of a run, assigned pause by pause."""
    tables = run.tables()
    assignment, of_truth = _Assignment(tables[-1].last_number if tables else 0), _identities_of_truth(run, tables)
    for t, table in enumerate(tables):
        given: dict[int, dict[int, int]] = {}
        for one in table:  # those of the estimate are first
            given.setdefault(one.hypothesis, {})[one.label] = one.number - 1
        given[TRUTH] = of_truth
        info = run.info(t)
        assignment.add(t, run.hypotheses(t), info["weights"], info["parents"].get("previous"), run.truth(t), given)
    return Identities(assignment.table)


def _identities_of_truth(run: RunFolder, tables: Sequence[ObjectTable]) -> dict[int, int]:
    """``{true label: identity}``, one to one, by the overlap with the objects of the tables over all pauses."""
    from scipy.optimize import linear_sum_assignment

    known = [(t, truth) for t in range(len(tables)) if (truth := run.truth(t)) is not None]
    labels = sorted({int(label) for _, truth in known for label in np.unique(truth) if label})
    n = tables[-1].last_number if tables else 0
    score = np.zeros((len(labels), n))
    for t, truth in known:
        for one in (one for one in tables[t] if one.in_estimate):
            image = np.where(run.hypotheses(t)[one.hypothesis].labels == one.label, one.number, 0)
            score += _overlaps(truth, image, labels, n)
    pairs = zip(*(x.tolist() for x in linear_sum_assignment(-score)), strict=True)
    found = {labels[row]: column for row, column in pairs if score[row, column] >= _LEAST_SCORE}
    return found | {label: n + k for k, label in enumerate(label for label in labels if label not in found)}


def match_runs(runs: Sequence[RunFolder], t: int) -> list[Identities]:
    """Identities of pause `t` of each run of one recording. Matching objects have the same identity in all runs."""
    assignment, hypotheses = _Assignment(), [run.hypotheses(t) for run in runs]
    weights = [weight for run in runs for weight in run.info(t)["weights"]]
    assignment.add(t, [h for of_run in hypotheses for h in of_run], weights, None, runs[0].truth(t))
    first = [sum(map(len, hypotheses[:k])) for k in range(len(runs))]
    return [Identities({(i, j - n * (j >= 0)): of for (i, j), of in assignment.table.items()}) for n in first]


def match_objects(hypotheses: Sequence[Hypothesis], weights: Sequence[float]) -> list[dict[int, Colour]]:
    """Colours of the objects of each hypothesis at one pause. Matching objects have the same colour."""
    assignment = _Assignment()
    assignment.add(0, hypotheses, weights, None, None)
    found = Identities(assignment.table)
    return [found.colours(0, k) for k in range(len(hypotheses))]


class _Assignment:
    """Identities of the objects of all pauses that were added so far. The first `n` are given to `add`."""

    def __init__(self, n: int = 0) -> None:
        self.table: dict[tuple[int, int], dict[int, int]] = {}
        self._ids: dict[tuple[int, int], dict[int, int]] = {}  # (pause, hypothesis) -> {stable id: identity}
        # Voxels with identity + 1 (0 for none) of the truth and the heaviest hypotheses: of this pause, of the last.
        self._now: list[np.ndarray] = []
        self._before: list[np.ndarray] = []
        self._n = n

    def add(
        self,
        t: int,
        hypotheses: Sequence[Hypothesis],
        weights: Sequence[float],
        parents: Sequence[int] | None,
        truth: np.ndarray | None,
        given: Mapping[int, Mapping[int, int]] | None = None,
    ) -> None:
        """Add the hypotheses of pause `t` and its ground truth.

        The identities `given`, ``{hypothesis: {label: identity}}``, are kept. These hypotheses are first, then the
        truth, then the others in order of weight.
        """
        self._before, self._now = self._now, []
        given = given or {}
        known: dict[bytes, dict[int, int]] = {}
        for k, of in given.items():
            if k != TRUTH:
                known.setdefault(hypotheses[k].key, {}).update(of)
        first: dict[bytes, int] = {}
        for k in [*given, TRUTH, *order_by_weight(weights)]:
            if (t, k) in self.table:
                continue
            if k == TRUTH:
                if truth is not None:
                    labels = np.flatnonzero(np.bincount(truth.ravel(), minlength=1)[1:]) + 1
                    ids = {int(label): int(label) for label in labels}
                    inherited = self._ids.get((t - 1, TRUTH), {})
                    self._assign(t, TRUTH, truth, ids, inherited, _TRUTH_SCORE, given.get(TRUTH))
                continue
            h = hypotheses[k]
            ids = {o.label: o.id for o in h.objects}
            same = first.setdefault(h.key, k)
            if same != k:
                self.table[t, k] = self.table[t, same]
                self._ids[t, k] = {ids[label]: identity for label, identity in self.table[t, k].items()}
                continue
            parent = -2 if parents is None else int(parents[k])
            score = _DESCENT_SCORES[truth is not None]
            self._assign(t, k, h.labels, ids, self._ids.get((t - 1, parent), {}), score, known.get(h.key))

    def _assign(
        self,
        t: int,
        k: int,
        labels: np.ndarray,
        ids: Mapping[int, int],
        inherited: Mapping[int, int],
        descent_score: float,
        given: Mapping[int, int] | None = None,
    ) -> None:
        from scipy.optimize import linear_sum_assignment

        present = list(ids)
        score = np.zeros((len(present), self._n))
        if present and self._n:
            for images, factor in ((self._now, 1.0), (self._before, _EARLIER_SCORE)):
                overlaps = [_overlaps(labels, image, present, self._n) for image in images]
                if overlaps:
                    score += factor * np.max(overlaps, axis=0)
        for row, label in enumerate(present):
            identity = inherited.get(ids[label])
            if identity is not None:
                score[row, identity] += descent_score
        given = {label: identity for label, identity in (given or {}).items() if label in ids}
        self._n = max([self._n, *(identity + 1 for identity in given.values())])
        score[[row for row, label in enumerate(present) if label in given]] = 0
        score[:, [identity for identity in given.values() if identity < score.shape[1]]] = 0
        rows, columns = linear_sum_assignment(-score)
        pairs = zip(rows.tolist(), columns.tolist(), strict=True)
        found = {present[r]: int(c) for r, c in pairs if score[r, c] >= _LEAST_SCORE} | given
        for label in present:
            if label not in found:
                found[label] = self._n
                self._n += 1
        self.table[t, k] = {label: found[label] for label in present}
        self._ids[t, k] = {ids[label]: found[label] for label in present}
        if len(self._now) < _REFERENCES:
            lookup = np.zeros(int(labels.max()) + 1, np.int64)
            for label, identity in found.items():
                lookup[label] = identity + 1
            self._now.append(lookup[labels])


def _overlaps(labels: np.ndarray, image: np.ndarray, objects: list[int], n: int) -> np.ndarray:
    """Jaccard indices (len(objects), n) of each object in `labels` with each of n identities in `image`."""
    table = overlap(labels, image)
    jaccard = table.jaccard()
    out = np.zeros((len(objects), n))
    row_of = {int(label): row for row, label in enumerate(table.labels_a)}
    present = table.labels_b > 0
    for row, label in enumerate(objects):
        if label in row_of:
            out[row, table.labels_b[present] - 1] = jaccard[row_of[label], present]
    return out


def order_by_weight(weights: Sequence[float]) -> list[int]:
    """Indices from the heaviest to the lightest; equal weights keep their order."""
    return sorted(range(len(weights)), key=lambda k: -weights[k])


def names_of(indices: Sequence[int]) -> str:
    """Names of identical hypotheses, such as ``#0`` or ``#0, #3``. At most four hypotheses are named."""
    more = len(indices) - 4
    return ", ".join(f"#{k}" for k in indices[:4]) + (f" and {more} more" if more > 0 else "")


def weigh_distinct(hypotheses: Sequence[Hypothesis], weights: Sequence[float]) -> list[tuple[tuple[int, ...], float]]:
    """Indices and total weight of each group of identical hypotheses, from heavy to light."""
    which = first_seen(h.key for h in hypotheses)
    mass = np.bincount(which, weights)
    return [(tuple(np.flatnonzero(which == g).tolist()), float(mass[g])) for g in order_by_weight(mass.tolist())]
