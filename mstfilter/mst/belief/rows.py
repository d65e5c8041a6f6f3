"""The table of objects as plain types: for JSON, CSV, data frames and messages.

>>> table.rows()[0]["centre"]                                   # [0.12, -0.05, 0.04]
>>> table.rows(T_base_world)[0]["centre"]                       # in the frame of a robot's base
>>> [flat_row(row) for row in table.rows()]                     # one number a column, for a data frame
>>> json.dumps(pause_document(table, belief.open_borders(camera), pause=3, time=8.2))
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

if TYPE_CHECKING:
    from mstfilter.mst.belief.objects import BelievedObject, ObjectTable
    from mstfilter.mst.belief.queries import Border

#: The lists of `object_row`, with the names of the columns that `flat_row` makes of them.
_LISTS = {
    "centre": ("centre_x", "centre_y", "centre_z"),
    "spread": ("spread_x", "spread_y", "spread_z"),
    "box_centre": ("box_x", "box_y", "box_z"),
    "box_quaternion_xyzw": ("box_qx", "box_qy", "box_qz", "box_qw"),
    "sides": ("side_x", "side_y", "side_z"),
    "moved": ("moved_x", "moved_y", "moved_z"),
    "turned_quaternion_xyzw": ("turned_qx", "turned_qy", "turned_qz", "turned_qw"),
    "volume_range": ("volume_low", "volume_high"),
    "colour": ("red", "green", "blue"),
}
_FIELDS = (
    "object", "id", "in_estimate", "existence", "visible", "last_seen", "several", "one_with",
    "centre", "spread", "box_centre", "box_quaternion_xyzw", "sides", "moved", "turned_quaternion_xyzw",
    "volume", "volume_range", "colour",
)  # fmt: skip
#: The columns of `flat_row`.
OBJECT_COLUMNS = tuple(column for name in _FIELDS for column in _LISTS.get(name, (name,)))


def object_row(one: BelievedObject, T_frame_world: RigidTransform | None = None) -> dict[str, Any]:
    """The figures of an object by name; see `BelievedObject.row`."""
    T = RigidTransform.identity() if T_frame_world is None else T_frame_world
    box, turned = T * one.T_world_box, T.rotation * one.pose.rotation * T.rotation.inv()
    # The variance along an axis of the new frame, if the errors along the axes of the grid are independent.
    spread = np.sqrt(T.rotation.as_matrix() ** 2 @ one.spread**2)
    lists = {
        "centre": T.apply(one.centre),
        "spread": spread,
        "box_centre": box.translation,
        "box_quaternion_xyzw": box.rotation.as_quat(),
        "sides": one.sides,
        "moved": T.rotation.apply(one.shift),
        "turned_quaternion_xyzw": turned.as_quat(),
    }
    row = {
        "object": one.number,
        "id": one.record.id,
        "in_estimate": one.in_estimate,
        "existence": round(one.existence, 4),
        "visible": one.visible,
        "last_seen": one.last_seen,
        "several": round(one.several, 4),
        "one_with": {str(other): round(p, 4) for other, p in one.one_with.items()},
        **{name: [round(float(x), 5) for x in values] for name, values in lists.items()},
        "volume": float(f"{one.volume:.4g}"),
        "volume_range": [float(f"{v:.4g}") for v in one.volume_range],
        "colour": None if one.colour is None else list(one.colour),
    }
    return {name: row[name] for name in _FIELDS}


def flat_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row with one number in each of the `OBJECT_COLUMNS`. `one_with` is a text such as ``3:0.47 5:0.02``."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if name in _LISTS:
            columns = _LISTS[name]
            flat.update(zip(columns, [None] * len(columns) if value is None else value, strict=True))
        elif name == "one_with":
            flat[name] = " ".join(f"{other}:{p}" for other, p in value.items())
        else:
            flat[name] = value
    return flat


def pause_document(
    table: ObjectTable, borders: Iterable[Border], T_frame_world: RigidTransform | None = None, **entries: Any
) -> dict[str, Any]:
    """What is known at a pause, for JSON: the `entries`, the rows of all objects, and the open borders.

    A border has the probability ``one_object`` that both of its sides are one object, its ``pixels`` (column, row),
    and the one in its ``middle``.
    """
    found = [
        {
            "one_object": round(border.one_object, 4),
            "middle": border.middle.tolist(),
            "pixels": border.pixels.tolist(),
        }
        for border in borders
    ]
    return {**entries, "objects": table.rows(T_frame_world), "open_borders": found}
