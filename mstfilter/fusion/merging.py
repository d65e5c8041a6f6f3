"""How likely two conflicting objects are one.

Child and parent have n1 and n2 voxels, I of them common.

=============  =============================  ========================================================
rule           probability                    source
=============  =============================  ========================================================
``share``      min(1, I n2 / n1^2)            the authors' program: (share of the child that is covered)
                                              x (size ratio); about even odds on real conflicts
``printed``    min(1, IoU n2 / n1^2)          the formula as printed (paper, section IV-D); its dimension
                                              is 1 / voxels, so it practically never merges
``iou``        IoU                            a plain alternative
``match``      1 if IoU > 1/2, else 0         an object overlaps at most one other so much: the same thing
                                              seen twice
``covered``    1 if I / n1 >= 3/4, else 0     what is left of the child would be a sliver
``always``     1                              a control
``never``      0                              a control
=============  =============================  ========================================================
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from mstfilter.errors import InputError

__all__ = ["MERGE_RULES", "MergeRule", "merge_probability"]

MergeRule = Literal["share", "printed", "iou", "match", "covered", "always", "never"]
MERGE_RULES: tuple[MergeRule, ...] = get_args(MergeRule)


def merge_probability(
    rule: MergeRule, intersection: np.ndarray | int, child: np.ndarray | int, parent: np.ndarray | int
) -> np.ndarray:
    """Probability that a child object is merged into its parent, elementwise.

    Parameters
    ----------
    rule : str
        See the module.
    intersection, child, parent : int or arrays of the same shape
        Voxels in common, of the child, of the parent.
    """
    common, n1, n2 = (np.asarray(a, dtype=np.float64) for a in (intersection, child, parent))
    if rule == "share":
        return np.minimum(1.0, common * n2 / n1**2)
    iou = common / (n1 + n2 - common)
    if rule == "printed":
        return np.minimum(1.0, iou * n2 / n1**2)
    if rule == "iou":
        return iou
    if rule == "match":
        return (iou > 0.5).astype(np.float64)
    if rule == "covered":
        return (common >= 0.75 * n1).astype(np.float64)
    if rule == "always":
        return np.ones_like(iou)
    if rule == "never":
        return np.zeros_like(iou)
    raise InputError(f"there is no merge rule {rule!r}", f"there are: {', '.join(MERGE_RULES)}")
