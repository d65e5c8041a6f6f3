"""Occupancy probabilities of the voxels of a hypothesis.

>>> occupancy = Occupancy(owner, probability)       # (X, Y, Z) arrays
>>> occupancy.owner[voxel], occupancy.probability[voxel]
>>> voxels, owners, probabilities = occupancy.stored
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.scene.arrays import content_key, read_only


@dataclass(frozen=True, eq=False, init=False)
class Occupancy:
    """Probability of each voxel, given the objects of a hypothesis. Stores only voxels that have an owner.

    Parameters
    ----------
    owner : (X, Y, Z) uint16
        The most probable object, also where free space is more probable. Equal to the label where there is one.
    probability : (X, Y, Z) float16
        Probability that the voxel belongs to its owner.
    """

    shape: tuple[int, ...]
    _voxels: np.ndarray  # (k,) int32, flat indices
    _owners: np.ndarray  # (k,) uint16
    _probabilities: np.ndarray  # (k,) float16

    def __init__(self, owner: np.ndarray, probability: np.ndarray) -> None:
        owner, p = np.asarray(owner), np.asarray(probability)
        if p.size and not 0 <= p.min() <= p.max() <= 1.001:  # rounded to half precision
            raise InputError(f"probabilities of voxels are from {p.min():g} to {p.max():g}, expected 0 to 1")
        voxels = np.flatnonzero((owner > 0) | (p > 0))
        self._store(owner.shape, voxels, owner.ravel()[voxels], p.ravel()[voxels])

    def _store(self, shape: tuple[int, ...], voxels: np.ndarray, owners: np.ndarray, p: np.ndarray) -> Self:
        """Store the voxels (k,) that have an owner or a probability in half precision."""
        owners, p = owners.astype(np.uint16), p.astype(np.float16)
        kept = (owners > 0) | (p > 0)
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "_voxels", read_only(voxels[kept].astype(np.int32)))
        object.__setattr__(self, "_owners", read_only(owners[kept]))
        object.__setattr__(self, "_probabilities", read_only(p[kept]))
        return self

    @property
    def stored(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Flat indices (k,) of the stored voxels in ascending order, their owners (k,) and probabilities (k,)."""
        return self._voxels, self._owners, self._probabilities

    @property
    def owner(self) -> np.ndarray:
        """The most probable object (X, Y, Z) uint16 of each voxel; 0 is none."""
        return self._dense(self._owners)

    @property
    def probability(self) -> np.ndarray:
        """Probability (X, Y, Z) float16 that each voxel belongs to its owner."""
        return self._dense(self._probabilities)

    def _dense(self, values: np.ndarray) -> np.ndarray:
        array = np.zeros(self.shape, values.dtype)
        array.ravel()[self._voxels] = values
        return read_only(array)

    @cached_property
    def key(self) -> bytes:
        """Content key."""
        return content_key("occupancy", str(self.shape), self._voxels, self._owners, self._probabilities)

    def relabelled(self, before: np.ndarray, after: np.ndarray, known: np.ndarray) -> Occupancy:
        """The occupancy for new labels. Changed voxels get probability 0 or 1. Owners outside `known` are removed."""
        labelled = ((before > 0) | (after > 0)).ravel()
        labelled[self._voxels] = True
        voxels = np.flatnonzero(labelled)
        at = np.searchsorted(voxels, self._voxels)
        owner, p = np.zeros(len(voxels), np.uint16), np.zeros(len(voxels), np.float16)
        owner[at], p[at] = self._owners, self._probabilities
        new = after.ravel()[voxels]
        changed = before.ravel()[voxels] != new
        owner, p = np.where(changed | (new > 0), new, owner), np.where(changed, new > 0, p)
        kept = np.isin(owner, known)
        return Occupancy.__new__(Occupancy)._store(self.shape, voxels[kept], owner[kept], p[kept])

    def without(self, voxels: np.ndarray) -> Occupancy:
        """The occupancy with some `voxels` (X, Y, Z) bool set to free."""
        kept = ~voxels.ravel()[self._voxels]
        stored = (values[kept] for values in self.stored)
        return Occupancy.__new__(Occupancy)._store(self.shape, *stored)
