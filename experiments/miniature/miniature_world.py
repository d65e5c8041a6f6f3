"""The miniature world: prior, pushes, a depth sensor and a segmentation sensor, all with exact probabilities.

>>> world = Miniature(shape=(3, 2))
>>> truth, observations = world.simulate(np.random.default_rng(0), T=5)      # states (T,), observations

A table of a few cells holds a few objects. A *state* assigns each cell to an object or to free space; two labellings
that differ only by the names of the objects are one state, so 6 cells have 877 states (the Bell number of 7; 7 cells
have 4140, 8 have 21147). An object may consist of several pieces, since crossover can make such objects. The camera
looks along +y from y = 0: pixel x shows the first occupied cell of column x, which occludes the cells behind it.

**Motion.** At each step the robot pushes at a cell in a direction; both are uniform and known. With probability
`slip` nothing moves. Otherwise the object in the cell moves by one cell, unless it would leave the table or hit
another object. With probability `rearranged` the table is replaced by a draw from the prior.

**Depth sensor.** Each pixel reports the number of free cells in front of the surface, Y if there is no surface. A
surface is missed (a larger reading) with probability `miss`, and reported too near with probability `false_alarm`.

**Segmentation sensor.** For each two neighbouring pixels, whether they are joined. Two pixels that show the same
object (or both the background) are split with probability `split`; two others are merged with probability `merge`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy import ndimage

from mstfilter.scene import Hypothesis, VoxelGrid


class States:
    """All states of a table of X by Y cells.

    Attributes
    ----------
    labels : (S, X Y) uint8
        Label of each cell in each state, cell (x, y) at x Y + y; 0 is free.
    hypotheses : tuple of S Hypothesis
        The states as particles on a grid of (X, Y, 1) voxels.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        X, Y = shape
        rows: list[tuple[int, ...]] = [()]
        for _ in range(X * Y):
            rows = [(*row, k) for row in rows for k in range(max(row, default=0) + 2)]
        self.shape = shape
        self.labels = np.array(rows, dtype=np.uint8)
        self._number = {row: s for s, row in enumerate(rows)}
        grid = VoxelGrid((0.0, 0.0, 0.0), 0.1, (X, Y, 1))
        self.hypotheses = tuple(Hypothesis.from_labels(row.reshape(X, Y, 1), grid) for row in self.labels)

    def __len__(self) -> int:
        return len(self.labels)

    def index(self, hypotheses: Iterable[Hypothesis]) -> np.ndarray:
        """(n,) int: the state of each hypothesis."""
        return np.array([self.index_of_labels(h.labels) for h in hypotheses], dtype=np.int64)

    def index_of_labels(self, labels: np.ndarray) -> int:
        """The state of a label grid; the names of the objects do not matter."""
        names = {0: 0}
        return self._number[tuple(names.setdefault(k, len(names)) for k in labels.ravel().tolist())]

    def take(self, index: np.ndarray) -> tuple[Hypothesis, ...]:
        """Particles of the given states."""
        return tuple(self.hypotheses[int(s)] for s in index)

    @cached_property
    def n_objects(self) -> np.ndarray:
        """(S,) number of objects."""
        return self.labels.max(axis=1).astype(np.int64)

    @cached_property
    def occupied(self) -> np.ndarray:
        """(S, cells) bool."""
        return self.labels > 0

    @cached_property
    def same_object(self) -> np.ndarray:
        """(S, P) bool: the two cells of each pair of cells belong to one object."""
        i, j = np.array(list(combinations(range(self.labels.shape[1]), 2))).T
        return (self.labels[:, i] == self.labels[:, j]) & self.occupied[:, i]

    @cached_property
    def extra_pieces(self) -> np.ndarray:
        """(S,) number of pieces (connected by edges) beyond one per object."""
        pieces = [
            sum(ndimage.label(row.reshape(self.shape) == k)[1] for k in range(1, row.max() + 1))
            for row in self.labels
        ]
        return np.array(pieces) - self.n_objects


@dataclass(frozen=True, eq=False)
class Observation:
    """The observation of a step.

    Parameters
    ----------
    depth : (X,) int
        Free cells in front of the surface at each pixel, Y for no surface.
    joined : (X - 1,) bool
        Whether the segmentation joins pixel x and x + 1.
    action : int
        The preceding push (index into `Miniature.actions`); -1 at the first step.
    """

    depth: np.ndarray
    joined: np.ndarray
    action: int = -1

    @property
    def index(self) -> int:
        """The pause at which proposed objects are born: 0, because nothing here depends on their identity."""
        return 0

    @property
    def after(self) -> Observation:
        """This observation, under the name of the last frame of a `Clip`."""
        return self


@dataclass(frozen=True)
class Miniature:
    """A world of a few cells.

    Parameters
    ----------
    shape : (X, Y)
        Pixels and depth in cells.
    occupied : float
        Prior probability that a cell is occupied, before the penalties below.
    object_penalty, piece_penalty : float
        Subtracted from the log prior for each object, and for each piece of an object beyond its first.
    slip, rearranged : float
        Probabilities of the motion.
    miss, false_alarm : float
        Error probabilities of the depth sensor.
    split, merge : float
        Error probabilities of the segmentation sensor.
    """

    shape: tuple[int, int] = (3, 2)
    occupied: float = 0.35
    object_penalty: float = 0.3
    piece_penalty: float = 2.5
    slip: float = 0.3
    rearranged: float = 0.05
    miss: float = 0.08
    false_alarm: float = 0.05
    split: float = 0.25
    merge: float = 0.15

    @cached_property
    def states(self) -> States:
        """All states."""
        return States(self.shape)

    @cached_property
    def prior(self) -> np.ndarray:
        """(S,) probability of each state."""
        s = self.states
        full = s.occupied.sum(axis=1)
        lp = full * np.log(self.occupied) + (s.occupied.shape[1] - full) * np.log1p(-self.occupied)
        lp = lp - self.object_penalty * s.n_objects - self.piece_penalty * s.extra_pieces
        return np.exp(lp - np.log(np.exp(lp - lp.max()).sum()) - lp.max())

    def draw_prior(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n,) states."""
        return draw_states(rng, self.prior, n)

    # --- motion --------------------------------------------------------------------------------------------------
    @cached_property
    def actions(self) -> tuple[tuple[int, tuple[int, int]], ...]:
        """All pushes: the cell that is pushed, and the step in (x, y)."""
        X, Y = self.shape
        steps = ([(1, 0), (-1, 0)] if X > 1 else []) + ([(0, 1), (0, -1)] if Y > 1 else [])
        return tuple((cell, step) for cell in range(X * Y) for step in steps)

    @cached_property
    def pushed(self) -> np.ndarray:
        """(A, S) int: the state after each push that does not slip."""
        return np.array([[self._push(s, cell, step) for s in range(len(self.states))] for cell, step in self.actions])

    def _push(self, state: int, cell: int, step: tuple[int, int]) -> int:
        row = self.states.labels[state]
        if row[cell] == 0:
            return state
        grid, moving = row.reshape(self.shape), (row == row[cell]).reshape(self.shape)
        target = np.argwhere(moving) + step
        if (target < 0).any() or (target >= self.shape).any():
            return state
        after = np.where(moving, 0, grid)
        if after[tuple(target.T)].any():
            return state
        after[tuple(target.T)] = row[cell]
        return self.states.index_of_labels(after)

    def predict(self, p: np.ndarray, action: int | None, rearranged: bool = True) -> np.ndarray:
        """(S,) distribution of the state after a push, from the one before; None is an unknown push."""
        actions = range(len(self.actions)) if action is None else [action]
        moved = [np.bincount(self.pushed[a], p, len(p)) for a in actions]
        out = self.slip * p + (1 - self.slip) * np.mean(moved, axis=0)
        if rearranged:
            out = (1 - self.rearranged) * out + self.rearranged * p.sum() * self.prior
        return out

    def move(
        self, rng: np.random.Generator, old: np.ndarray, action: int | None, rearranged: bool = True
    ) -> np.ndarray:
        """(n,) states after a push."""
        n = len(old)
        push = rng.integers(len(self.actions), size=n) if action is None else np.full(n, action)
        slips, replaced = rng.random(n) < self.slip, rng.random(n) < self.rearranged
        fresh = self.draw_prior(rng, n)
        new = np.where(slips, old, self.pushed[push, old])
        return np.where(replaced, fresh, new) if rearranged else new

    # --- sensors -------------------------------------------------------------------------------------------------
    @cached_property
    def surface(self) -> np.ndarray:
        """(S, X) int: free cells in front of the first occupied cell of a column; Y if there is none."""
        X, Y = self.shape
        full = self.states.occupied.reshape(-1, X, Y)
        return np.where(full.any(axis=2), full.argmax(axis=2), Y)

    @cached_property
    def same_surface(self) -> np.ndarray:
        """(S, X - 1) bool: neighbouring pixels show the same object, or both the background."""
        labels = np.pad(self.states.labels.reshape(-1, *self.shape), ((0, 0), (0, 0), (0, 1)))
        seen = np.take_along_axis(labels, self.surface[:, :, None], axis=2)[:, :, 0]
        return seen[:, 1:] == seen[:, :-1]

    @cached_property
    def depth_probability(self) -> np.ndarray:
        """(Y + 1, Y + 1): row d is the distribution of the reading if the surface is at d."""
        Y = self.shape[1]
        p = np.zeros((Y + 1, Y + 1))
        for d in range(Y + 1):
            p[d, :d] = self.false_alarm / max(d, 1)
            p[d, d + 1 :] = self.miss / max(Y - d, 1)
            p[d, d] = 1 - p[d].sum()
        return p

    @cached_property
    def join_probability(self) -> np.ndarray:
        """(2,) probability that neighbouring pixels are joined: if they show different objects, if the same one."""
        return np.array([self.merge, 1 - self.split])

    def log_likelihood(self, observation: Observation | None) -> np.ndarray:
        """(S,) log p(depth, segmentation | state); zeros if the observation is missing."""
        if observation is None:
            return np.zeros(len(self.states))
        depth = np.log(self.depth_probability)[self.surface, observation.depth].sum(axis=1)
        p = self.join_probability[self.same_surface.astype(int)]
        return depth + np.log(np.where(observation.joined, p, 1 - p)).sum(axis=1)

    def observe(self, rng: np.random.Generator, state: int, action: int = -1) -> Observation:
        """Draw an observation of a state."""
        cumulative = np.cumsum(self.depth_probability, axis=1)[self.surface[state]]
        depth = (cumulative <= rng.random(self.shape[0])[:, None]).sum(axis=1)
        joined = rng.random(self.shape[0] - 1) < self.join_probability[self.same_surface[state].astype(int)]
        return Observation(np.minimum(depth, self.shape[1]), joined, action)

    def simulate(self, rng: np.random.Generator, T: int) -> tuple[np.ndarray, list[Observation]]:
        """True states (T,) and observations of T steps; the first has no push."""
        state = self.draw_prior(rng, 1)
        truth, observations = [int(state[0])], [self.observe(rng, int(state[0]))]
        for _ in range(T - 1):
            action = int(rng.integers(len(self.actions)))
            state = self.move(rng, state, action)
            truth.append(int(state[0]))
            observations.append(self.observe(rng, int(state[0]), action))
        return np.array(truth), observations


def draw_states(rng: np.random.Generator, p: np.ndarray, n: int) -> np.ndarray:
    """(n,) indices drawn from p (S,), which need not be normalised; never one of probability zero."""
    cumulative = np.cumsum(p)
    last = int(np.flatnonzero(p)[-1])
    return np.minimum(np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right"), last)
