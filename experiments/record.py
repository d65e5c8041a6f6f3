"""Which version of the program made the results of each study, and all studies again by one command.

    python experiments/record.py                    # lists the studies: state, commit, date, core hours
    python experiments/record.py --run              # runs every study that is older than the program; resumable
    python experiments/record.py --run real main    # runs some studies, if they are older than the program
    python experiments/record.py --same             # compares the program of older results with the present one
    python experiments/record.py --check            # exit status 1 if the front page cites an older study
    python experiments/record.py --table            # the table of experiments/README.md

`studies.toml` lists the commands of each study, and the files on which its results depend. A study is *current* if
its results were made with the present state of these files and of its folder. The hash of the state ignores comments,
docstrings, the format of the code, the version number, and the packages that change no result.

After a run, `record.json` in the folder of the study has the hash of the program, the commit, the commands, the
machine, the libraries, the date and the processor time, without that of interrupted calls. A record without the hash
is older than the program.

An interrupted study continues with the next call. If the program has changed in between, the study starts again. The
former results, which git keeps, and the intermediate files are deleted first. `started.json` in the folder of the
study lists the finished commands. If this file and the folder `rows` are committed, another machine can continue.

A change of structure makes all results older. `--same` computes the hashes of `experiments/fingerprints` with the
program of the results and with the present program. Where all agree, the results are current again, and `record.json`
has the commit of the comparison as `equal`. A study whose own files have changed, or which depends on less than the
whole program, has to run again. Each program is asked by its own scripts, because modules have moved. The hashes are
of a few runs: a change that is meant to change results, even in a
rare case, needs the study.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from mstfilter.base.code import hash_of_files
from mstfilter.base.processes import machine
from mstfilter.base.reading import read_json
from mstfilter.runs import WITHOUT_RESULTS, library_versions, write_json

REPOSITORY = Path(__file__).resolve().parent.parent
PROGRAM = ("mstfilter", "models")
NO_RESULTS = tuple(f"mstfilter/{name}" for name in WITHOUT_RESULTS)


@dataclass(frozen=True)
class Study:
    """A folder of `experiments` with results, its commands, and the files on which the results depend."""

    name: str
    commands: list[str]
    depends: tuple[str, ...] = PROGRAM

    @property
    def folder(self) -> Path:
        """The folder of the study."""
        return REPOSITORY / "experiments" / self.name

    def record(self) -> dict[str, Any]:
        """The content of record.json; empty if the study has not been recorded."""
        return _read(self.folder / "record.json")

    def program(self, root: Path | None = None) -> str:
        """A hash of the files on which the results depend, in the repository or in a copy of it."""
        return _hash(root or REPOSITORY, *self.depends, f"experiments/{self.name}")

    @property
    def base(self) -> str:
        """The last commit whose program is known to give the results."""
        return str(self.record().get("equal", self.record().get("commit", "")))

    def is_made_by(self, root: Path) -> bool:
        """Whether the program in `root` made the results, with the present files of the study."""
        script = f"experiments/{self.name}"
        if self.depends != PROGRAM or _hash(root, script) != _hash(REPOSITORY, script):
            return False
        return self.record().get("program") in (self.program(root), self._program_then(root))

    def _program_then(self, root: Path) -> str:
        """The hash that the script of a copy of the repository computes: which files count has changed since."""
        places = os.pathsep.join([str(root), str(root / "experiments")])
        command = [sys.executable, "-c", f"import record; print(record.studies()[{self.name!r}].program())"]
        done = subprocess.run(command, cwd=root, env={**os.environ, "PYTHONPATH": places}, capture_output=True)
        return done.stdout.decode().strip()

    def is_current(self) -> bool:
        """Whether the present program made the results."""
        return self.record().get("program") == self.program()

    def run(self) -> None:
        """Run the commands that have not run with the present program, and write record.json."""
        state = self.folder / "started.json"
        done = _read(state)
        if done.get("program") != self.program():
            self._clear()
            done = {"program": self.program(), "commands": [], "core_hours": 0.0}
            write_json(state, done)
        for command in self.commands[len(done["commands"]) :]:
            print(f"{self.name}: {command}", flush=True)
            before = os.times()
            code = subprocess.call(command, shell=True, cwd=REPOSITORY)
            used = [getattr(os.times(), f) - getattr(before, f) for f in ("children_user", "children_system")]
            done["core_hours"] = round(done["core_hours"] + sum(used) / 3600, 2)
            done["commands"] += [command] * (code == 0)
            write_json(state, done)
            if code:
                sys.exit(f"error: a command of the study {self.name} ended with exit status {code}: {command}")
        if self.program() != done["program"]:
            sys.exit(f"error: the program changed while the study {self.name} ran\nhint: run the study again")
        about = {"commit": _head(), "date": date.today().isoformat(), "machine": machine()}
        write_json(self.folder / "record.json", {**done, **about, "libraries": library_versions()})
        state.unlink()

    def _clear(self) -> None:
        """Delete the results of the study and its intermediate files."""
        for name in ("results", "rows"):
            shutil.rmtree(self.folder / name, ignore_errors=True)
        for path in (*self.folder.glob("*.csv"), self.folder / "started.json"):
            path.unlink(missing_ok=True)
        for folder in re.findall(r"--out (studies/\S+)", " ".join(self.commands)):
            shutil.rmtree(REPOSITORY / folder, ignore_errors=True)


def studies() -> dict[str, Study]:
    """All studies of studies.toml, by name."""
    with (REPOSITORY / "experiments/studies.toml").open("rb") as file:
        found = tomllib.load(file)
    return {name: Study(name, one["commands"], tuple(one.get("depends", PROGRAM))) for name, one in found.items()}


def compare(older: list[Study]) -> None:
    """Record results as current where the fingerprints of their program agree with those of the present program."""
    if _git("status", "--porcelain", "--", *PROGRAM):
        sys.exit("error: the program has changes that are not committed\nhint: commit them, then compare again")
    with tempfile.TemporaryDirectory() as folder:
        present = Path(folder) / "present.json"
        for base in sorted({study.base for study in older} - {""}):
            tree = Path(folder) / base
            _git("worktree", "add", "--detach", str(tree), base)
            try:
                found = [study for study in older if study.base == base and study.is_made_by(tree)]
                known = bool(found) and (present.exists() or _fingerprints(REPOSITORY, present))
                agree = known and _fingerprints(tree, Path(folder) / f"{base}.json", "--against", str(present))
            finally:
                _git("worktree", "remove", "--force", str(tree))
            for study in found if agree else []:
                equal = {"program": study.program(), "equal": _head()}
                write_json(study.folder / "record.json", {**study.record(), **equal})


def _fingerprints(root: Path, *arguments: Path | str) -> bool:
    """Run the script of the fingerprints of a copy of the repository with the packages of this copy."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), str(root / "models")])}
    environment.setdefault("MSTFILTER_SHARED", str(REPOSITORY.parent / "shared"))
    command = [sys.executable, str(root / "experiments/fingerprints/run.py"), *map(str, arguments)]
    return subprocess.call(command, env=environment) == 0


def cited(text: str) -> set[str]:
    """The studies to which a text links."""
    return set(re.findall(r"experiments/(\w+)/README", text)) & studies().keys()


def table() -> str:
    """The table of experiments/README.md: version and cost of each study with results."""
    lines = ["| study | commit | date | core hours |", "|---|---|---|---|"]
    for name, study in studies().items():
        if record := study.record():
            columns = (str(record.get(column, "")) for column in ("commit", "date", "core_hours"))
            lines.append(f"| [{name}]({name}/README.md) | {' | '.join(columns)} |")
    return "\n".join(lines)


def _git(*arguments: str) -> str:
    return subprocess.check_output(["git", *arguments], cwd=REPOSITORY, text=True, stderr=subprocess.DEVNULL).strip()


def _head() -> str:
    return _git("rev-parse", "--short=8", "HEAD")


def _hash(root: Path, *places: str) -> str:
    """A hash of the files of some places that change results."""
    return hash_of_files(root, {name for place in places for name in _files(root, place)})


def _files(root: Path, place: str) -> Iterator[str]:
    path = root / place
    for file in path.rglob("*") if path.is_dir() else [path]:
        name = file.relative_to(root).as_posix()
        is_code = file.suffix in (".py", ".toml", ".safetensors") or file.name == "weights.json"
        if is_code and not name.startswith(NO_RESULTS):
            yield name


def _read(path: Path) -> dict[str, Any]:
    return read_json(path, "a record") if path.is_file() else {}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", nargs="*", metavar="STUDY", help="run these studies, or all, if they are older")
    parser.add_argument("--same", nargs="*", metavar="STUDY", help="compare the program of older results")
    parser.add_argument("--check", action="store_true", help="fail if the front page cites an older study")
    parser.add_argument("--table", action="store_true", help="print the table of experiments/README.md")
    options = parser.parse_args()
    if options.table:
        sys.exit(print(table()))
    found = studies()
    if options.run is not None:
        for name in options.run or found:
            if not found[name].is_current():
                found[name].run()
    if options.same is not None:
        compare([found[name] for name in options.same or found if not found[name].is_current()])
    if options.check:
        page = (REPOSITORY / "README.md").read_text(encoding="utf-8")
        older = sorted(name for name in cited(page) if not found[name].is_current())
        text = f"error: README.md cites studies that are older than the program: {', '.join(older)}"
        sys.exit(text if older else 0)
    for name, study in found.items():
        record = study.record()
        state = "current" if study.is_current() else "older" if record else "not measured"
        print(f"{name:18} {state:13}", *(str(record.get(column, "")) for column in ("commit", "date", "core_hours")))


if __name__ == "__main__":
    main()
