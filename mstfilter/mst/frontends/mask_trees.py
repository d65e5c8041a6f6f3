"""Instance masks as a tree. Nested masks are nodes of the tree, so a segmentation is a cut.

>>> masks = np.zeros((3, 4, 6), bool)
>>> masks[0, :, :4], masks[1, :, :2], masks[2, :, 2:4] = True, True, True     # an object, and its two parts
>>> tree, stop = mask_tree(masks, scores=[0.9, 0.6, 0.6])
>>> w = node_values(tree, stop)
>>> ExactCuts(temperature=1).sample(rng, tree, w, 10)                        # the object in 60 % of the cuts

Two masks of a set are disjoint, or one contains the other. Leaf 0 of the tree has the pixels without a mask, and if a
mask contains masks, its remaining pixels are a leaf, too. The root is the whole image, which is never in a cut.

A walk from the largest masks down the tree defines the distribution of the cuts. At a mask of score s that contains
masks of mean score m, it stops with probability s / (s + m); otherwise it goes on to the inner masks and the
remaining pixels. For the values w of `node_values`, the Gibbs distribution of cuts, proportional to exp(sum of w over
the cut), is that of the walk. Every `CutSampler` at temperature 1 draws from this distribution.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mstfilter.base.errors import InputError, check_number
from mstfilter.mst.segmentation import Tree

_NEVER = -1000.0  # log odds of probability 0; exp(_NEVER) is 0
_CLIP = 1e-9  # other probabilities are at least this far from 0 and 1


def mask_tree(masks: np.ndarray, scores: Sequence[float] | np.ndarray) -> tuple[Tree, np.ndarray]:
    """The tree of masks (n, H, W) bool with scores (n,) >= 0, and the probabilities (N,) to stop at its nodes.

    Raises InputError if a mask is empty, if two masks are equal, or if two masks overlap and are not nested.
    """
    masks = np.asarray(masks, dtype=bool)
    n = len(masks)
    scores = check_scores(scores, n)
    areas = masks.sum(axis=(1, 2))
    if n and areas.min() == 0:
        raise InputError(f"mask {int(areas.argmin())} is empty", "leave masks without pixels out")
    innermost = np.full(masks.shape[1:], -1)  # the smallest mask of each pixel so far
    container = np.full(n, -1)  # the smallest mask that contains a mask
    order = np.argsort(-areas, kind="stable")
    for k in order.tolist():
        found = np.unique(innermost[masks[k]])
        if len(found) > 1:
            other = next(j for j in found[::-1].tolist() if j >= 0)
            raise InputError(
                f"masks {other} and {k} overlap: {int((masks[k] & masks[other]).sum())} pixels are in both",
                "masks of a set are disjoint or nested; mstfilter.mst.frontends.nested_masks makes such a set",
            )
        container[k] = found[0]
        if found[0] >= 0 and areas[found[0]] == areas[k]:
            raise InputError(f"masks {found[0]} and {k} are equal", "leave one out")
        innermost[masks[k]] = k
    return _tree_of(innermost, container, order[::-1].tolist(), scores)


def label_tree(labels: np.ndarray, scores: np.ndarray | None = None) -> tuple[Tree, np.ndarray]:
    """Tree and stop probabilities of a label image (H, W), 0 = no mask. `scores` (n,) are in order of the labels."""
    present, image = np.unique(labels, return_inverse=True)
    image = image.reshape(labels.shape) - 1 if (present == 0).any() else image.reshape(labels.shape)
    n = int((present != 0).sum())
    scores = np.ones(n) if scores is None else check_scores(scores, n)
    return _tree_of(image, np.full(n, -1), list(range(n)), scores)


def check_scores(scores: Sequence[float] | np.ndarray, n: int) -> np.ndarray:
    """Scores as float64 (n,). Raises InputError unless there are n scores, which are finite and at least 0."""
    scores = np.asarray(scores, dtype=np.float64)
    if scores.shape != (n,):
        raise InputError(f"scores have shape {scores.shape}, expected one for each of {n} masks")
    for k in np.flatnonzero(~(np.isfinite(scores) & (scores >= 0))).tolist():
        raise InputError(f"score of mask {k} is {scores[k]}, expected a finite number of at least 0")
    return scores


def _tree_of(
    innermost: np.ndarray, container: np.ndarray, ascending: list[int], scores: np.ndarray
) -> tuple[Tree, np.ndarray]:
    """The tree of nested masks, and the stop probabilities (N,) of its nodes.

    `innermost` (H, W) is the smallest mask of each pixel, or -1 without a mask. `container` (n,) is the smallest mask
    that contains each mask, or -1 for outer masks. `ascending` lists the masks in ascending order of area.
    """
    n = len(scores)
    inner = np.zeros(n, dtype=bool)
    inner[container[container >= 0]] = True
    rest = np.zeros(n, dtype=bool)  # masks whose own pixels are a leaf
    rest[innermost[innermost >= 0]] = True
    leaf = np.where(rest, np.cumsum(rest), 0)
    node = leaf.copy()
    joins = [k for k in ascending if inner[k]]
    n_leaves = 1 + int(rest.sum())
    node[joins] = n_leaves + np.arange(len(joins))
    root = n_leaves + len(joins) if n else 0
    parent = np.full(root + 1, root)
    stop = np.ones(root + 1)
    start = np.zeros(root + 1)
    for k in ascending:
        above = root if container[k] < 0 else node[container[k]]
        parent[node[k]] = above
        if inner[k]:
            if rest[k]:
                parent[leaf[k]] = node[k]
            parts = scores[container == k].mean()
            stop[node[k]] = scores[k] / (scores[k] + parts) if scores[k] + parts > 0 else 0.5
            start[node[k]] = max(start[node[k]], 1 - stop[node[k]])
        if container[k] >= 0:
            start[above] = max(start[above], start[node[k]])
    start[root] = float(n > 0)
    stop[root] = float(n == 0)
    return Tree(parent, np.append(leaf, 0)[innermost], start), stop


def node_values(tree: Tree, stop: np.ndarray) -> np.ndarray:
    """Values (N,) for which a Gibbs distribution of cuts at temperature 1 has the stop probabilities `stop` (N,)."""
    # exp(w) / (exp(w) + Z of the children) = stop, with log Z = 0 for leaves.
    w, log_z = np.zeros(tree.n_nodes), np.zeros(tree.n_nodes)
    for node in range(tree.n_leaves, tree.n_nodes):
        split = sum(log_z[child] for child in tree.children[node])
        p = np.clip(stop[node], _CLIP, 1 - _CLIP)
        w[node] = split + (_NEVER if stop[node] == 0 else np.log(p) - np.log1p(-p))
        log_z[node] = np.logaddexp(w[node], split)
    return w


def nested_masks(
    masks: np.ndarray, scores: Sequence[float] | np.ndarray, share: float = 0.9
) -> tuple[np.ndarray, np.ndarray]:
    """Make masks with arbitrary overlaps disjoint or nested, and return masks and scores.

    This is for automatic mask generators. Masks are taken in order of decreasing score, and each is compared with all
    that are kept. Two masks are neighbours if they share at most ``1 - share`` of the smaller one; their common
    pixels then belong to the one with the higher score. They are nested if they share at least `share` of the smaller
    one and its area is less than `share` of the larger; it then loses the pixels outside the larger. Otherwise the
    mask with the lower score is removed.
    """
    check_number("share", share, above=0.5, at_most=1)
    masks = np.asarray(masks, dtype=bool)
    scores = check_scores(scores, len(masks))
    flat = masks.reshape(len(masks), int(np.prod(masks.shape[1:])))
    areas = flat.sum(axis=1)
    kept: list[int] = []
    for k in np.argsort(-scores, kind="stable").tolist():
        if areas[k] == 0:
            continue
        shared = np.array([(flat[k] & flat[j]).sum() for j in kept], dtype=np.float64)
        small, large = np.minimum(areas[k], areas[kept]), np.maximum(areas[k], areas[kept])
        nested = (shared >= share * small) & (small < share * large)
        if (nested | (shared <= (1 - share) * small)).all():
            kept.append(k)
    by_area = sorted(kept, key=lambda k: -areas[k])
    final: dict[int, np.ndarray] = {}
    for k in by_area:
        mask = flat[k].copy()
        for j in final:
            if (flat[k] & flat[j]).sum() >= share * areas[k]:
                mask &= final[j]
            elif scores[k] > scores[j]:
                final[j] = final[j] & ~mask
            else:
                mask &= ~final[j]
        final[k] = mask
    # A mask that loses a neighbour's pixels loses them in all masks that it contains.
    for i, k in enumerate(by_area):
        for j in by_area[:i]:
            if (flat[k] & flat[j]).sum() >= share * areas[k]:
                final[k] = final[k] & final[j]
    unique: dict[bytes, int] = {}
    for k in kept:
        if final[k].any():
            unique.setdefault(np.packbits(final[k]).tobytes(), k)
    chosen = list(unique.values())
    out = np.array([final[k] for k in chosen], dtype=bool).reshape(len(chosen), *masks.shape[1:])
    return out, scores[chosen]
