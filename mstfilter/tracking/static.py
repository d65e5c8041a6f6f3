"""Did anything change where an object is? What did not change is not moved.

Tracking damages what did not move: labels bleed between touching twins, registration of symmetric bodies
drifts. So objects whose pixels show what they showed before keep the identity, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.tracking.track import Track

__all__ = ["StaticTest"]


@dataclass(frozen=True)
class StaticTest:
    """The test for rest.

    Parameters
    ----------
    enabled : bool
        False: every object is tracked (the published algorithms).
    changed_share : float
        Largest share of the compared pixels that may have changed.
    least_share : float
        Share of the object's pixels that must be comparable; one that is hidden more than that is tracked.
    occluded_margin : float
        Metres; a pixel that became nearer by more shows something in front and is not compared.
    """

    enabled: bool = True
    changed_share: float = 0.03
    least_share: float = 0.3
    occluded_margin: float = 0.015

    def rests(self, track: Track) -> bool:
        """True where the object did not move, as far as can be seen."""
        if not self.enabled:
            return False
        support = track.segment.support
        before, after = track.clip.before, track.clip.after
        with np.errstate(invalid="ignore"):
            nearer = before.depth.ravel()[support] - after.depth.ravel()[support] > self.occluded_margin
        compared = after.valid.ravel()[support] & ~nearer
        n = int(compared.sum())
        if n < max(1.0, self.least_share * len(support)):
            return False
        changed = compared & ~track.flow.coherently_unchanged.ravel()[support]
        return bool(changed.sum() <= self.changed_share * n)
