"""Pauses: the frames of a video at which nothing moves. `mstfilter.formats` has the rules that find them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from numbers import Integral

import numpy as np

from mstfilter.base.errors import InputError, check_integer, warn_user
from mstfilter.base.fields import Bounded
from mstfilter.base.lazy import late

_NEAR_S = 0.25  # half of the time that the rule `still` demands of a pause
_LONG = 20  # frames; more are probably not one clip


class PauseRule(Bounded, ABC):
    """Finds the pauses of a video. The package `mstfilter.formats` contains pause rules."""

    @abstractmethod
    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        """Ascending frame indices of the pauses.

        `times` are the times of all frames in seconds. ``read_rgb(index)`` returns a colour image (H, W, 3) uint8.
        """


_rule_of_text = late("mstfilter.formats.sources:pause_rule", "The rule of a text.")


def rule_for(
    pauses: Sequence[int] | str | PauseRule | None, n: int, timed: bool, name: str
) -> PauseRule | Sequence[int]:
    """The rule for the pauses of `n` frames, or their listed indices. `timed` says whether times are given."""
    if pauses is None and not timed and n > _LONG:
        warn_user(
            f"the {n} frames of {name} are one clip from the first to the last, since no pauses are given",
            "give pauses=(0, 40, 85), or times in seconds: pauses are then found where nothing moves",
        )
    if pauses is None:
        pauses = "still" if timed and n > 2 else "ends"
    rule: PauseRule | Sequence[int] = _rule_of_text(pauses) if isinstance(pauses, str) else pauses
    return rule


def indices_of(pauses: Sequence[int], n: int, name: str) -> tuple[int, ...]:
    """Listed pauses as indices of `n` frames. Raises InputError unless there is one and all exist."""
    listed = (pauses,) if isinstance(pauses, Integral) else pauses
    for pause in listed:
        hint = "a frame, counted from 0; from the end or in seconds as text: pauses='0,-1' or '0s,4.2s'"
        check_integer(f"a pause of {name}", pause, hint, at_least=0)
    chosen = tuple(int(p) for p in listed)
    if not chosen or max(chosen) >= n:
        raise InputError(f"pauses are {chosen}, expected indices of the {n} frames")
    return chosen


def pauses_with_depth(
    pauses: tuple[int, ...], times: Sequence[float], has_depth: Callable[[int], bool], name: str
) -> tuple[int, ...]:
    """The pauses, with frames that have depth readings at most a quarter of a second away instead of those without.

    Cameras miss single depth images. A pause without such a frame remains, and is refused when it is examined.
    """
    chosen = list(pauses)
    for k, pause in enumerate(pauses):
        near = [i for i, t in enumerate(times) if abs(t - times[pause]) <= _NEAR_S and i not in chosen]
        if near and not has_depth(pause):
            near = [i for i in sorted(near, key=lambda i: round(abs(times[i] - times[pause]), 6)) if has_depth(i)]
            if near:
                chosen[k] = near[0]
                text = f"frame {pause} of {name} has no depth reading: the pause is at frame {near[0]} instead"
                warn_user(text, "the two are at most 0.25 s apart; list other pauses if the scene moves there")
    return tuple(sorted(chosen))
