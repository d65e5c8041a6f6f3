"""The miniature world: prior, pushes, a depth sensor and a segmentation sensor, all with exact probabilities.

>>> world = Miniature(shape=(3, 2))
>>> truth, observations = world.simulate(np.random.default_rng(0), T=5)      # states (T,), observations

A table of a few cells holds a few objects. A *state* assigns each cell to an object or to free space; two labellings
that differ only by the names of the objects are one state, so 6 cells have 877 states (the Bell number of 7). An
object may consist of several pieces, since crossover can make such objects. The camera looks along +y from y = 0:
pixel x shows the first occupied cell of column x, which occludes the cells behind it.

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
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Hypothesis, VoxelGrid, read_only

MAX_CELLS = 7  # 4140 states; 8 cells have 21147


@dataclass(frozen=True, eq=False)
class MiniatureStates:
    """The state space of a miniature world.

    Parameters
    ----------
    grid : VoxelGrid
        (X, Y, 1) cells.
    labels : (S, X Y) uint8
        Label of each cell in each state, cell (x, y) at x Y + y; 0 is free.
    """

    grid: VoxelGrid
    labels: np.ndarray
    _known: dict[bytes, int] = field(default_factory=dict, repr=False)  # bytes of raw labels -> state

    def __len__(self) -> int:
        return len(self.labels)

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The states as particles."""
        return tuple(Hypothesis.from_labels(row.reshape(self.grid.shape), self.grid) for row in self.labels)

    @cached_property
    def _number(self) -> dict[bytes, int]:
        return {row.tobytes(): s for s, row in enumerate(self.labels)}

    def index(self, hypotheses: Iterable[Hypothesis]) -> np.ndarray:
        """(n,) int: the state of each hypothesis."""
        return np.array([self.index_of_labels(h.labels) for h in hypotheses], dtype=np.int64)

    def index_of_labels(self, labels: np.ndarray) -> int:
        """The state of a label grid; the names of the objects do not matter."""
        raw = np.asarray(labels, dtype=np.uint16).tobytes()
        found = self._known.get(raw)
        if found is None:
            names: dict[int, int] = {0: 0}
            flat = np.asarray(labels).ravel().tolist()
            row = np.array([names.setdefault(int(k), len(names)) for k in flat], dtype=np.uint8)
            found = self._known[raw] = self._number[row.tobytes()]
        return found

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
        return read_only(self.labels > 0)

    @cached_property
    def pairs(self) -> np.ndarray:
        """(P, 2) all pairs of cells."""
        return np.array(list(combinations(range(self.labels.shape[1]), 2)), dtype=np.int64)

    @cached_property
    def same_object(self) -> np.ndarray:
        """(S, P) bool: the two cells of a pair belong to one object."""
        a, b = self.labels[:, self.pairs[:, 0]], self.labels[:, self.pairs[:, 1]]
        return read_only((a == b) & (a > 0))

    @cached_property
    def extra_pieces(self) -> np.ndarray:
        """(S,) number of pieces (connected by edges) beyond one per object."""
        from scipy.ndimage import label

        X, Y, _ = self.grid.shape
        extra = np.zeros(len(self), np.int64)
        for s, row in enumerate(self.labels):
            grid = row.reshape(X, Y)
            extra[s] = sum(label(grid == k)[1] - 1 for k in range(1, int(row.max()) + 1))
        return extra


@lru_cache(maxsize=16)
def miniature_states(shape: tuple[int, int]) -> MiniatureStates:
    """Every state of a table of X by Y cells.

    Raises
    ------
    InputError
        If there are more than `MAX_CELLS` cells.
    """
    X, Y = shape
    if X < 1 or Y < 1 or X * Y > MAX_CELLS:
        raise InputError(
            f"the miniature world has {X} x {Y} cells, expected 1 to {MAX_CELLS} cells",
            "the number of states grows as the Bell numbers: 877 for 6 cells, 4140 for 7, 21147 for 8",
        )
    rows: list[tuple[int, ...]] = [()]
    for _ in range(X * Y):
        rows = [(*row, k) for row in rows for k in range(max(row, default=0) + 2)]
    return MiniatureStates(VoxelGrid((0.0, 0.0, 0.0), 0.1, (X, Y, 1)), read_only(np.array(rows, dtype=np.uint8)))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class MiniatureObservation:
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
    def after(self) -> MiniatureObservation:
        """This observation, under the name of the last frame of a `Clip`."""
        return self


@dataclass(frozen=True)
class Miniature:
    """A world of a few cells.

    Parameters
    ----------
    shape : (X, Y)
        Pixels and depth in cells; at most 7 cells.
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

    def __post_init__(self) -> None:
        for name in ("occupied", "slip", "rearranged", "miss", "false_alarm", "split", "merge"):
            if not 0 < getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, expected a probability between 0 and 1")
        if self.miss + self.false_alarm >= 1:
            raise InputError(f"miss is {self.miss} and false_alarm {self.false_alarm}, expected a sum below 1")

    @property
    def states(self) -> MiniatureStates:
        """All states."""
        return miniature_states(self.shape)

    # --- prior ---------------------------------------------------------------------------------------------------
    @cached_property
    def log_prior(self) -> np.ndarray:
        """(S,) log prior probability of each state."""
        s = self.states
        full = s.occupied.sum(axis=1)
        lp = full * np.log(self.occupied) + (s.occupied.shape[1] - full) * np.log1p(-self.occupied)
        lp = lp - self.object_penalty * s.n_objects - self.piece_penalty * s.extra_pieces
        return read_only(lp - np.log(np.exp(lp - lp.max()).sum()) - lp.max())

    @cached_property
    def prior(self) -> np.ndarray:
        """(S,) sums to one."""
        return read_only(np.exp(self.log_prior))

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
        out = np.empty((len(self.actions), len(self.states)), np.int64)
        done: dict[tuple[int, int, tuple[int, int]], int] = {}
        for a, (cell, step) in enumerate(self.actions):
            for s, row in enumerate(self.states.labels):
                label = int(row[cell])
                if label == 0:
                    out[a, s] = s
                    continue
                key = (s, label, step)
                if key not in done:
                    done[key] = self._shifted(s, label, step)
                out[a, s] = done[key]
        return read_only(out)

    def _shifted(self, state: int, label: int, step: tuple[int, int]) -> int:
        grid = self.states.labels[state].reshape(self.shape)
        here = np.argwhere(grid == label)
        there = here + np.array(step)
        if (there < 0).any() or (there >= np.array(self.shape)).any():
            return state
        rest = np.where(grid == label, 0, grid)
        if rest[tuple(there.T)].any():
            return state
        rest[tuple(there.T)] = label
        return self.states.index_of_labels(rest)

    def predict(self, p: np.ndarray, action: int | None, rearranged: bool = True) -> np.ndarray:
        """(S,) distribution of the state after a push, from the one before; None is an unknown push."""
        moved = [
            np.bincount(self.pushed[a], p, len(p)) for a in (range(len(self.actions)) if action is None else [action])
        ]
        out = self.slip * p + (1 - self.slip) * np.mean(moved, axis=0)
        if rearranged:
            out = (1 - self.rearranged) * out + self.rearranged * p.sum() * self.prior
        return np.asarray(out)

    def log_transition(
        self, old: np.ndarray, new: np.ndarray, action: int | None, rearranged: bool = True
    ) -> np.ndarray:
        """(n,) log f(new | old, push) of paired states."""
        f = self.slip * (old == new)
        which = range(len(self.actions)) if action is None else [action]
        f = f + (1 - self.slip) * np.mean([self.pushed[a][old] == new for a in which], axis=0)
        if rearranged:
            f = (1 - self.rearranged) * f + self.rearranged * self.prior[new]
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(f))

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

    def draw_prior(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n,) states."""
        return draw_states(rng, self.prior, n)

    # --- sensors -------------------------------------------------------------------------------------------------
    @cached_property
    def surface(self) -> np.ndarray:
        """(S, X) int: free cells in front of the first occupied cell of a column; Y if there is none."""
        X, Y = self.shape
        full = self.states.occupied.reshape(-1, X, Y)
        return read_only(np.where(full.any(axis=2), full.argmax(axis=2), Y))

    @cached_property
    def same_surface(self) -> np.ndarray:
        """(S, X - 1) bool: neighbouring pixels show the same object, or both the background."""
        X, Y = self.shape
        padded = np.concatenate([self.states.labels.reshape(-1, X, Y), np.zeros((len(self.states), X, 1))], axis=2)
        seen = np.take_along_axis(padded, self.surface[:, :, None], axis=2)[:, :, 0]
        return read_only(seen[:, 1:] == seen[:, :-1])

    @cached_property
    def depth_probability(self) -> np.ndarray:
        """(Y + 1, Y + 1): row d is the distribution of the reading if the surface is at d."""
        Y = self.shape[1]
        p = np.zeros((Y + 1, Y + 1))
        for d in range(Y + 1):
            p[d, :d] = self.false_alarm / max(d, 1)
            p[d, d + 1 :] = self.miss / max(Y - d, 1)
            p[d, d] = 1 - p[d].sum()
        return read_only(p)

    @cached_property
    def join_probability(self) -> np.ndarray:
        """(2,) probability that neighbouring pixels are joined: if they show different objects, if the same one."""
        return read_only(np.array([self.merge, 1 - self.split]))

    def log_likelihood(self, observation: MiniatureObservation | None) -> np.ndarray:
        """(S,) log p(depth, segmentation | state); zeros if the observation is missing."""
        if observation is None:
            return np.zeros(len(self.states))
        depth = np.log(self.depth_probability)[self.surface, observation.depth].sum(axis=1)
        p = self.join_probability[self.same_surface.astype(int)]
        return np.asarray(depth + np.log(np.where(observation.joined, p, 1 - p)).sum(axis=1))

    def observe(self, rng: np.random.Generator, state: int, action: int = -1) -> MiniatureObservation:
        """Draw an observation of a state."""
        cumulative = np.cumsum(self.depth_probability, axis=1)[self.surface[state]]
        depth = (cumulative <= rng.random(self.shape[0])[:, None]).sum(axis=1)
        joined = rng.random(self.shape[0] - 1) < self.join_probability[self.same_surface[state].astype(int)]
        return MiniatureObservation(read_only(np.minimum(depth, self.shape[1])), read_only(joined), action)

    def simulate(self, rng: np.random.Generator, T: int) -> tuple[np.ndarray, list[MiniatureObservation]]:
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
