"""Run a filter over a recording into a run folder.

>>> folder = filter_recording(recording, load_config("mst"), Path("runs/mine"), seed=0)

Everything that can be wrong with the input is found before the folder is made. A run that was stopped goes on
where it was, to the same result, when it is started again with the same configuration, seed and recording.
"""

from __future__ import annotations

import dataclasses
import json
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import mstfilter
from mstfilter.errors import InputError
from mstfilter.oracles import bind_truth
from mstfilter.presets import build_filter, describe_filter
from mstfilter.runs.run_folder import RunFolder, plain
from mstfilter.scene import Recording
from mstfilter.smc import Observer

__all__ = ["RunProgress", "filter_recording"]

_LIBRARIES = ("numpy", "scipy", "networkx", "opencv-python-headless", "higra", "small_gicp")


@dataclass(frozen=True)
class RunProgress:
    """What is reported while a run is going on: pauses done, pauses in all, wall seconds of the last step."""

    done: int
    total: int
    seconds: float = 0.0


def filter_recording(
    recording: Recording,
    config: Mapping[str, Any],
    path: Path,
    seed: int = 0,
    *,
    allow_files: bool = False,
    progress: Callable[[RunProgress], None] = lambda progress: None,
    observer: Observer | None = None,
) -> RunFolder:
    """Filter a recording; the run folder.

    Parameters
    ----------
    recording : Recording
        What was seen.
    config : mapping
        A configuration as `mstfilter.presets.load_config` returns it.
    path : Path
        The run folder: new, empty, or one of the same run that was stopped.
    seed : int
        Names all random streams.
    allow_files : bool
        Whether components may come from ``./file.py:Class``.
    progress : callable
        Called before the first step and after every step.
    observer : callable, optional
        ``observer(slot, begins)``, called when a component of the filter begins and ends its work.
    """
    filter = build_filter(config, allow_files=allow_files)
    recording.check()
    running = bind_truth(filter, recording)
    wanted = plain(
        {
            "seed": int(seed),
            "description": config.get("description", ""),
            "config": describe_filter(filter),
            "files": files_of(filter),
            "recording": {
                "name": recording.name,
                "key": recording.key.hex(),
                "pauses": recording.pauses,
                "times": [recording.times[p] for p in recording.pauses],
                "generator": recording.manifest.get("generator"),
            },
            "versions": versions(),
        }
    )
    folder = _existing(path, wanted)
    clips = recording.clips()
    done = 0 if folder is None else folder.n_pauses
    state = folder.state(done - 1) if folder is not None and done else running.start(int(seed))
    progress(RunProgress(done, len(clips)))
    try:
        for clip in clips[done:]:
            state, info = running.step(state, clip, observer)
            if folder is None:  # what fails at the first step leaves nothing behind
                folder = RunFolder.create(path, wanted)
            folder.write_pause(clip, state, info, recording.truth(clip.index))
            progress(RunProgress(clip.index + 1, len(clips), sum(info.seconds.values())))
    except KeyboardInterrupt:
        if folder is not None:
            folder.set_status("interrupted")
        raise
    except BaseException:
        if folder is not None:
            folder.set_status("failed")
        raise
    assert folder is not None
    folder.write_metrics()
    folder.set_status("done")
    return folder


def _existing(path: Path, wanted: dict[str, Any]) -> RunFolder | None:
    """The folder of the same run, to go on with; None where there is none yet."""
    if (path / "run.json").is_file():
        folder = RunFolder.open(path)
        for what in ("seed", "config", "files", "recording", "versions"):
            found = folder.description.get(what)
            if found != wanted[what]:
                raise InputError(
                    f"run folder {path} holds another run: its {what} differs"
                    + _first_difference(found, wanted[what]),
                    "choose another folder, or remove this one",
                )
        folder.set_status("running")
        return folder
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"cannot write a run to {path}: it exists and is not an empty folder", "choose another name")
    return None


def files_of(component: Any) -> dict[str, str]:
    """Content hashes of the users' files that components come from."""
    found = {}
    if dataclasses.is_dataclass(component):
        cls = type(component)
        if "__mst_source__" in cls.__dict__:
            found[cls.__dict__["__mst_file__"]] = cls.__dict__["__mst_source__"]
        for field in dataclasses.fields(component):
            found.update(files_of(getattr(component, field.name)))
    elif isinstance(component, tuple):
        for part in component:
            found.update(files_of(part))
    return found


def _first_difference(found: Any, wanted: Any, where: str = "") -> str:
    """Where two descriptions differ first, in words."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in {**found, **wanted}:
            if found.get(key) != wanted.get(key):
                return _first_difference(found.get(key), wanted.get(key), f"{where}.{key}" if where else key)
    short = [json.dumps(v)[:60] for v in (found, wanted)]
    return f" ({where + ': ' if where else ''}{short[0]} there, {short[1]} now)"


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    found = {"mstfilter": mstfilter.__version__, "python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found
