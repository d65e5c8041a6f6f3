"""objects.csv and ``mstfilter objects``: the tables of a run, finished or interrupted."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.base.files import damaged_files
from mstfilter.mst.belief import push_candidates
from mstfilter.runs import RUN_FILES, TABLE_COLUMNS, chosen_pauses, object_rows, pause_documents
from tests.app.report.runs import make_run, truth_at
from tests.app.test_cli import call


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("tables") / "run")


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run that was killed after two pauses."""
    run = make_run(tmp_path_factory.mktemp("tables") / "run", pauses=2, done=False)
    assert not (run.path / "objects.csv").exists()
    return run


def read(path):
    return list(csv.DictReader(path.open(encoding="utf-8", newline="")))


def test_objects_csv_is_the_tables_of_all_pauses(run):
    rows = read(run.path / "objects.csv")
    assert tuple(rows[0]) == TABLE_COLUMNS
    table, seen = None, []
    for t in range(run.n_pauses):
        table = run.belief(t).objects(previous=table)
        assert [one.number for one in run.objects(t)] == [one.number for one in table]
        seen += [(t, one.number, one.existence, *one.centre, one.visible) for one in table]
    names = ("pause", "object", "existence", "centre_x", "centre_y", "centre_z")
    found = [(*(float(r[name]) for name in names), r["visible"] == "True") for r in rows]
    np.testing.assert_allclose(np.array(found, float), np.array(seen, float), atol=1e-4)
    # By hand: the second box of the truth stands at one place at all pauses.
    middle = np.argwhere(truth_at(0) == 2).mean(axis=0) * 0.02 + [-0.19, -0.19, 0.01]
    near = [r for r in rows if np.hypot(float(r["centre_x"]) - middle[0], float(r["centre_y"]) - middle[1]) < 0.01]
    assert len({r["object"] for r in near}) == 1 and len({r["pause"] for r in near}) >= 2


def test_the_sums_and_the_names_of_the_tables(run):
    assert damaged_files(run.path) == []
    listed = (run.path / "SHA256SUMS").read_text()
    assert "metrics.csv" in listed and "objects.csv" in listed
    (run.path / "objects.csv").write_text("other")
    assert damaged_files(run.path) == ["objects.csv has changed"]
    run.write_metrics()
    assert damaged_files(run.path) == [] and RUN_FILES.fullmatch("objects.csv")


def test_a_run_without_objects_has_a_header_alone(tmp_path):
    run = make_run(tmp_path / "run", empty=True)
    assert (run.path / "objects.csv").read_text() == ",".join(TABLE_COLUMNS) + "\n"
    assert [one["objects"] for one in pause_documents(run)] == [[], [], []]


def test_an_interrupted_run_has_its_objects(stopped, tmp_path, capsys):
    rows = object_rows(stopped)
    assert {row["pause"] for row in rows} == {0, 1}
    code, out, _ = call("objects", stopped.path, capsys=capsys)
    assert code == 0
    assert [line.split(",")[0] for line in out.splitlines() if line.startswith("pause")] == ["pause 0", "pause 1"]
    for t in (0, 1):
        assert repr(stopped.objects(t)) in out


def test_one_pause_csv_and_json(run, tmp_path, capsys):
    code, out, _ = call("objects", run.path, "--pause", "-1", capsys=capsys)
    assert code == 0 and out.startswith("pause 2, ") and out.count("pause") == 1 + out.count("at pause")
    code, out, _ = call("objects", run.path, "--json", "--pause", 1, capsys=capsys)
    [one] = json.loads(out)
    assert one["pause"] == 1 and one["objects"] == json.loads(json.dumps(run.objects(1).rows()))
    assert one["frame"] == run.description["recording"]["pauses"][1]
    borders = run.belief(1).open_borders(run.camera(1))
    assert [border["one_object"] for border in one["open_borders"]] == [round(b.one_object, 4) for b in borders]
    code, out, _ = call(*("objects", run.path, "--json", "--pause", 1, "--reach", -1, -1, 0, 1, 1, 1), capsys=capsys)
    pushes = push_candidates(run.belief(1), run.camera(1), ((-1, -1, 0), (1, 1, 1)))
    assert json.loads(out)[0]["pushes"] == [push.row() for push in pushes]
    call("objects", run.path, "--out", tmp_path / "all.json", capsys=capsys)
    assert json.loads((tmp_path / "all.json").read_text()) == json.loads(json.dumps(pause_documents(run)))
    call("objects", run.path, "--out", tmp_path / "all.csv", capsys=capsys)
    assert (tmp_path / "all.csv").read_bytes() == (run.path / "objects.csv").read_bytes()
    call("objects", run.path, "--out", tmp_path / "one.CSV", "--pause", 1, capsys=capsys)
    assert read(tmp_path / "one.CSV") == [row for row in read(run.path / "objects.csv") if row["pause"] == "1"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--pause", 3), "has no pause 3\nhint: complete pauses: 0 to 2"),
        (("--pause", -4), "has no pause -4"),
        (("--out", "objects.xlsx"), "ending of a table of objects is '.xlsx', expected .csv or .json"),
        (("--json", "--out", "objects.csv"), "ask for two formats"),
        (("--reach", -1, -1, 0, 1, 1, 1), "only JSON has pushes"),
        (("--json", "--reach", 1, 1, 1, 0, 0, 0), "expected two corners of a box"),
        (("--out", "absent/folder/objects.csv"), "absent"),
    ],
)
def test_wrong_arguments(run, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "absent").write_text("a file")
    code, _, err = call("objects", run.path, *arguments, capsys=capsys)
    assert code == 2 and message in err
    assert [path.name for path in tmp_path.iterdir()] == ["absent"]


def test_a_run_without_pauses(tmp_path):
    run = make_run(tmp_path / "run", done=False, pauses=1)
    assert chosen_pauses(run, -1) == [0]
    run.pause(0).rename(tmp_path / "away")
    with pytest.raises(InputError, match=r"(?s)no complete pause.*repeat the command"):
        chosen_pauses(run, None)
