"""The miniature world: prior, pushes, a depth sensor and a segmentation sensor, all with exact probabilities.

>>> world = Miniature(shape=(3, 2))
>>> truth, glances = world.simulate(np.random.default_rng(0), T=5)      # states (T,), observations

The camera looks along +y from y = 0: pixel x shows the first occupied cell of column x, and hides those behind it.

**Motion.** At each step the robot pushes at a cell in a direction, both uniform and known. With probability `slip`
nothing moves; else the object there moves by one cell, unless the rim or another object is in the way. With
probability `rearranged` somebody lays the table anew: a draw from the prior.

**Depth sensor.** Pixel by pixel the number of free cells in front of the surface, Y where there is none. A surface is
missed with probability `miss` (a reading behind it) and one is seen too near with probability `false_alarm`.

**Segmentation sensor.** For each two neighbouring pixels whether they are joined. Two that show the same object (or
both the background) are split with probability `split`; two that do not are merged with probability `merge`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mstfilter.errors import InputError
from mstfilter.oracles.miniature.states import States, all_states
from mstfilter.scene import read_only

__all__ = ["Glance", "Miniature"]


@dataclass(frozen=True, eq=False)
class Glance:
    """The observation of a step.

    Parameters
    ----------
    depth : (X,) int
        Free cells in front of the surface at each pixel, Y for no surface.
    joined : (X - 1,) bool
        Whether the segmentation joins pixel x and x + 1.
    action : int
        The push before it (index into `Miniature.actions`); -1 at the first step.
    """

    depth: np.ndarray
    joined: np.ndarray
    action: int = -1

    @property
    def after(self) -> Glance:
        """What was seen after the push: itself. A `Clip` calls its last frame so."""
        return self


@dataclass(frozen=True)
class Miniature:
    """A world of a few cells.

    Parameters
    ----------
    shape : (X, Y)
        Pixels and depth in cells; at most 7 cells.
    occupied : float
        Prior probability of a cell to be occupied, before the penalties below.
    object_penalty, piece_penalty : float
        Log prior lost for each object, and for each piece of an object beyond its first.
    slip, rearranged : float
        Of the motion.
    miss, false_alarm : float
        Of the depth sensor.
    split, merge : float
        Of the segmentation sensor.
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
            raise InputError(f"miss {self.miss} and false_alarm {self.false_alarm} leave no right reading")

    @property
    def states(self) -> States:
        """All configurations."""
        return all_states(self.shape)

    # --- prior ---------------------------------------------------------------------------------------------------
    @cached_property
    def log_prior(self) -> np.ndarray:
        """(S,)."""
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
        """Every push: the cell that is pushed at, and the step in (x, y)."""
        X, Y = self.shape
        steps = ([(1, 0), (-1, 0)] if X > 1 else []) + ([(0, 1), (0, -1)] if Y > 1 else [])
        return tuple((cell, step) for cell in range(X * Y) for step in steps)

    @cached_property
    def pushed(self) -> np.ndarray:
        """(A, S) int: the state after a push that does not slip."""
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
        """(S,) the law of the state after a push, from the law before; the push is unknown where it is None."""
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
        slips, anew, fresh = rng.random(n) < self.slip, rng.random(n) < self.rearranged, self.draw_prior(rng, n)
        new = np.where(slips, old, self.pushed[push, old])
        return np.where(anew, fresh, new) if rearranged else new

    def draw_prior(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n,) states."""
        return draw(rng, self.prior, n)

    # --- sensors -------------------------------------------------------------------------------------------------
    @cached_property
    def surface(self) -> np.ndarray:
        """(S, X) int: free cells in front of the first occupied one of a column; Y where there is none."""
        X, Y = self.shape
        full = self.states.occupied.reshape(-1, X, Y)
        return read_only(np.where(full.any(axis=2), full.argmax(axis=2), Y))

    @cached_property
    def alike(self) -> np.ndarray:
        """(S, X - 1) bool: neighbouring pixels show the same object, or both the background."""
        X, Y = self.shape
        padded = np.concatenate([self.states.labels.reshape(-1, X, Y), np.zeros((len(self.states), X, 1))], axis=2)
        seen = np.take_along_axis(padded, self.surface[:, :, None], axis=2)[:, :, 0]
        return read_only(seen[:, 1:] == seen[:, :-1])

    @cached_property
    def depth_law(self) -> np.ndarray:
        """(Y + 1, Y + 1): row d is the law of the reading where the surface is at d."""
        Y = self.shape[1]
        law = np.zeros((Y + 1, Y + 1))
        for d in range(Y + 1):
            law[d, :d] = self.false_alarm / max(d, 1)
            law[d, d + 1 :] = self.miss / max(Y - d, 1)
            law[d, d] = 1 - law[d].sum()
        return read_only(law)

    @cached_property
    def join_law(self) -> np.ndarray:
        """(2,) probability that neighbouring pixels are joined: where they are not alike, where they are."""
        return read_only(np.array([self.merge, 1 - self.split]))

    def log_likelihood(self, glance: Glance | None) -> np.ndarray:
        """(S,) log p(depth, segmentation | state); zeros where the observation is missing."""
        if glance is None:
            return np.zeros(len(self.states))
        depth = np.log(self.depth_law)[self.surface, glance.depth].sum(axis=1)
        p = self.join_law[self.alike.astype(int)]
        return np.asarray(depth + np.log(np.where(glance.joined, p, 1 - p)).sum(axis=1))

    def look(self, rng: np.random.Generator, state: int, action: int = -1) -> Glance:
        """Draw what the sensors say of a state."""
        cumulative = np.cumsum(self.depth_law, axis=1)[self.surface[state]]
        depth = (cumulative <= rng.random(self.shape[0])[:, None]).sum(axis=1)
        joined = rng.random(self.shape[0] - 1) < self.join_law[self.alike[state].astype(int)]
        return Glance(read_only(np.minimum(depth, self.shape[1])), read_only(joined), action)

    def simulate(self, rng: np.random.Generator, T: int) -> tuple[np.ndarray, list[Glance]]:
        """True states (T,) and observations of T steps; the first has no push."""
        state = self.draw_prior(rng, 1)
        truth, glances = [int(state[0])], [self.look(rng, int(state[0]))]
        for _ in range(T - 1):
            action = int(rng.integers(len(self.actions)))
            state = self.move(rng, state, action)
            truth.append(int(state[0]))
            glances.append(self.look(rng, int(state[0]), action))
        return np.array(truth), glances


def draw(rng: np.random.Generator, p: np.ndarray, n: int) -> np.ndarray:
    """(n,) indices from a law (S,) that need not be normalised; none of probability zero."""
    cumulative = np.cumsum(p)
    last = int(np.flatnonzero(p)[-1])
    return np.minimum(np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right"), last)


def actions_of(glances: Sequence[Glance | None]) -> list[int | None]:
    """The push before each observation; None where the observation is missing."""
    return [None if g is None else g.action for g in glances]
