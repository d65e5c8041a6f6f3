"""Components that use the ground truth of a recording.

A component gets a clip, which contains no truth. So a component that inherits `UsesTruth` is bound to a recording
before a run. `bind_truth` binds all components of a filter that use the truth, including nested components:

>>> filter = mstfilter.preset("mst", "update.completer=true_completion", "transition=true_motions")
>>> filter = bind_truth(filter, recording)            # the same filter if no component uses the truth
>>> state, infos = filter.run(recording.clips(), seed=0)

``mstfilter run`` and studies bind the components automatically. The truth is not a field of the component, so bound
and unbound components are equal and have the same description. Binding changes the `component_key` of a component.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import bound_to
from mstfilter.base.registry import nested_components
from mstfilter.scene import Frame, Recording

Need = Literal["voxels", "instance", "poses"]
_WORDS: dict[Need, str] = {"voxels": "true voxels", "instance": "instance image", "poses": "true poses"}

T = TypeVar("T")


class RecordingTruth:
    """The ground truth at the pauses of a recording. Call `check` first with the needs of a component."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self._instance: dict[int, np.ndarray] = {}

    def check(self, needs: tuple[Need, ...], component: str) -> None:
        """Raise InputError if data that a component needs are missing at any pause."""
        recording = self.recording
        get = {
            "voxels": recording.truth,
            "instance": lambda t: recording.instance(recording.pauses[t]),
            "poses": lambda t: recording.poses(recording.pauses[t]),
        }
        for need in needs:
            for t in range(len(recording.pauses)):
                if get[need](t) is None:
                    missing = f"recording {recording.name} has no {_WORDS[need]} at pause {t}"
                    raise InputError(
                        f"{component} uses the truth, and {missing}",
                        "simulated recordings have all of it: `mstfilter simulate`",
                    )

    def labels(self, t: int) -> np.ndarray:
        """(X, Y, Z) uint16 true labels at pause `t`."""
        labels = self.recording.truth(t)
        assert labels is not None
        return labels

    def instance(self, t: int) -> np.ndarray:
        """(H, W) int32 true object of each pixel at pause `t`; 0 for objects without true voxels."""
        if t not in self._instance:
            image = self.recording.instance(self.recording.pauses[t])
            assert image is not None
            self._instance[t] = np.where(np.isin(image, self._objects), image, 0).astype(np.int32)
        return self._instance[t]

    @cached_property
    def _objects(self) -> np.ndarray:
        """Labels with true voxels at any pause."""
        return np.unique([k for t in range(len(self.recording.pauses)) for k in np.unique(self.labels(t))])

    def motions(self, t: int) -> dict[int, np.ndarray]:
        """Motion (4, 4) of each object in the world, in metres, from pause `t` - 1 to pause `t`, by label."""
        pauses = self.recording.pauses
        before, after = (self.recording.poses(pauses[k]) for k in (t - 1, t))
        assert before is not None and after is not None
        return {k: after[k] @ np.linalg.inv(before[k]) for k in before.keys() & after.keys()}

    @cached_property
    def _pauses(self) -> dict[bytes, int]:
        """The first pause at which each frame was taken, by the key of the frame."""
        frames = self.recording.frames
        return {frames[index].key: t for t, index in reversed(list(enumerate(self.recording.pauses)))}

    @cached_property
    def _mended(self) -> dict[bytes, int]:
        """The first pause at which each frame was taken, by the key of the frame with estimated missing depth."""
        from mstfilter.scene import foreground  # needs cv2, which the registry does not

        recording = self.recording
        pauses = reversed(list(enumerate(recording.pauses)))
        return {foreground(recording.frames[index], recording.grid).frame.key: t for t, index in pauses}

    def pause_of(self, frame: Frame) -> int:
        """The pause at which a frame was taken, found by the content of the frame."""
        found = self._pauses.get(frame.key)
        if found is None:
            found = self._mended.get(frame.key)
        if found is None:
            raise InputError(
                f"a frame is none of the {len(self.recording.pauses)} pauses of recording {self.recording.name}",
                "components that use the truth need the recording to which they are bound",
            )
        return found


class UsesTruth:
    """Additional base class of components that use the truth."""

    #: Data that the component needs from a recording.
    needs: ClassVar[tuple[Need, ...]] = ("voxels",)

    def bind(self: T, truth: RecordingTruth) -> T:
        """A copy of the component that is bound to `truth`."""
        return bound_to(self, _truth=truth)

    @property
    def bound_key(self) -> bytes:
        """Key of the content of the truth; empty if the component is not bound."""
        truth = self.__dict__.get("_truth")
        return b"" if truth is None else truth.recording.truth_key

    @property
    def truth(self) -> RecordingTruth:
        """The truth of the bound recording. Raises InputError if the component is not bound."""
        truth = self.__dict__.get("_truth")
        if truth is None:
            raise InputError(
                f"{type(self).__name__} uses the truth and is bound to no recording",
                "call mstfilter.lab.oracles.bind_truth(filter, recording)",
            )
        return truth


def uses_truth(component: Any) -> list[str]:
    """Class names of the components that use the truth: the component itself and nested components, in order."""
    return [type(part).__name__ for part in nested_components(component) if isinstance(part, UsesTruth)]


def bind_truth(component: T, recording: Recording) -> T:
    """A filter or component, with all components that use the truth bound to a recording.

    Raises InputError if the recording lacks data that a component needs at any pause.
    """
    return _bind(component, RecordingTruth(recording)) if uses_truth(component) else component


def _bind(component: Any, truth: RecordingTruth) -> Any:
    """A component or a tuple of them, of which those that use the truth are bound; the same object if none does."""
    if isinstance(component, tuple):
        parts = tuple(_bind(part, truth) for part in component)
        return parts if any(a is not b for a, b in zip(parts, component, strict=True)) else component
    if not dataclasses.is_dataclass(component) or isinstance(component, type):
        return component
    values = {f.name: getattr(component, f.name) for f in dataclasses.fields(component) if f.init}
    bound = {name: part for name, value in values.items() if (part := _bind(value, truth)) is not value}
    component = dataclasses.replace(component, **bound) if bound else component
    if isinstance(component, UsesTruth):
        truth.check(component.needs, type(component).__name__)
        component = component.bind(truth)
    return component
