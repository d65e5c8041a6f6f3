"""The tables of a run: what metrics.csv, objects.csv and ``mstfilter objects`` say.

>>> object_rows(run)                                    # a flat row for each pause and object
>>> pause_documents(run, [run.n_pauses - 1])            # for JSON: objects and open borders of the last pause
>>> pause_documents(run, reach=((-0.4, -0.4, 0.0), (0.4, 0.4, 0.3)))    # and the pushes that tell most
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from mstfilter.base.errors import InputError
from mstfilter.mst.belief import OBJECT_COLUMNS, flat_row, pause_document, push_candidates
from mstfilter.scoring import FORMS

if TYPE_CHECKING:
    from mstfilter.runs.run_folder import RunFolder

#: The columns of objects.csv.
TABLE_COLUMNS = ("pause", "time", *OBJECT_COLUMNS)


def metrics_rows(run: RunFolder) -> list[dict[str, Any]]:
    """A row for each pause and hypothesis: weight, number of objects, occupied voxels, and quality if known."""
    rows = []
    for t in range(run.n_pauses):
        info = run.info(t)
        for k, hypothesis in enumerate(run.hypotheses(t)):
            row = {
                "pause": t,
                "hypothesis": k,
                "weight": f"{info['weights'][k]:.6g}",
                "n_objects": hypothesis.n_objects,
                "voxels": sum(hypothesis.volumes().values()),
            }
            for form in FORMS:
                row[f"quality_{form}"] = "" if info["quality"] is None else f"{info['quality'][form][k]:.6f}"
            rows.append(row)
    return rows


def object_rows(run: RunFolder, pauses: Iterable[int] | None = None) -> list[dict[str, Any]]:
    """A flat row for each object of these pauses, by default of all; the columns are `TABLE_COLUMNS`."""
    times, tables = run.description["recording"]["times"], run.tables()
    chosen = range(run.n_pauses) if pauses is None else pauses
    return [{"pause": t, "time": times[t], **flat_row(row)} for t in chosen for row in tables[t].rows()]


def pause_documents(run: RunFolder, pauses: Iterable[int] | None = None, reach: Any = None) -> list[dict[str, Any]]:
    """The `pause_document` of each of these pauses, by default of all, with its number, image and time in seconds.

    With the `reach` of a robot, each also has the `push_candidates`.
    """
    known, tables = run.description["recording"], run.tables()
    documents = []
    for t in range(run.n_pauses) if pauses is None else pauses:
        belief, camera = run.belief(t), run.camera(t)
        about = {"pause": t, "frame": known["pauses"][t], "time": known["times"][t]}
        borders = belief.open_borders(camera)
        if reach is not None:
            pushes = push_candidates(belief, camera, reach, borders=borders) if belief.estimate().n_objects else []
            about["pushes"] = [push.row() for push in pushes]
        documents.append(pause_document(tables[t], borders, **about))
    return documents


def chosen_pauses(run: RunFolder, pause: int | None) -> list[int]:
    """The pause, which may be counted from the end (-1), or all pauses. Raises InputError if it is not complete."""
    n = run.n_pauses
    if n == 0:
        raise InputError(f"{run.path}: the run has no complete pause yet", "repeat the command that made the run")
    if pause is None:
        return list(range(n))
    if not -n <= pause < n:
        raise InputError(f"{run.path} has no pause {pause}", f"complete pauses: 0 to {n - 1}, or -1 for the last")
    return [pause % n]
