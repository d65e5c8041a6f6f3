"""A registration: aligns the surface of an object before the clip with the surface after it.

mstfilter check ./registration.py:MyRegistration
mstfilter run demo/recording transition.rule.registration=./registration.py:MyRegistration --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mstfilter.mst.tracking import Registration, RegistrationResult, SmallGicp, Surface


@dataclass(frozen=True)
class MyRegistration(Registration):
    """Repeats an ICP with smaller and smaller correspondence distances. Fields need an annotation and a default.

    Parameters
    ----------
    factors : tuple of float
        Distances, relative to the reach that the motion rule asks for.
    icp : Registration
        The method that is repeated.
    """

    factors: tuple[float, ...] = (4.0, 2.0, 1.0)
    icp: Registration = field(default_factory=lambda: SmallGicp("PLANE_ICP"))

    def register(self, source: Surface, target: Surface, init: np.ndarray, reach: float) -> RegistrationResult | None:
        """The motion of the source; None if there is none. `init` (4, 4) is a first guess, `reach` is in metres."""
        result = None
        for factor in self.factors:
            result = self.icp.register(source, target, init, factor * reach)
            if result is None:
                break
            init = result.T
        return result
