"""Metrics of your own, which a study measures beside its own metrics.

>>> @dataclass(frozen=True)
... class Height(Metric):
...     def measure(self, recording, t, hypotheses, weights):
...         heights = [max((np.nonzero(h.labels)[2] + 1) * h.grid.voxel_size, default=0.0) for h in hypotheses]
...         return float(weights @ heights)

In a study, ``metric = "./mine.py:Height"`` adds the column ``Height`` to all tables.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from numbers import Real

import numpy as np

from mstfilter.base.errors import InputError, describe_error
from mstfilter.base.fields import Bounded
from mstfilter.scene import Hypothesis, Recording


class Metric(Bounded, ABC):
    """A number, or a few named numbers, for the weighted hypotheses at one pause."""

    @abstractmethod
    def measure(
        self, recording: Recording, t: int, hypotheses: Sequence[Hypothesis], weights: np.ndarray
    ) -> float | Mapping[str, float]:
        """The metric at pause `t`. A mapping has one number for each name; NaN means that there is no value.

        Parameters
        ----------
        recording : Recording
            Its ``truth(t)`` is the volume (X, Y, Z) of true labels, or None. Its frame at the pause is
            ``recording.frames[recording.pauses[t]]``.
        t : int
            Number of the pause, from 0.
        hypotheses : sequence of Hypothesis
        weights : (n,) array
            Sum 1.
        """


def measure_own(
    metric: Metric, recording: Recording, t: int, hypotheses: Sequence[Hypothesis], weights: np.ndarray
) -> dict[str, float]:
    """The values of a metric at pause `t`, by name. A single number has the name of the class.

    Any error becomes an InputError that names the metric and the pause.
    """
    what = f"metric {type(metric).__name__} at pause {t}"
    try:
        found = metric.measure(recording, t, hypotheses, weights)
    except Exception as error:
        raise InputError(f"{what}: {describe_error(error)}", *getattr(error, "hints", ())) from error
    values = found if isinstance(found, Mapping) else {type(metric).__name__: found}
    for name, value in values.items():
        if not isinstance(name, str) or not isinstance(value, Real | np.generic) or np.ndim(value):
            raise InputError(f"{what} returned {value!r} as {name!r}, expected a number for each name")
    return {name: float(value) for name, value in values.items()}
