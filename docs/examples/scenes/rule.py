"""A motion rule: the rigid motion of one object in a clip.

mstfilter check ./rule.py:MyRule
mstfilter run demo/recording transition.rule=./rule.py:MyRule --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.mst.tracking import Candidate, MotionResidual, MotionRule, Track


@dataclass(frozen=True)
class MyRule(MotionRule):
    """Rest, or the shift of the points that the optical flow followed. Fields need an annotation and a default.

    Parameters
    ----------
    rest_bonus : float
        The shift must be better than rest by this much, in units of the residual.
    residual : MotionResidual
        Compares a motion with the images.
    """

    rest_bonus: float = 0.15
    residual: MotionResidual = field(default_factory=MotionResidual)

    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        """Possible motions of a segment, at least one. Computed once for all hypotheses."""
        rest = Candidate("identity", RigidTransform.identity(), 0, self.residual.score(track, np.eye(4)))
        before, after = track.flow_pairs  # (k, 3) world metres each
        if len(before) == 0:
            return (rest,)
        shift = RigidTransform.from_translation(np.median(after - before, axis=0))
        score = self.residual.score(track, shift.as_matrix()) + self.rest_bonus
        return (rest, Candidate("flow", shift, len(before), score))

    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        """The motion of the object in one particle; a rule may draw it at random from rng."""
        return min(candidates, key=lambda candidate: candidate.score)
