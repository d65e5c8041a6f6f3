"""Run the commands of the first hour of a new user: those of the documentation, in order, in an empty folder.

    python experiments/newcomer/run.py [--smoke] [--out FOLDER]

Every step is a separate process. A step fails if its exit code is not 0, or if its output lacks text that the
documentation shows, or contains a traceback. The script writes hour.csv (one row per step) and outputs.txt into
FOLDER (default: results/).
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS = REPOSITORY / "docs"
SMALL = "simulate demo demo/recording n_actions=1 n_objects_min=2 n_objects_max=2 supersample=false"
REMOVE = "import shutil; shutil.rmtree('demo/recording'); print('removed')"
#: What the documentation says that a command prints.
SHOWN = {
    "demo": r"report +demo/report.html",
    "simulate": r"recording +\S+",
    "run": r"pause \d+ +\d+ hypothes[ei]s of .* objects?, ESS",
    "report": r"report +\S+\.html",
    "new": r"component +\S+\.py\n(test +\S+\.py\n)?next +\S+",
    "check": r"all properties that apply hold",
    "study": r"runs +\d+ done",
    "convert": r"pauses +\d+ of \d+ frames",
    "quality": r"components",
    "view": r"page +\S+\.html",
    "list": r"presets:\n +authors",
    "python": r"\S",
}
#: The commands of docs/own-data.md that follow the conversion of a recording.
AFTER_CONVERT = ("mstfilter view table-7", "mstfilter run table-7")
#: The output of this program shows that the stream filtered two pauses.
COUNTS = "print(stream.counts['pushed'], 'frames,', 1 + stream.last.index, 'pauses')"
#: Own arrays: the first example of the README, with the arrays of the demo's recording.
ARRAYS = """
import numpy as np
from mstfilter import open_recording
demo = open_recording("demo/recording")
frames = demo.frames
rgb, depth = np.stack([frame.rgb for frame in frames]), np.stack([frame.depth for frame in frames])
K = frames[0].camera.K
"""
#: Own folder: the demo's recording, in the layout of the recorders of Open3D.
OWN_FOLDER = (
    ARRAYS
    + """
import json, os
import cv2
for part in ("color", "depth"):
    os.makedirs(f"bedroom/{part}")
order = [k for k in range(len(rgb)) for _ in range(16 if k in demo.pauses else 1)]  # at rest for half a second
for i, k in enumerate(order):
    cv2.imwrite(f"bedroom/color/{i:06d}.jpg", rgb[k][..., ::-1])
    cv2.imwrite(f"bedroom/depth/{i:06d}.png", np.nan_to_num(1000 * depth[k]).round().astype(np.uint16))
size = {"width": rgb.shape[2], "height": rgb.shape[1]}
with open("bedroom/camera_intrinsic.json", "w") as file:
    json.dump({**size, "intrinsic_matrix": K.T.ravel().tolist()}, file)
print(os.listdir("bedroom"))
"""
)


class Step(NamedTuple):
    """A step of the hour."""

    part: str
    command: list[str]  #: arguments of `mstfilter`, or of Python
    text: str  #: the command as the documentation shows it


def first_example(page: Path) -> str:
    """The first Python example of a page."""
    found = re.search(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert found is not None
    return found[1]


def commands(page: str) -> list[str]:
    """The mstfilter commands of the shell blocks of a page."""
    blocks = re.findall(r"^```(?:ba)?sh\n(.*?)```", (DOCS / page).read_text(), flags=re.DOTALL | re.MULTILINE)
    lines = [line.partition(" #")[0].strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith("mstfilter ")]


def steps(smoke: bool) -> list[Step]:
    """All steps, in order."""
    from mstfilter.mst.testing import starter_kinds

    def plan(part: str, text: str) -> Step:
        return Step(part, shlex.split(text)[1:], text)

    demo = f"mstfilter {SMALL}" if smoke else "mstfilter demo --out demo"
    found = [plan("demo", demo), plan("demo", "mstfilter list")]
    readme, live = (first_example(page) for page in (REPOSITORY / "README.md", DOCS / "live.md"))
    found.append(Step("own arrays", ["-c", ARRAYS + readme], "README.md, first example"))
    found.append(Step("live stream", ["-c", ARRAYS + live + COUNTS], "docs/live.md, first example"))
    found.append(Step("own folder", ["-c", OWN_FOLDER], "write the folder bedroom in the layout of Open3D"))
    folder = [text for text in commands("formats.md") if "bedroom" in text]
    folder += [text.replace("-7", "-3") for text in commands("own-data.md") if text.startswith(AFTER_CONVERT)]
    found += [plan("own folder", text) for text in folder]
    found.append(plan("live stream", "mstfilter run bedroom --live 3 --out run-live"))
    own = commands("own-component.md")
    found += [plan("study" if " study" in text or " report" in text else "own component", text) for text in own]
    if not smoke:
        found += [plan("command line", text) for text in commands("tutorial.md")]
        found += [
            Step("every kind", ["-c", REMOVE], "rm -r demo/recording"),
            plan("every kind", f"mstfilter {SMALL}"),
        ]
    for kind in ("evidence",) if smoke else starter_kinds("scenes"):
        found.append(plan("every kind", f"mstfilter new {kind} my_{kind}.py"))
    found.append(plan("viewer", "mstfilter view runs/mine --out run.html"))
    return found


def play(step: Step, folder: Path) -> tuple[str, str, float]:
    """Run a step; returns the reason why it failed (or ""), its output, and its seconds."""
    name = "python" if step.command[0] == "-c" or step.command[0].endswith(".py") else step.command[0]
    arguments = step.command if name == "python" else ["-m", "mstfilter", *step.command]
    start = time.perf_counter()
    done = subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True, timeout=3600)
    seconds, output = time.perf_counter() - start, done.stdout + done.stderr
    if done.returncode:
        return f"exit code {done.returncode}", output, seconds
    if "Traceback" in output or "fault of the program" in output:
        return "traceback", output, seconds
    if not re.search(SHOWN[name], output):
        return f"the output lacks {SHOWN[name]!r}", output, seconds
    return "", output, seconds


def main(out: Path, smoke: bool) -> int:
    """Run all steps; returns the number of failed steps."""
    from mstfilter.base.files import write_csv, write_text

    rows, outputs = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        page = (DOCS / "own-component.md").read_text(encoding="utf-8")
        studies = re.findall(r"^```toml\n(.*?)```", page, flags=re.DOTALL | re.MULTILINE)
        for file, text in zip(("two.toml", "best.toml"), studies, strict=True):
            short = text.replace('"0-1"', '"0"') if smoke else text
            (folder / file).write_text(short.replace('"20-31"', '"20"' if smoke else '"20-22"'))
        waiting = steps(smoke)
        while waiting:
            step = waiting.pop(0)
            fault, output, seconds = play(step, folder)
            if step.part == "every kind" and step.command[0] == "new":  # the commands that it prints, as printed
                printed = [line.split(maxsplit=1)[1] for line in output.splitlines() if line.startswith("next")]
                waiting[:0] = [Step(step.part, shlex.split(text)[1:], text) for text in printed]
            rows.append({"part": step.part, "step": step.text, "fault": fault, "seconds": round(seconds, 1)})
            outputs.append(f"$ {step.text}\n{output.replace(str(folder), '.').strip()}\n")
            print(f"{seconds:6.1f} s  {step.text}  {fault}", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    write_csv(out / "hour.csv", rows)
    write_text(out / "outputs.txt", "\n".join(outputs))
    failed = sum(bool(row["fault"]) for row in rows)
    print(f"{len(rows)} steps, {failed} failed, {sum(row['seconds'] for row in rows) / 60:.0f} minutes")
    return failed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    sys.exit(min(main(options.out, options.smoke), 1))
