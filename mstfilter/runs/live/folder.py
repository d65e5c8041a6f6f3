"""Filter a folder of images while another program adds images.

>>> filter_folder(Path("session"), Redwood(pauses=Settled()), load_config("mst"), Path("runs/session"))
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from mstfilter.base.errors import InputError
from mstfilter.base.files import locked
from mstfilter.formats import RecordingFormat, Redwood, Settled
from mstfilter.runs import RunFolder, check_run_folder, describe_run, first_pause
from mstfilter.runs.live.stream import Pause, Stream
from mstfilter.runs.presets import build_filter
from mstfilter.scene import content_key


def filter_folder(
    source: Path,
    reader: RecordingFormat,
    config: Mapping[str, Any],
    path: Path,
    seed: int = 0,
    *,
    idle_s: float = 10.0,
    replace: bool = False,
    allow_files: bool = False,
    n_threads: int = 1,
    on_pause: Callable[[Pause], Any] = lambda pause: None,
) -> RunFolder:
    """Filter the images of a folder while they arrive, and return the run folder.

    The files of each pause, except wall times, are identical to those of a run on the complete folder with the same
    pause rule, if every frame has depth: a stream drops the others. An interrupted live run cannot be resumed.

    Parameters
    ----------
    source : Path
        Folder with color/ and depth/, to which another program adds images.
    reader : RecordingFormat
        The reader of the folder: a `Redwood` whose field `pauses` is a `Settled`.
    config : mapping
        A configuration from `mstfilter.runs.presets.load_config`.
    path : Path
        The run folder, which is made at the first pause.
    seed : int
        Seed of all random streams.
    idle_s : float
        The run ends when no image has arrived for `idle_s` seconds.
    replace, allow_files, n_threads
        See `mstfilter.runs.filter_recording`.
    on_pause : callable
        Called with each `Pause` once its files are written.
    """
    if not isinstance(reader, Redwood):
        name = type(reader).__name__
        raise InputError(f"a live run cannot read {name}", "it reads folders color/ and depth/ (format redwood)")
    if not isinstance(reader.pauses, Settled):
        name = type(reader.pauses).__name__
        raise InputError(f"a live run cannot find pauses by {name}, which needs later frames", "--pauses settled")
    if (reader.start_s, reader.stop_s) != (0.0, math.inf):
        raise InputError("a live run reads all images: start_s and stop_s are for recordings")
    check_run_folder(path, replace)
    if not replace and (path / "run.json").is_file():
        raise InputError(f"run folder {path} exists", "choose another folder, or remove this one: --replace")
    filter = build_filter(config, allow_files=allow_files)
    entry: dict[str, Any] = {"name": source.resolve().name, "key": "", "truth": "", "generator": None}
    entry |= {"pauses": [], "times": []}
    folder: RunFolder | None = None

    def write(pause: Pause) -> None:
        nonlocal folder
        entry["pauses"].append(pause.frames[-1])
        entry["times"].append(pause.clip.times[-1])
        entry["key"] = content_key(entry["key"], pause.clip.key).hex()
        step = pause.clip, pause.state, pause.info, None
        if folder is None:
            folder = first_pause(path, describe_run(entry, config, filter, seed), replace, *step)
        else:
            folder.set_status("running", recording=entry)  # first: a list of more pauses than there are is allowed
            folder.write_pause(*step)
        on_pause(pause)

    def finish(status: str) -> None:
        if folder is not None:
            folder.write_metrics()
            folder.set_status(status)

    frames = reader.arriving(source, idle_s)
    with locked(path):
        time, frame = next(frames, (0.0, None))
        if frame is None:
            raise InputError(f"no image arrived in {source}")
        camera = frame.camera if reader.world.pose is None else frame.camera.at(reader.world.pose)
        settings: dict[str, Any] = {"grid": reader.world.grid, "seed": seed, "threads": n_threads}
        settings["max_pixels"] = reader.max_pixels
        try:
            with Stream(camera, filter, pauses=reader.pauses, on_pause=write, **settings) as stream:
                for when, one in chain([(time, frame)], frames):
                    stream.push(one.rgb, one.depth, when, robot_mask=one.robot_mask, wait=True)
        except BaseException as error:
            finish("interrupted" if isinstance(error, KeyboardInterrupt) else "failed")
            raise
        if folder is None:
            raise InputError(f"no pause found in {source}: the image was never still", "-o pauses.hold_s=0.2")
        finish("done")
    return folder
