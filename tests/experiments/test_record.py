"""The record of the studies: each result names the version of the program that made it."""

from __future__ import annotations

import json
import re
import subprocess

import numpy as np
import pytest

from mstfilter.base.files import read_csv
from tests.experiments.scripts import EXPERIMENTS, import_script

record = import_script("record.py")
STUDIES = record.studies()
REPOSITORY = EXPERIMENTS.parent


def test_every_folder_with_results_has_a_record():
    with_results = {path.relative_to(EXPERIMENTS).parts[0] for path in EXPERIMENTS.glob("*/**/*.csv")}
    recorded = {name for name, study in STUDIES.items() if study.record()}
    assert with_results <= recorded <= STUDIES.keys()
    for name in recorded:
        assert {"commit", "date"} <= STUDIES[name].record().keys(), name


@pytest.mark.parametrize("name", STUDIES)
def test_commands_name_files_of_the_repository(name):
    for command in STUDIES[name].commands:
        files = re.findall(r"experiments/\S+\.(?:py|toml)\b", command)
        assert all((REPOSITORY / file).is_file() for file in files)
        assert files or name == "tracking"
    assert all((REPOSITORY / place).exists() for place in STUDIES[name].depends)


def test_the_table_is_up_to_date():
    assert record.table() in (EXPERIMENTS / "README.md").read_text(encoding="utf-8")


def test_figures_of_the_front_page_are_those_of_the_record():
    """The table of the results has the means of the main study, and the page links to it."""
    page = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    results = page[page.index("## Results") : page.index("## What it does not do")]
    assert "main" in record.cited(results)
    measures = ("quality", "recalibrated_log_loss")
    values: dict[str, list[list[float]]] = {}
    for row in read_csv(EXPERIMENTS / "main/results/main_scenes.csv"):
        values.setdefault(row["arm"], []).append([float(row[m]) for m in measures])
    arms = ("mst", "single_frame", "object_fusion", "paper at its best", "floor_image")
    shown = re.findall(r"\| (\.\d+) \| (\.\d+) \|", results)
    assert len(shown) == len(arms)
    for arm, figures in zip(arms, shown, strict=True):
        np.testing.assert_allclose([float(x) for x in figures], np.mean(values[arm], axis=0), atol=6e-4, err_msg=arm)
    assert f"{np.mean(values['true completion'], axis=0)[0]:.3f}".lstrip("0") in results


FINGERPRINT = """
import json, sys
from pathlib import Path
from mstfilter.a import x
out = Path(sys.argv[1])
out.write_text(json.dumps(x))
sys.exit("--against" in sys.argv and out.read_text() != Path(sys.argv[3]).read_text())
"""


@pytest.fixture
def study(tmp_path, monkeypatch):
    """A repository with one study, whose command counts its runs."""
    monkeypatch.setattr(record, "REPOSITORY", tmp_path)
    for name, text in {
        "mstfilter/__init__.py": "",
        "mstfilter/a.py": '"""A."""\nx = 1\n',
        "mstfilter/app/b.py": "y = 1\n",
        "models/mst.toml": "n = 5\n",
        "experiments/one/run.py": "print(1)\n",
        "experiments/one/results/old.csv": "a\n1\n",
        "experiments/fingerprints/run.py": FINGERPRINT,
    }.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for command in ("init -q", "add .", "-c user.name=a -c user.email=a@b.c commit -qm first"):
        subprocess.run(["git", *command.split()], cwd=tmp_path, check=True)
    return record.Study("one", ["echo first >> log.txt", "echo second >> log.txt && test ! -e stop.txt"])


@pytest.mark.parametrize(
    "name, text, same",
    [
        ("mstfilter/a.py", '"""Another docstring."""\n\n# a comment\nx = 1\n', True),
        ("mstfilter/a.py", '"""A."""\n__version__ = "0.2.0"\nx = 1\n', True),
        ("mstfilter/a.py", '"""A."""\nx = 2\n', False),
        ("mstfilter/app/b.py", "y = 2\n", True),
        ("models/mst.toml", "n = 6\n", False),
        ("experiments/one/run.py", "print(2)\n", False),
        ("experiments/one/record.json", "{}", True),
    ],
)
def test_the_program_of_a_study(study, tmp_path, name, text, same):
    before = study.program()
    (tmp_path / name).write_text(text)
    assert (study.program() == before) is same


def test_a_study_is_run_once(study, tmp_path):
    assert not study.is_current()
    study.run()
    assert study.is_current() and not (study.folder / "results/old.csv").exists()
    found = json.loads((study.folder / "record.json").read_text())
    assert found["commands"] == study.commands and len(found["commit"]) == 8 and found["machine"]["system"]
    (tmp_path / "mstfilter/a.py").write_text("x = 2\n")
    assert not study.is_current()


def test_a_stopped_study_resumes_and_starts_again_after_a_change(study, tmp_path):
    log, stop = tmp_path / "log.txt", tmp_path / "stop.txt"
    stop.touch()
    with pytest.raises(SystemExit, match="exit status 1: echo second"):
        study.run()
    assert not study.record() and log.read_text().split() == ["first", "second"]
    rows = study.folder / "rows/s1.csv.xz"  # that the first command might have written
    rows.parent.mkdir()
    rows.touch()
    with pytest.raises(SystemExit):
        study.run()  # the first command is not run again
    assert rows.exists()
    assert log.read_text().split() == ["first", "second", "second"]
    (tmp_path / "mstfilter/a.py").write_text("x = 2\n")
    stop.unlink()
    study.run()
    assert log.read_text().split() == ["first", "second", "second", "first", "second"] and study.is_current()
    assert not rows.exists()


def test_intermediate_files_survive_an_interruption_of_the_first_command(study, tmp_path, monkeypatch):
    part = tmp_path / "studies/one/part.txt"

    def interrupted(*args, **kwargs):
        part.parent.mkdir(parents=True)
        part.touch()
        raise KeyboardInterrupt

    study = record.Study("one", ["test -e studies/one/part.txt  # --out studies/one"])
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(record.subprocess, "call", interrupted)
        study.run()
    study.run()
    assert part.exists() and study.is_current()


@pytest.mark.parametrize(
    "name, text, same",
    [
        ("mstfilter/a.py", "x = 2 - 1\n", True),
        ("mstfilter/a.py", "x = 2\n", False),
        ("experiments/one/run.py", "print(2)\n", False),
    ],
)
def test_equal_fingerprints_keep_the_results(study, tmp_path, name, text, same):
    study.run()
    record.compare([study])
    (tmp_path / name).write_text(text)
    if name.startswith("mstfilter"):
        with pytest.raises(SystemExit, match="not committed"):
            record.compare([study])
    for command in ("add mstfilter experiments/one/run.py", "-c user.name=a -c user.email=a@b.c commit -qm second"):
        subprocess.run(["git", *command.split()], cwd=tmp_path, check=True)
    made = study.record()["commit"]
    record.compare([study])
    assert study.is_current() is same and study.record()["commit"] == made
    if same:  # a second change of structure is compared with the first
        assert study.base == record._git("rev-parse", "--short=8", "HEAD") != made


def test_the_program_of_a_copy_is_asked_by_its_own_script(study, tmp_path):
    """Which files count has changed since: the hash of the copy is that which its own `record.py` computes."""
    study.run()
    (tmp_path / "experiments/record.py").write_text(
        "class Study:\n    def program(self):\n        return 'then'\n\n\n"
        "def studies():\n    return {'one': Study()}\n"
    )
    (tmp_path / "mstfilter/a.py").write_text("x = 2\n")
    assert not study.is_made_by(tmp_path)
    record.write_json(study.folder / "record.json", {**study.record(), "program": "then"})
    assert study.is_made_by(tmp_path) and not study.is_current()


@pytest.mark.parametrize("current", [True, False])
def test_the_check_fails_if_the_front_page_cites_an_older_study(current, monkeypatch):
    monkeypatch.setattr(record.Study, "is_current", lambda study: current)
    monkeypatch.setattr("sys.argv", ["record.py", "--check"])
    with pytest.raises(SystemExit) as end:
        record.main()
    assert end.value.code == 0 if current else "README.md cites" in end.value.code and "main" in end.value.code
