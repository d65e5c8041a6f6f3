"""Filters a recording, and writes the run folder.

>>> run = filter_recording(recording, load_config("mst"), Path("runs/mine"), seed=0)

All input is checked before the folder is made. If the run is interrupted, the same call with the same configuration,
seed and recording resumes it, and the result is that of an uninterrupted run.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import platform
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import mstfilter
from mstfilter.base.code import hash_of_files
from mstfilter.base.errors import InputError
from mstfilter.base.files import atomic_folder, check_output, locked
from mstfilter.base.lazy import progress_of
from mstfilter.base.processes import machine, parallel, threads
from mstfilter.base.registry import nested_components
from mstfilter.lab.oracles import bind_truth, uses_truth
from mstfilter.runs.presets import REGISTRY, build_filter, describe_filter
from mstfilter.runs.run_folder import RunFolder, as_json
from mstfilter.scene import Recording, UsesFiles, scene_cache
from mstfilter.scoring import ask
from mstfilter.smc import ParticleFilter

_LOGGER = logging.getLogger(__name__)
#: Rooms of mstfilter whose code changes no result of a run.
WITHOUT_RESULTS = ("app/", "runs/live/", "mst/testing/", "smc/testing/")
_LIBRARIES = ("numpy", "scipy", "networkx", "opencv-python-headless", "higra", "small_gicp", "torch")


def compared_configs(config: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Configurations of the filters with which a run is compared, if the fields of the proposal permit them."""
    parts = (config.get(slot) or {} for slot in ("proposal", "update"))
    proposal, update = ({"component": part} if isinstance(part, str) else part for part in parts)
    known = {f.name for f in fields(REGISTRY.find_class("proposal", proposal.get("component", ""), allow_files=True))}
    if "completer" in known & update.keys():
        proposal = {**proposal, "completer": update["completer"]}
    found = {"without past": {**config, "transition": "identity", "update": "samples_only", "proposal": proposal}}
    if "sampler" in known:
        found["single frame"] = found["without past"] | {"proposal": {**proposal, "sampler": "optimal"}}
    return found


def filter_recording(
    recording: Recording,
    config: Mapping[str, Any],
    path: Path,
    seed: int = 0,
    *,
    replace: bool = False,
    allow_files: bool = False,
    progress: bool | Callable[[int, int], None] = False,
    n_threads: int = 1,
) -> RunFolder:
    """Filter a recording and return the run folder.

    Parameters
    ----------
    recording : Recording
    config : mapping
        A configuration from `mstfilter.runs.presets.load_config`.
    path : Path
        The run folder: new, empty, or with the same run, interrupted.
    seed : int
        Seed of all random streams.
    replace : bool
        Whether an earlier run in the folder is replaced. It is removed only when the first step has succeeded.
    allow_files : bool
        Whether components may come from ``./file.py:Class``.
    progress : bool or callable
        True shows a progress bar. A function is called before the first step and after every step, with the numbers
        of finished and of all pauses.
    n_threads : int
        Number of threads of one step; the result does not depend on it.

    Raises
    ------
    InputError
        If the configuration or the recording is invalid, if the folder belongs to another run, or if another process
        is writing into the folder.
    """
    filter = build_filter(config, allow_files=allow_files)
    recording.check()
    bound = bind_truth(filter, recording)
    for part in nested_components(filter):
        if isinstance(part, UsesFiles):
            part.check_files(recording)
    entry = {
        "name": recording.name,
        "key": recording.key.hex(),
        "truth": recording.truth_key.hex(),
        "pauses": recording.pauses,
        "times": [recording.times[p] for p in recording.pauses],
        "generator": recording.manifest.get("generator"),
    }
    description = describe_run(entry, config, filter, int(seed))
    compared = path.parent.name == "compare" and (path.parent.parent / "run.json").is_file()
    with locked(path.parent.parent if compared else path):
        folder = _existing_folder(path, description, replace)
        done = 0 if folder is None else folder.n_pauses
        state = folder.state(done - 1) if folder is not None and done else bound.start(int(seed))
        with progress_of(progress, "filter") as advance, parallel(n_threads):
            try:
                clips = recording.clips()
                advance(done, len(clips))
                for clip in clips[done:]:
                    state, info = bound.step(state, clip)
                    truth = recording.truth(clip.index)
                    questions = None if truth is None else ask(recording, clip.index)
                    step = clip, state, info, truth, questions, recording.instance(recording.pauses[clip.index])
                    if folder is None:  # a run that fails in its first step leaves no folder, or an earlier run
                        folder = first_pause(path, description, replace, *step)
                    else:
                        folder.write_pause(*step)
                    scene_cache.forget()
                    seconds = sum(info.seconds.values())
                    _LOGGER.info("%s: pause %d filtered in %.2f s", recording.name, clip.index, seconds)
                    advance(clip.index + 1, len(clips))
            except BaseException as error:
                if folder is not None:
                    with contextlib.suppress(InputError, OSError):  # `error` is the cause
                        folder.set_status("interrupted" if isinstance(error, KeyboardInterrupt) else "failed")
                raise
        assert folder is not None
        folder.write_metrics()
        folder.set_status("done")
    return folder


def first_pause(path: Path, description: dict[str, Any], replace: bool, *step: Any) -> RunFolder:
    """Make a run folder and write its first pause. `step` has the arguments of `RunFolder.write_pause`."""
    with atomic_folder(path, "replace" if replace else "refuse") as work:
        RunFolder.create(work, description).write_pause(*step)
    return RunFolder(path)


def describe_run(
    recording: Mapping[str, Any], config: Mapping[str, Any], filter: ParticleFilter, seed: int
) -> dict[str, Any]:
    """The content of run.json except its format and status. `recording` is the description of the recording."""
    description: dict[str, Any] = as_json(
        {
            "seed": seed,
            "description": config.get("description", ""),
            "config": describe_filter(filter),
            "uses_truth": uses_truth(filter),
            "files": component_files(filter),
            "recording": recording,
            "versions": library_versions(),
            "machine": {**machine(), "threads": threads()},
        }
    )
    return description


def _existing_folder(path: Path, description: dict[str, Any], replace: bool) -> RunFolder | None:
    """The folder of the same run, to be resumed. None if the folder does not exist yet, or is to be replaced."""
    check_run_folder(path, replace)
    if replace or not (path / "run.json").is_file():
        return None
    folder = RunFolder.open(path)
    for key in ("seed", "config", "files", "recording", "versions"):
        found = folder.description.get(key)
        if found != description[key]:
            raise InputError(
                f"run folder {path} holds another run: its {key} differs"
                + _first_difference(found, description[key]),
                "choose another folder, or remove this one (on the command line: --replace)",
            )
    folder.repair()
    folder.check_origin()
    folder.set_status("running")
    return folder


def check_run_folder(path: Path, replace: bool = False) -> None:
    """Raise InputError unless `path` is a run folder or an empty folder, or a new folder can be made there.

    With `replace`, all files in a run folder must be part of a run.
    """
    if not os.path.isfile(path / "run.json"):  # False for a name that is too long, where Path.is_file raises
        check_output(path, folder=True)
    elif replace:
        check_output(path, folder=True, empty=False)
        RunFolder.open(path).check_replaceable()


def _first_difference(found: Any, wanted: Any, where: str = "") -> str:
    """The first entry in which two descriptions differ, as text."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in {**found, **wanted}:
            if found.get(key) != wanted.get(key):
                return _first_difference(found.get(key), wanted.get(key), f"{where}.{key}" if where else key)
    short = [json.dumps(v)[:60] for v in (found, wanted)]
    return f" ({where + ': ' if where else ''}{short[0]} there, {short[1]} now)"


def component_files(component: Any) -> dict[str, str]:
    """Hashes of the files that a component and its parts use: source files of the user, weights, other files.

    Comments and docstrings of a source file do not change its hash.
    """
    found: defaultdict[str, str] = defaultdict(str)
    for part in nested_components(component):
        name, source = type(part).__name__, type(part).__dict__
        if "__mst_file__" in source:
            found[REGISTRY.name_of(type(part))] = source["__mst_code__"]
        if key := str(getattr(part, "weights_key", "")):
            found[f"weights of {name}"] += key
        elif isinstance(part, UsesFiles):
            for field in part.path_fields:
                if path := getattr(part, field, ""):
                    found[f"{field} of {name}"] += _hash_of(Path(path))
    return dict(found)


def library_versions() -> dict[str, str]:
    """Versions of the libraries on which results depend."""
    found = {"mstfilter": mstfilter.__version__, "python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


def code_version() -> str:
    """A hash of the code of mstfilter on which results depend, without comments and docstrings."""
    root = Path(mstfilter.__file__).parent
    names = [path.relative_to(root).as_posix() for path in root.rglob("*.py")]
    return hash_of_files(root, [name for name in names if not name.startswith(WITHOUT_RESULTS)])


def _hash_of(path: Path) -> str:
    """A hash of a file, or of the names and contents of the files below a folder."""
    digest = hashlib.sha256()
    for file in sorted(_files_below(path)) if path.is_dir() else [path]:
        if file.is_file():
            digest.update(file.relative_to(path).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def _files_below(folder: Path) -> Iterator[Path]:
    """All files below a folder, also below links to folders. A link to a folder that contains it is not followed."""
    for path, folders, names in os.walk(folder, followlinks=True):
        if os.path.islink(path) and os.path.realpath(path) in map(os.path.realpath, Path(path).parents):
            folders.clear()
        else:
            yield from (Path(path) / name for name in names)
