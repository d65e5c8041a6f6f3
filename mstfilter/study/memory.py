"""The most memory that this process has used since it was last asked to begin anew.

>>> reset_peak(); _ = bytearray(10**8); peak_megabytes() > 100
True
"""

from __future__ import annotations

import contextlib
from pathlib import Path

__all__ = ["peak_megabytes", "reset_peak"]


def reset_peak() -> None:
    """Begin anew, where the system can (Linux); elsewhere the peak is that of the whole process."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


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
