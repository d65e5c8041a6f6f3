"""The update of the preset ``mst`` (`PartitionUpdate`) on the miniature world.

>>> completer, pairs = fit(world, range(200))                  # from simulated scenes
>>> filter = partition_filter(world, n=20, completer=completer, pairs=pairs)

`PartitionUpdate` runs as it is. What needs images is replaced: tracking by the known push, tree cuts by
`CutProposal`, free space by the cells in front of the depth reading. The network becomes a table: the share of cases
in which a cell belonged to the object, by what this and earlier observations showed of the cell. The coefficients of
`PairEvidence` are fitted by logistic regression. Both are fitted to the filter's own masks, on scenes that are used
for nothing else.

A particle says how sure it is of each cell, so it stands for a distribution of states (`state_weights`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from miniature_mst import CutProposal, DepthFreeSpace
from miniature_world import Miniature, Observation
from scipy.optimize import minimize
from scipy.spatial.transform import RigidTransform
from scipy.special import expit

from mstfilter.mst.completion import Completer, Completion
from mstfilter.mst.partition import Cells, PairEvidence, PairOdds, PartitionUpdate
from mstfilter.scene import Camera, Hypothesis, Occupancy, VoxelGrid, memo
from mstfilter.scene.support import Foreground
from mstfilter.smc import ParticleFilter, Population, Systematic, Transition, Update

OWN, FREE, BEHIND, OTHER, HIDDEN = range(5)  # what an observation shows of a cell; a view has the first three
NOTHING = 3  # a cell of which no view shows anything
_PRIOR = 2.0  # cases that a table starts with, at the share of all cells


@dataclass(frozen=True, eq=False)
class RowImage:
    """The depth readings of an observation as an image of one row."""

    observation: Observation
    grid: VoxelGrid

    @property
    def key(self) -> bytes:
        """Content key."""
        return b"row" + self.observation.depth.tobytes()

    @property
    def camera(self) -> Camera:
        """A camera of an image of one row. Only its size has a meaning."""
        return Camera.from_intrinsics(1.0, 1.0, 0.0, 0.0, self.grid.shape[0], 1, RigidTransform.identity())

    @property
    def depth(self) -> np.ndarray:
        """(1, X) readings in cells."""
        return self.observation.depth[None]

    @property
    def valid(self) -> np.ndarray:
        """(1, X) bool: a surface was measured."""
        return self.depth < self.grid.shape[1]

    @property
    def points(self) -> np.ndarray:
        """(1, X, 3) centres of the cells with the readings."""
        x = np.arange(self.grid.shape[0])
        cells = np.stack([x, self.observation.depth, np.zeros_like(x)], axis=1)
        return (np.asarray(self.grid.origin) + (cells + 0.5) * self.grid.voxel_size)[None]


@dataclass(frozen=True, eq=False)
class RowClip:
    """An observation as a clip."""

    after: RowImage
    index: int = 0

    @property
    def grid(self) -> VoxelGrid:
        """The grid of the hypotheses."""
        return self.after.grid


@dataclass(frozen=True, eq=False)
class CellView:
    """What an observation showed of an object: OWN, FREE, BEHIND or NOTHING of each cell (X, Y, 1)."""

    cells: np.ndarray
    colours: ClassVar[np.ndarray] = np.zeros(0, np.float32)  # the world has no colours

    def shifted(self, step: tuple[int, int]) -> CellView:
        """The view after the object moved by `step`."""
        return CellView(shifted(self.cells, step, NOTHING))


def shifted(values: np.ndarray, step: tuple[int, int], empty: float) -> np.ndarray:
    """Values of cells (X, Y, ...) after a step; `empty` comes in from outside."""
    out = np.full_like(values, empty)
    X, Y = values.shape[:2]
    dx, dy = step
    out[max(dx, 0) : X + min(dx, 0), max(dy, 0) : Y + min(dy, 0)] = values[
        max(-dx, 0) : X + min(-dx, 0), max(-dy, 0) : Y + min(-dy, 0)
    ]
    return out


@Completer.register  # it completes rows of cells, not boxes of voxels
@dataclass(eq=False)
class TableCompleter:
    """The share of cases in which a cell belonged to the object, by what was seen of it.

    Parameters
    ----------
    table : (5, 4) ndarray
        By what this observation shows and by what the latest view with evidence showed.
    log : list, optional
        Gets (mask, codes) of every completed object.
    """

    table: np.ndarray
    log: list[tuple[np.ndarray, np.ndarray]] | None = None

    def at(self, clip: RowClip) -> TableCompleter:
        """The completer itself: the table is the same for every observation."""
        return self

    def complete_each(
        self,
        rngs: Sequence[np.random.Generator],
        frame: RowImage,
        masks: Sequence[np.ndarray],
        grid: VoxelGrid,
        views: Sequence[tuple[CellView, ...]],
    ) -> list[Completion]:
        """Completions of masks (1, X), and the views with what this observation shows."""
        found = []
        for mask, earlier in zip(masks, views, strict=True):
            now, points = self._seen(frame, mask, grid)
            past = np.full(grid.shape, NOTHING)
            for view in earlier:
                past = np.where(view.cells == NOTHING, past, view.cells)
            if self.log is not None:
                self.log.append((mask.ravel(), np.stack([now, past])))
            p = np.where(now == FREE, 0, self.table[now, past]).astype(np.float32)
            known: Any = (*earlier, CellView(np.where(now <= BEHIND, now, NOTHING)))
            found.append(Completion(np.zeros(3, np.int64), p, points, f"{mask.tolist()}", known))
        return found

    @staticmethod
    def _seen(frame: RowImage, mask: np.ndarray, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
        """What the observation shows of each cell (X, Y, 1), and the readings of the mask in it."""
        depth, own = frame.observation.depth[:, None], mask.ravel()[:, None]
        y = np.arange(grid.shape[1])[None]
        at = np.where(own, OWN, OTHER)
        behind = np.where(own, BEHIND, HIDDEN)
        now = np.where(y < depth, FREE, np.where(y == depth, at, behind))[:, :, None]
        return now, (now == OWN).astype(np.int32)


@dataclass(frozen=True)
class KnownPush(Transition):
    """Moves the object in the pushed cell, with its probabilities and views, unless the push slips or is blocked."""

    world: Miniature

    def predict(self, rng: np.random.Generator, population: Population, observation: Observation) -> Population:
        cell, step = self.world.actions[observation.action]
        slips = rng.random(len(population)) < self.world.slip
        moved = [
            h if slip else self._pushed(h, cell, step) for h, slip in zip(population.particles, slips, strict=True)
        ]
        return Population(tuple(moved), population.log_weights, population.parents)

    def _pushed(self, hypothesis: Hypothesis, cell: int, step: tuple[int, int]) -> Hypothesis:
        labels = hypothesis.labels
        label = int(labels[np.unravel_index(cell, self.world.shape)][0])
        own = labels == label
        target = shifted(own, step, 0)
        blocked = target.sum() < own.sum() or (labels[target & ~own] > 0).any()
        if label == 0 or blocked:
            return hypothesis
        shares = hypothesis.shares
        mine = shares.owner == label
        p = np.where(mine, 0, shares.probability)
        arriving = shifted(np.where(mine, shares.probability, 0), step, 0)
        takes = target | ((arriving > p) & ((labels == 0) | own))
        new = np.where(target, label, np.where(own, 0, labels))
        owner = np.where(takes, label, np.where(mine, 0, shares.owner))
        record = hypothesis.record(label)
        moved = replace(record, views=tuple(view.shifted(step) for view in record.views))
        records = tuple(moved if r is record else r for r in hypothesis.objects)
        return Hypothesis(new, hypothesis.grid, records, Occupancy(owner, np.where(takes, arriving, p)))


@dataclass(frozen=True)
class RowUpdate(Update):
    """A `PartitionUpdate` for observations of the miniature world."""

    partition: PartitionUpdate

    properly_weighted: ClassVar[bool] = False

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Observation,
    ) -> Population:
        present = predicted if predicted is not None else proposed
        assert present is not None
        clip = RowClip(RowImage(observation, present.particles[0].grid))
        image: Any = clip.after
        # There is no table, so every reading belongs to an object. The update finds this result in the cache.
        memo("foreground", (image.key, clip.grid.key), lambda: Foreground(image.valid, image))
        return self.partition.update(rng, predicted, proposed, clip)  # type: ignore[arg-type]


@dataclass(eq=False)
class LoggedPairs(PairOdds):
    """Pair odds that note the cells and the weights that they are asked about."""

    pairs: PairOdds
    log: list[tuple[Cells, np.ndarray]] = field(default_factory=list)

    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Any) -> np.ndarray:
        self.log.append((cells, weights))
        return self.pairs.log_odds(cells, weights, clip)


def partition_filter(world: Miniature, n: int, completer: TableCompleter, pairs: PairOdds) -> ParticleFilter:
    """The filter of the preset ``mst``, with `n` particles and 30 samples per step, or `n` if that is more."""
    partition = PartitionUpdate(
        completer=completer,  # type: ignore[arg-type]
        free_space=DepthFreeSpace(),
        pairs=pairs,
        mend=False,
        least_agreement=0.0,  # a row of readings has no surface
        reach=0.0,
    )
    return ParticleFilter(
        transition=KnownPush(world),
        proposal=CutProposal(world),
        update=RowUpdate(partition),
        resampler=Systematic(),
        resample="after",
        n=n,
        n_proposed=max(n, 30),
    )


def fit(
    world: Miniature, seeds: Iterable[int], n: int = 20, n_steps: int = 6, n_rounds: int = 2
) -> tuple[TableCompleter, PairEvidence]:
    """Fit both to the filter's own masks and cells on simulated scenes. Each round uses the results of the last."""
    table, evidence = np.full((5, 4), 0.6), PairEvidence()
    for _ in range(n_rounds):
        counts = np.zeros((2, 5, 4))
        asked: list[tuple[np.ndarray, ...]] = []
        for seed in seeds:
            truth, observations = world.simulate(np.random.default_rng([seed, 21]), n_steps)
            completer, pairs = TableCompleter(table, []), LoggedPairs(evidence)
            steps = partition_filter(world, n, completer, pairs).iterate(observations, seed)
            for _, state, observation in zip(steps, truth, observations, strict=True):
                labels = world.states.labels[state].reshape(world.shape)
                _count(counts, completer.log or [], labels, observation)
                asked += [_answered(cells, weights, labels, observation) for cells, weights in pairs.log]
                completer.log, pairs.log = [], []
        share = counts[1].sum() / counts.sum()
        table = (counts[1] + _PRIOR * share) / (counts.sum(axis=0) + _PRIOR)
        evidence = _logistic(*(np.concatenate(column) for column in zip(*asked, strict=True)))
    return TableCompleter(table), evidence


def _count(
    counts: np.ndarray, log: Sequence[tuple[np.ndarray, np.ndarray]], labels: np.ndarray, observation: Observation
) -> None:
    """Add the cells of completed objects to `counts` (no or yes, now, past)."""
    at = np.minimum(observation.depth, labels.shape[1] - 1)
    seen = labels[np.arange(len(at)), at]
    for mask, (now, past) in log:
        if mask.any():
            owner = np.bincount(seen[mask]).argmax()
            own = (labels == owner) & (owner > 0)
            np.add.at(counts, (own.astype(int).ravel(), now.ravel(), past.ravel()), 1)


def _answered(
    cells: Cells, weights: np.ndarray, labels: np.ndarray, observation: Observation
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Terms (e, 6), answers (e,) and pairs of readings (e,) of the pairs of cells."""
    first = np.array([np.flatnonzero(cells.of_reading == k)[0] for k in range(len(cells.sizes))], int)
    x = cells.readings.pixels[first]
    owner = labels[x, observation.depth[x]]
    a, b = cells.pairs.T
    same = (owner[a] == owner[b]) & (owner[a] > 0)
    return np.column_stack(PairEvidence().terms(cells, weights)), same, cells.sizes[cells.pairs].prod(axis=1)


def _logistic(terms: np.ndarray, same: np.ndarray, weights: np.ndarray) -> PairEvidence:
    """Coefficients (6,) of the weighted logistic regression."""

    def loss(beta: np.ndarray) -> tuple[float, np.ndarray]:
        x = terms @ beta
        value = weights @ np.logaddexp(0, np.where(same, -x, x)) / weights.sum() + 1e-5 * beta @ beta
        return value, (weights * (expit(x) - same)) @ terms / weights.sum() + 2e-5 * beta

    return PairEvidence(*minimize(loss, np.zeros(terms.shape[1]), jac=True, method="L-BFGS-B").x.tolist())
