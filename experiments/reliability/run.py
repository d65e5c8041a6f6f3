"""Test commands that write files: stop at every operation, kill at random times, start twice at the same time."""

from __future__ import annotations

import argparse
import collections
import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from disk import LOSSES, content
from flows import PRESET, TINY, Flow, flows, reference, small_recording, trial

from mstfilter.base.files import read_csv, write_csv

HERE = Path(__file__).resolve().parent
COLUMNS = ("battery", "flow", "point", "loss", "result")
SLOW = ("study", "simulate", "demo")  # one kind of loss at each operation, in turn
HANGS_S = 300.0

Row = dict[str, Any]


def stops(one: Flow, folder: Path, every: int, known: set[tuple[str, ...]]) -> Iterator[Row]:
    """Trials of a flow that is stopped at every operation, and after the last one."""
    root, template = folder / "root", folder / "template"
    reference(one, root, template)  # a first use reads files that a second does not
    expected, n = reference(one, root, template)
    for k, loss in itertools.product(range(1, n + 2, every), LOSSES):
        if one.name in SLOW and loss != LOSSES[(k // every) % 3]:
            continue
        if (one.name, str(k), loss) not in known:
            yield {"point": k, "loss": loss, "result": trial(one, root, k, loss, expected, template)}


def commands(recording: Path) -> dict[str, Callable[[Path, int], list[str]]]:
    """Functions (folder, seed) -> arguments of a command that writes ``out`` in the folder, by name."""
    small = [f"{name}={str(value).lower()}" for name, value in TINY.items()]
    run = ["run", str(recording), "--preset", PRESET, "--no-report"]
    return {
        "run": lambda out, seed: [*run, "--out", str(out / "out"), "--seed", str(seed)],
        "run --replace": lambda out, seed: [*run, "--out", str(out / "out"), "--seed", str(seed), "--replace"],
        "simulate": lambda out, seed: ["simulate", "demo", str(out / "out"), *small, "--seed", str(seed)],
        "convert": lambda out, seed: ["convert", str(recording), str(out / "out")],
        "study": lambda out, seed: ["study", str(recording.parent / f"{seed}.toml"), "--out", str(out / "out")],
    }


def start(command: list[str]) -> subprocess.Popen[str]:
    """A command of mstfilter as a process."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    whole = [sys.executable, "-m", "mstfilter", *command]
    return subprocess.Popen(whole, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and standard error of a process. A process that hangs is killed and gets the exit code -99."""
    try:
        error = process.communicate(timeout=HANGS_S)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        return -99, process.communicate()[1]
    return process.returncode, error


def files(folder: Path) -> dict[str, bytes]:
    """What a command has written, without times and logs."""
    skipped = (
        "seconds.json",
        "result.json",
        ".csv",
        ".log",
        "summary.md",
        "summary.tex",
        "report.html",
    )  # with times
    found = content(folder, lambda name: name.endswith(skipped) and not name.endswith("metrics.csv"))
    return {name: data for name, data in found.items() if not name.endswith(".log")}


def kills(name: str, command: Callable[[Path, int], list[str]], n: int, folder: Path) -> Iterator[Row]:
    """Trials of a command that is killed at a random time, uniform over its duration, and started again."""
    draw = random.Random(name)
    began = time.perf_counter()
    assert finish(start(command(folder / "whole", 1)))[0] == 0
    duration = time.perf_counter() - began
    for k in range(n):
        root = folder / f"kill{k}"
        (root / "out").parent.mkdir()
        if name == "run --replace":
            shutil.copytree(folder / "whole" / "out", root / "out")
        process, delay = start(command(root, 1)), draw.uniform(0, duration)
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        code, error = finish(start(command(root, 1)))
        same = files(root / "out") == files(folder / "whole" / "out")
        if code == 2 and same and "not an empty folder" in error:
            code = 0  # it was killed after its result had been renamed
        elif [path for path in root.iterdir() if path.name != "out"]:
            same = False
        yield {"point": f"{delay:.3f}", "loss": "nothing", "result": verdict(code, error, same)}
        shutil.rmtree(root)


def pairs(name: str, command: Callable[[Path, int], list[str]], n: int, folder: Path) -> Iterator[Row]:
    """Trials in which a command is started with two seeds at the same time in one folder."""
    wholes = []
    for seed in (1, 2):
        assert finish(start(command(folder / f"whole{seed}", seed)))[0] == 0
        wholes.append(files(folder / f"whole{seed}" / "out"))
    for k in range(n):
        root = folder / f"pair{k}"
        root.mkdir()
        ended = [finish(process) for process in [start(command(root, seed)) for seed in (1, 2)]]
        codes = sorted(code for code, _ in ended)
        errors = [error for code, error in ended if code]
        clear = all(error.count("error:") == 1 and "Traceback" not in error for error in errors)
        fits = codes[0] == 0 and (codes[1] in (0, 2)) and clear
        same = files(root / "out") in [whole for whole, (code, _) in zip(wholes, ended, strict=True) if code == 0]
        result = "hangs" if -99 in codes else "same" if fits and same else f"codes {codes}: {errors}"
        yield {"point": k, "loss": "nothing", "result": result if fits or not same else f"raw error: {errors}"}
        shutil.rmtree(root)


def verdict(code: int, error: str, same: bool) -> str:
    """The result of a command that was repeated."""
    if code == -99:
        return "hangs"
    if code:
        return f"{'refused' if 'Traceback' not in error else 'raw error'}: {error.strip()[-200:]}"
    return "same" if same else "differs"


def summary(rows: list[Row]) -> list[Row]:
    """Counts by battery and flow."""
    groups: dict[tuple[str, str], collections.Counter[str]] = collections.defaultdict(collections.Counter)
    for row in rows:
        groups[row["battery"], row["flow"]][row["result"].split(":")[0]] += 1
    named = {
        "lost or mixed": ("differs", "codes"),
        "refused": ("refused",),
        "raw errors": ("raw error",),
        "hangs": ("hangs",),
    }
    return [
        {"battery": battery, "flow": flow, "tries": sum(counts.values()), "same": counts["same"]}
        | {name: sum(n for result, n in counts.items() if result.startswith(kinds)) for name, kinds in named.items()}
        for (battery, flow), counts in groups.items()
    ]


def main() -> None:
    """Run the trials of the chosen flows that trials.csv lacks, and write both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=HERE, help="folder of trials.csv and results.csv")
    parser.add_argument("--every", type=int, default=1, help="stop at every n-th operation")
    parser.add_argument("--trials", type=int, default=20, help="kills and pairs of each command")
    parser.add_argument("--flows", nargs="+", help="only these")
    options = parser.parse_args()
    file = options.out / "trials.csv"
    rows: list[Row] = list(read_csv(file)) if file.exists() else []
    with tempfile.TemporaryDirectory() as name, small_recording(Path(name) / "recordings") as recording:
        for seed in (1, 2):
            (recording.path.parent / f"{seed}.toml").write_text(
                f"name = 'small'\nseeds = [{seed}]\nscenes = [{{recordings = '{recording.path}'}}]\n"
                f"arms = [{{name = 'a', preset = '{PRESET}'}}]\ncache_gb = 0\n"
            )
        known = {(row["flow"], row["point"], row["loss"]) for row in rows if row["battery"] == "stops"}
        batteries = [
            ("stops", one.name, lambda folder, one=one: stops(one, folder, options.every, known))
            for one in flows(recording)
        ]
        for battery, trials in (("kills", kills), ("pairs", pairs)):
            for flow, command in commands(recording.path).items():
                done = sum(row["battery"] == battery and row["flow"] == flow for row in rows)
                wanted = 0 if battery == "pairs" and flow in ("convert", "run --replace") else options.trials - done
                if wanted > 0:
                    batteries.append(
                        (battery, flow, lambda folder, t=trials, f=flow, c=command, n=wanted: t(f, c, n, folder))
                    )
        for battery, flow, found in batteries:
            if options.flows and flow not in options.flows:
                continue
            with tempfile.TemporaryDirectory(dir=name) as folder:
                for row in found(Path(folder)):
                    rows.append({"battery": battery, "flow": flow, **row})
                    if row["result"] != "same":
                        print(battery, flow, row, flush=True)
            write_csv(file, rows, COLUMNS)
            print(summary([row for row in rows if (row["battery"], row["flow"]) == (battery, flow)]), flush=True)
    write_csv(options.out / "results.csv", summary(rows))


if __name__ == "__main__":
    main()
