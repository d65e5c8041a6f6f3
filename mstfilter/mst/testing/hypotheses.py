"""Contracts of components whose particles are hypotheses, on clips whose motions are known."""

from __future__ import annotations

import time
from functools import cached_property
from typing import Any

import numpy as np

from mstfilter.mst.testing.scenes import known_motions, scene_example
from mstfilter.scene import Hypothesis
from mstfilter.smc import Population
from mstfilter.smc.testing.contract import FALSE_ALARM, close, seeded, skips_errors, statistical
from mstfilter.smc.testing.transitions import TransitionContract
from mstfilter.smc.testing.updates import ProposalContract
from mstfilter.smc.testing.values import ScoreContract, SimilarityContract

_COPIES, _CALLS = 4, 40


class EvidenceContract(ScoreContract):
    """The contract of every `Evidence`. The default example is `scene_example`."""

    example = staticmethod(scene_example)

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        """Log scores, rounded to 9 digits."""
        hypotheses = tuple(inputs["population"].realised().particles)
        return np.round(component.log_score(hypotheses, inputs["observation"]), 9)

    def test_copies_score_the_same(self) -> None:
        """Equal hypotheses have equal scores, also if their labels have other numbers."""
        inputs = self.inputs(9)
        hypotheses = tuple(inputs["population"].realised().particles)
        copies = tuple(Hypothesis.from_labels(np.copy(h.labels), h.grid) for h in hypotheses)
        for others, fault in (
            (copies, "a hypothesis and its copy have different scores"),
            (_renamed(hypotheses), "other numbers for the same labels give other scores"),
        ):
            scores = self.checked_call(self.make(), {**inputs, "population": Population(hypotheses + others)})
            assert close(scores[:9], scores[9:]), fault


def _renamed(hypotheses: tuple[Hypothesis, ...]) -> tuple[Hypothesis, ...]:
    """The same hypotheses with other label numbers."""
    rng, out = seeded(2), []
    for h in hypotheses:
        table = np.concatenate([[0], 3 + 5 * rng.permutation(int(h.labels.max()))]).astype(np.uint16)
        out.append(Hypothesis.from_labels(table[h.labels], h.grid))
    return tuple(out)


class SceneSimilarityContract(SimilarityContract):
    """The contract of a `Similarity` of hypotheses."""

    def test_numbers_of_labels_are_irrelevant(self) -> None:
        """A hypothesis has the similarity 1 to itself with other label numbers."""
        hypotheses = tuple(self.inputs(6)["population"].realised().particles)
        found = self.checked_call(self.make(), {"population": Population(hypotheses + _renamed(hypotheses))})
        least = float(np.diagonal(found, 6).min())
        assert least >= 1 - 1e-6, (
            f"a hypothesis has similarity {least:.3g} to itself with other label numbers, which have no meaning"
        )


class SceneTransitionContract(TransitionContract):
    """The contract of a `Transition` of hypotheses."""

    def test_objects_keep_their_identity(self) -> None:
        """The objects of a moved hypothesis have the ids that they had before."""
        for inputs in self.variants():
            result = self.checked_call(self.make(), inputs).realised()
            parents = result.parents.get("previous", np.arange(len(result)))
            for h, parent in zip(result.particles, parents.tolist(), strict=True):
                old = {record.id for record in inputs["population"].particles[parent].objects}
                new = {record.id for record in h.objects} - old
                assert parent < 0 or not new or h.n_objects > len(old), (
                    f"an object gets the new id {min(new)}: use hypothesis.with_labels, which keeps the objects, "
                    "instead of Hypothesis.from_labels"
                )

    @statistical
    def test_objects_move_as_they_are_seen_to(self) -> None:
        """In a clip of a known push, the pushed box does not move backwards, and the others do not move."""
        known = known_motions()[0]
        shifts = self.shifts[:8]
        push = np.asarray(known.motions[1].translation)
        for label, motion in known.motions.items():
            seen = shifts[:, :, label - 1]
            if np.isnan(seen).any():
                continue  # it loses the box
            mean = seen.mean(axis=(0, 1))
            error = 6 * seen.std(axis=(0, 1)).max() / np.sqrt(len(seen))
            room = 0.5 * known.clip.grid.voxel_size + error
            if label == 1:
                along = float(mean @ push) / float(push @ push)
                assert along >= -0.25 - error / np.linalg.norm(push), (
                    f"a box that is pushed by {100 * np.linalg.norm(push):.0f} cm moves by {along:.2f} of the push: "
                    "from the first frame to the last, not backwards"
                )
                mean = mean - along * push
            assert np.abs(mean).max() <= max(room, 0.25 * float(np.linalg.norm(push)) + error), (
                f"a box that moves by {np.round(motion.translation, 3).tolist()} m is moved by "
                f"{np.round(seen.mean(axis=(0, 1)), 3).tolist()} m"
            )

    @statistical
    def test_places_of_hypotheses_are_irrelevant(self) -> None:
        """Copies of one hypothesis move by the same law, whatever their places in the population."""
        from scipy.stats import ks_2samp

        found = self.shifts
        shifts = np.nan_to_num(found).reshape(len(found), _COPIES, -1)
        if len(found) < _CALLS:
            self.remarks.append(f"{len(found)} of {_CALLS} calls, for want of time")
        first = shifts[:, 0]
        for place in range(1, _COPIES):
            for c in range(first.shape[1]):
                p = ks_2samp(first[:, c], shifts[:, place, c], method="asymp").pvalue
                assert p >= FALSE_ALARM / (_COPIES * first.shape[1]), (
                    f"of equal hypotheses, number {place} moves differently than number 0: random numbers must not "
                    "depend on the place"
                )

    @cached_property
    def shifts(self) -> np.ndarray:
        """(calls, 4, 3, 3) shifts in metres of the boxes of four copies of a hypothesis; NaN if a box is lost."""
        known, component = known_motions()[0], self.make()
        population = Population((known.before,) * _COPIES)
        centres = _centres(known.before, known.before)
        found = []
        start = time.monotonic()
        for k in range(_CALLS):
            if k >= 3 and time.monotonic() + 1.5 * (time.monotonic() - start) / k > self.until:
                break  # enough to see a large fault
            self.check_time()
            with skips_errors():
                moved = component.predict(seeded(k), population, known.clip).realised()
            parents = moved.parents.get("previous", np.arange(len(moved)))
            if len(moved) < _COPIES:
                continue
            rows = [np.flatnonzero(parents == copy)[:1] for copy in range(_COPIES)]
            found.append([_centres(moved.particles[int(r[0])], known.before) if len(r) else centres for r in rows])
        return np.array(found) - centres if found else np.zeros((_CALLS, _COPIES, *centres.shape))


def _centres(hypothesis: Hypothesis, origin: Hypothesis) -> np.ndarray:
    """(3, 3) centres in metres of the voxels of the objects with the ids that they have in `origin`."""
    label_of = {record.id: record.label for record in hypothesis.objects}
    out = np.full((origin.n_objects, 3), np.nan)
    for k, record in enumerate(origin.objects):
        voxels = np.argwhere(hypothesis.labels == label_of.get(record.id, -1))
        if len(voxels):
            out[k] = voxels.mean(axis=0) * hypothesis.grid.voxel_size
    return out


class SceneProposalContract(ProposalContract):
    """The contract of a `Proposal` of hypotheses."""

    def test_hypotheses_are_about_the_last_image(self) -> None:
        """Occupied voxels agree with the end of a known clip no worse than with its begin, or with other axes."""
        known = known_motions()[0]
        with skips_errors():
            found = self.make().sample(seeded(1), known.clip, 8).realised().particles
        if not all(isinstance(h, Hypothesis) for h in found):
            return
        occupied = [h.labels > 0 for h in found]
        if not any(map(np.any, occupied)):
            return
        true = known.after.labels > 0

        def fit(other: Any, change: Any = lambda a: a) -> float:
            return float(np.mean([(change(o) & other).sum() / max(1, (change(o) | other).sum()) for o in occupied]))

        best = fit(true)
        alternatives = {
            "the boxes before the push": fit(known.before.labels > 0),
            "the boxes if x and y of the hypotheses are exchanged": fit(true, lambda a: a.transpose(1, 0, 2)),
            "the boxes if x is reversed": fit(true, lambda a: a[::-1]),
            "the boxes if y is reversed": fit(true, lambda a: a[:, ::-1]),
            "the boxes if z is reversed": fit(true, lambda a: a[:, :, ::-1]),
        }
        what = max(alternatives, key=lambda name: alternatives[name])
        assert best >= 0.95 * alternatives[what], (
            f"occupied voxels agree with the boxes after the push by {best:.2f} (Jaccard index), and by "
            f"{alternatives[what]:.2f} with {what}"
        )
