"""The most memory that this process has used since it was last asked to begin anew.

>>> reset_peak(); _ = bytearray(10**8); peak_megabytes() > 100
True
"""

from __future__ import annotations

import contextlib
from pathlib import Path

__all__ = ["StagePeaks", "peak_megabytes", "reset_peak"]


def reset_peak() -> bool:
    """Begin anew, where the system can (Linux); elsewhere the peak is that of the whole process. Whether it could."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
        return True
    return False


def peak_megabytes() -> float:
    """Peak resident memory in MB; NaN where the system does not tell."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return float("nan")
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 1024)


class StagePeaks:
    """Peak memory of a step and of each of its stages; an observer of `ParticleFilter.step`.

    >>> peaks = StagePeaks()
    >>> state, info = filter.step(state, clip, observer=peaks)
    >>> peaks.figures()["peak_mb"]
    """

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """A step begins."""
        self._whole, self._stages = 0.0, dict[str, float]()
        self._apart = reset_peak()

    def __call__(self, stage: str, begins: bool) -> None:
        """A stage begins or ends."""
        peak = peak_megabytes()
        self._whole = max(self._whole, peak)
        if not begins:
            self._stages[stage] = max(peak, self._stages.get(stage, 0.0))
        self._apart = reset_peak() and self._apart

    def figures(self) -> dict[str, float]:
        """``peak_mb`` of the step, ``peak_mb_STAGE`` where the system can tell stages apart."""
        stages = {f"peak_mb_{stage}": peak for stage, peak in self._stages.items()} if self._apart else {}
        return {"peak_mb": max(self._whole, peak_megabytes()), **stages}
