"""Figures of a run at a pause."""

from __future__ import annotations

from typing import Any

import numpy as np

from mstfilter.scene.quality import FORMS, weighted_coverage
from mstfilter.scene.recording import Recording
from mstfilter.study.run_folder import RunFolder

__all__ = ["measure"]


def measure(run: RunFolder, recording: Recording, t: int) -> dict[str, Any]:
    """One row: the figures of the hypotheses at pause `t`."""
    info, truth = run.info(t), recording.truth(t)
    row: dict[str, Any] = {"pause": t, "n": info["n"]}
    if truth is not None:
        hypotheses = run.hypotheses(t)
        for form in FORMS:
            q = np.array([weighted_coverage(h.labels, truth, form) for h in hypotheses])
            row["quality" if form == "objects" else f"quality_{form}"] = float(q.mean())
            if form == "objects":
                row["quality_top"] = float(q[int(np.argmax(info["weights"]))])
                row["quality_best"] = float(q.max())
    return row
