"""Hypotheses in checkpoints of the filter.

>>> state, infos = mstfilter.preset("mst").run(clips, seed=0, checkpoint="run.npz", codec=HypothesisCodec())
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.scene import decode_hypotheses, encode_hypotheses
from mstfilter.smc import Codec

__all__ = ["HypothesisCodec"]


@dataclass(frozen=True)
class HypothesisCodec(Codec):
    """Hypotheses on one grid as arrays, bit for bit."""

    def encode(self, particles: Any) -> Mapping[str, np.ndarray]:
        """Named arrays of a sequence of hypotheses."""
        return encode_hypotheses(particles)

    def decode(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """The hypotheses."""
        return decode_hypotheses(dict(arrays))
