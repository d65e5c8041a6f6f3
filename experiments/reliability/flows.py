"""Small flows that write files: a flow writes below a folder, and gives equal bytes each time."""

from __future__ import annotations

import contextlib
import io
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
from disk import LOSSES as LOSSES, Disk, Stop, content

from mstfilter.app.cli import running
from mstfilter.base.errors import InputError
from mstfilter.base.files import damaged_files, sweep
from mstfilter.formats import open_recording, save_recording
from mstfilter.lab.simulation import cached_recording
from mstfilter.mst.frontends import write_masks
from mstfilter.runs import RunFolder, filter_recording
from mstfilter.runs.presets import load_config
from mstfilter.runs.study import run_study, study_of, worker
from mstfilter.scene import Recording

#: Changes to a family: a recording that is made in a second
TINY = {"width": 80, "height": 60, "n_actions": 1, "frames_per_clip": 3, "fps": 1.0, "supersample": False}
PRESET = "floor_components"  # needs no large library
_TIMES = (
    "seconds.json",
    "result.json",
    "runs.csv",
    "summary.csv",
    "summary.md",
    "summary.tex",
    "differences.csv",
    "report.html",
)


def nothing(root: Path) -> None:
    """The default of `Flow`."""


@dataclass(frozen=True)
class Flow:
    """A command: ``act(root)`` after ``prepare(root)``. ``always(root)`` raises if something is lost after a stop."""

    name: str
    act: Callable[[Path], object]
    prepare: Callable[[Path], object] = nothing
    always: Callable[[Path], None] = nothing
    leaves: bool = False  #: whether temporaries of a killed process may be left to a later sweep


class InProcess(worker.Worker):
    """Runs the jobs of a study in this process."""

    def perform(self, job: worker.Job, died: object = None) -> worker.JobOutcome:
        return worker.perform(job)

    def close(self) -> int:
        return 0


def flows(recording: Recording) -> list[Flow]:
    """All flows, on a small simulated recording."""
    config = load_config(PRESET)

    def run(root: Path, seed: int = 1, replace: bool = False) -> None:
        filter_recording(recording, config, root / "runs" / "one", seed, replace=replace)

    def one_of_both(root: Path) -> None:
        sweep(root / "runs")
        found = RunFolder.open(root / "runs" / "one")
        damage = [wrong for t in range(found.n_pauses) for wrong in damaged_files(found.pause(t))]
        if damage or not found.n_pauses:
            raise ValueError(f"the earlier run is lost: {damage}")

    def study(root: Path) -> None:
        data = {"scenes": [{"recordings": str(recording.path)}], "seeds": [0], "cache_gb": 0, "name": "small"}
        arms = [{"name": "a", "preset": PRESET}]
        with mock.patch("mstfilter.runs.study.study.Worker", InProcess):
            run_study(study_of({**data, "arms": arms}), root / "studies" / "one", workers=1, cache=root / "cache")

    def masks(root: Path, value: int = 1) -> None:
        write_masks(root / "masks", 0, [np.full((60, 80), value, np.uint8)])

    return [
        Flow("run", run),
        Flow("run --replace", lambda root: run(root, 2, True), run, one_of_both),
        Flow("study", study),
        Flow("simulate", lambda root: cached_recording("demo", 3, root / "cache", **TINY), leaves=True),
        Flow("save_recording", lambda root: save_recording(recording, root / "copies" / "one")),
        Flow("demo", lambda root: demo(recording, root, 2)),
        Flow("write_masks", lambda root: masks(root, 2), masks),
    ]


def demo(recording: Recording, root: Path, seed: int) -> None:
    """The command `demo` with a copied recording, with a light preset, and without pictures."""
    copied = mock.patch.object(running, "_simulate", lambda family, out, seed: shutil_copy(recording, out, seed))
    light = mock.patch("mstfilter.runs.presets.load_config", lambda name: load_config(PRESET))
    page = mock.patch("mstfilter.app.report.write_report", lambda run, path, numbers: path.write_text("mstfilter"))
    alone = mock.patch("mstfilter.runs.compared_configs", lambda config: {})
    with copied, light, page, alone, contextlib.redirect_stdout(io.StringIO()):
        running.demo(root / "demo", seed)


def shutil_copy(recording: Recording, out: Path, seed: int) -> None:
    """Save a recording as if it had been simulated with another seed."""
    save_recording(
        recording, out, **{**recording.manifest, "seed": seed, "frames": None, "family": {"name": running._DEMO}}
    )


def trial(flow: Flow, root: Path, stop_at: int, loss: str, expected: dict[str, bytes], template: Path) -> str:
    """Stop a flow at an operation, lose data as in a power failure, and repeat the flow; returns "same" or the fault.

    If the flow ends before the operation, nothing may be lost.
    """
    begin(root, template)
    with Disk(root, stop_at) as disk, contextlib.suppress(Stop):
        flow.act(root)
    disk.lose(loss)
    complete = not disk.stopped
    try:
        if disk.stopped:
            flow.always(root)
            flow.act(root)
    except InputError as error:
        if "is not an empty folder" not in error.message:
            return f"refused: {error.message}"
        complete = True  # the flow was stopped after its result had been renamed
    except Exception as error:
        return f"raw error: {type(error).__name__}: {error}"
    found = contents(root, flow)
    if complete:  # a lock or an earlier folder may remain until the name is used again
        found = {name: data for name, data in found.items() if name in expected or "/." not in f"/{name}"}
    wrong = [name for name in {**found, **expected} if found.get(name) != expected.get(name)]
    return f"differs: {', '.join(sorted(wrong))}" if wrong else "same"


def begin(root: Path, template: Path) -> None:
    """Restore the folder to its state before a trial."""
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(template, root)


def reference(flow: Flow, root: Path, template: Path) -> tuple[dict[str, bytes], int]:
    """Prepare the template; returns the files after a flow that is not stopped, and the number of its operations."""
    shutil.rmtree(template, ignore_errors=True)
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir()
    flow.prepare(root)
    shutil.copytree(root, template)
    with Disk(root) as disk:
        flow.act(root)
    return contents(root, flow), disk.count


def contents(root: Path, flow: Flow) -> dict[str, bytes]:
    """Bytes of all files by path, without contents that have times and without temporary files."""
    found = content(root, lambda name: name.endswith(_TIMES))
    return {name: data for name, data in found.items() if not (flow.leaves and ".partial" in name)}


@contextlib.contextmanager
def small_recording(folder: Path) -> Iterator[Recording]:
    """The recording of all flows."""
    yield open_recording(cached_recording("demo", 3, folder, **TINY))
