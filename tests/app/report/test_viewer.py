"""Scenes in three dimensions: the page, seen by a headless browser."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from mstfilter.app.report import recording_page, run_page, viewer, write_report
from mstfilter.app.report.answer import TABLE_HEADS, answers_of_run, table_cells
from mstfilter.base.errors import InputError
from mstfilter.formats import read_rgb, save_recording
from mstfilter.scene import Hypothesis, VoxelGrid
from tests.app.report.pages import check_html
from tests.app.report.runs import GRID, make_run, recording, truth_at
from tests.app.test_cli import call

LABELS = np.random.default_rng(0).integers(0, 3, (4, 3, 2))
SMALL = Hypothesis.from_labels(LABELS, VoxelGrid((0, 0, 0), 0.01, (4, 3, 2)))
needs_browser = pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("viewer") / "run")


def data_of(page):
    return json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', page.text)[1])


def volume(view, shape):
    """The labels (X, Y, Z) that the data of a page hold."""
    rows = np.frombuffer(base64.b64decode(view["runs"]), "<u2").reshape(-1, 2)
    labels = np.zeros(shape, int)
    inside = np.repeat(rows[:, 0], rows[:, 1]).reshape(view["shape"])
    box = tuple(slice(low, low + n) for low, n in zip(view["low"], view["shape"], strict=True))
    labels[box] = inside
    return labels


def open_faces(labels):
    """Number of faces between a voxel and another object or free space, found voxel by voxel."""
    padded = np.pad(labels, 1)
    steps = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    voxels = np.argwhere(padded > 0)
    return sum(int(padded[tuple(v + s)] != padded[tuple(v)]) for v in voxels for s in steps)


def browse(page, tmp_path, *options, size="600,500"):
    """Output of a headless browser without network that opens a page."""
    common = ["--headless", "--no-sandbox", "--disable-gpu", "--proxy-server=127.0.0.1:9", f"--window-size={size}"]
    command = ["chromium", *common, "--virtual-time-budget=2000", f"--user-data-dir={tmp_path / 'profile'}", *options]
    done = subprocess.run([*command, page.as_uri()], check=True, capture_output=True, timeout=600)
    return done.stdout.decode()


def pixels_of(picture, wanted):
    """Number of pixels with the hue of a colour, shaded by at most a factor of 0.62."""
    pixels = read_rgb(picture).reshape(-1, 3).astype(int)
    direction, length = np.array(wanted) / np.linalg.norm(wanted), np.linalg.norm(pixels, axis=1)
    near = (pixels @ direction > 0.999 * length) & (length < 1.02 * np.linalg.norm(wanted))
    return int((near & (length > 0.6 * np.linalg.norm(wanted))).sum())


def test_a_page_holds_the_labels(tmp_path):
    page = SMALL.show()
    check_html(page._repr_html_())
    check_html(page.save(tmp_path / "scene.html").read_text())
    view = data_of(page)["pauses"][0]["views"][0]
    assert np.array_equal(volume(view, LABELS.shape), LABELS)
    assert {o["text"] for o in view["objects"]} == {f"{k}: {n} cm³" for k, n in SMALL.volumes().items()}
    with pytest.raises(InputError, match="is a folder"):
        page.save(tmp_path)


@pytest.mark.parametrize("labels", [[], [0], [1] * 65535, [2] * 65536 + [0] + [3] * 200_000])
def test_runs_give_the_labels_back(labels):
    rows = viewer.encode_runs(np.array(labels, np.uint16))
    assert np.array_equal(np.repeat(rows[:, 0], rows[:, 1]), labels)
    assert (rows[:, 1] > 0).all()


def test_the_page_of_a_run(run):
    """Every distinct hypothesis and the truth of every pause; lines lead from a view to that of its ancestor."""
    page = run_page(run)
    check_html(page.text)
    pauses, before = data_of(page)["pauses"], {}
    assert [p["name"] for p in pauses] == [
        f"pause {t}, {run.description['recording']['times'][t]:.1f} s" for t in range(3)
    ]
    for t, pause in enumerate(pauses):
        info, hypotheses = run.info(t), run.hypotheses(t)
        *views, truth = pause["views"]
        assert len(views) == len({h.key for h in hypotheses})
        assert sum(view["weight"] for view in views) == pytest.approx(1)
        assert np.array_equal(volume(truth, GRID.shape), truth_at(t))
        place = {k: v for v, view in enumerate(views) for k in map(int, re.findall(r"#(\d+)", view["name"]))}
        for k, v in place.items():
            assert np.array_equal(volume(views[v], GRID.shape), hypotheses[k].labels)
        if t:
            parents = info["parents"]["previous"]
            assert {tuple(link) for link in pause["links"]} == {
                (before[p], place[k]) for k, p in enumerate(parents) if p >= 0
            }
        before = place
    assert all(p["photo"] is None for p in data_of(run_page(run, photos=False))["pauses"])


def test_the_page_has_the_words_and_the_table_of_the_report(run):
    """Per pause, with one row an object; the frame in the report, which has its own table, leaves them out."""
    data, answers = data_of(run_page(run)), answers_of_run(run)
    for said, (answer, happened) in zip(data["said"], answers, strict=True):
        assert said["text"] == " ".join([*happened, *answer.sentences])
        for row, cells in zip(said["rows"], table_cells(answer.table), strict=True):
            assert row == [cells["colour"], *(cells[name] for name in TABLE_HEADS)]
        assert len(said["rows"][0]) == 1 + len(data["columns"])
        mesh = base64.b64decode(said["mesh"].split(",")[1])
        assert mesh[:4] == b"glTF" and said["file"] == "two boxes.glb"
    assert data_of(run_page(run, head=False))["said"] == []


def test_the_command_writes_a_file_of_the_run(run, tmp_path, capsys):
    code, out, _ = call("view", run.path, capsys=capsys)
    assert code == 0 and str(run.path / "view.html") in out
    assert (run.path / "view.html").read_text() == run_page(run).text
    code, _, err = call("view", run.path, "--pauses", "0,1", capsys=capsys)
    assert code == 2 and "are for recordings" in err
    run.check_replaceable()
    assert call("view", run.path, "--out", tmp_path / "page.html", capsys=capsys)[0] == 0
    assert (tmp_path / "page.html").is_file()


def test_a_run_without_pauses_or_description(tmp_path, capsys):
    run = make_run(tmp_path / "run", 1)
    description = json.loads((run.path / "run.json").read_text())
    del description["description"]
    (run.path / "run.json").write_text(json.dumps(description))
    assert "two boxes" in run_page(run).text and write_report(run).is_file()
    shutil.rmtree(run.path / "pauses")
    code, _, err = call("view", run.path, capsys=capsys)
    assert code == 2 and "the run has no complete pause yet\nhint: repeat the command" in err


def test_the_name_of_a_recording_is_no_path_and_no_place_of_the_page(tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    source = save_recording(replace(recording(), name="../{{ data }}"), tmp_path / "got")
    assert call("view", source, capsys=capsys)[0] == 0
    (page,) = (tmp_path / "here").iterdir()
    assert {p.name for p in tmp_path.iterdir()} == {"here", "got"}
    assert "<title>../{{ data }}" in page.read_text()


def test_the_page_of_a_recording():
    """The truth, or the measured surface where there is none."""
    (view,) = data_of(recording_page(recording()))["pauses"][1]["views"]
    assert view["name"] == "truth" and np.array_equal(volume(view, GRID.shape), truth_at(1))
    (view,) = data_of(recording_page(recording(truth=False)))["pauses"][1]["views"]
    measured = volume(view, GRID.shape) > 0
    reached = np.pad(truth_at(1) > 0, 1)
    near = np.any([np.roll(reached, s, a)[1:-1, 1:-1, 1:-1] for a in range(3) for s in (-1, 0, 1)], axis=0)
    near[:, :, 0] = True  # the table
    assert measured.any() and (measured & ~near).sum() < 0.02 * measured.sum()


def test_an_empty_scene_has_a_page():
    empty = Hypothesis.from_labels(np.zeros((2, 2, 2), int), VoxelGrid((0, 0, 0), 0.01, (2, 2, 2)))
    assert data_of(empty.show())["pauses"][0]["views"][0]["runs"] == ""


@needs_browser
def test_a_browser_draws_a_run(run, tmp_path):
    """Image, voxels and time line are drawn without network."""
    page = run_page(run).save(tmp_path / "run.html")
    text = browse(page, tmp_path, "--dump-dom", size="1000,800")
    last = data_of(run_page(run))["pauses"][-1]["views"]
    assert text.count("<circle") == 2 * sum(len(p["views"]) for p in data_of(run_page(run))["pauses"])
    rows = answers_of_run(run)[-1][0].table
    assert text.count("<tr>") == 1 + len(rows) and rows[0].number
    heaviest = volume(last[0], GRID.shape)
    assert int(re.search(r'data-faces="(\d+)"', text)[1]) == open_faces(heaviest)
    assert html.escape(last[0]["name"]) in text
    browse(page, tmp_path, f"--screenshot={tmp_path / 'run.png'}", size="1000,800")
    for one in last[0]["objects"]:
        rgb = [int(one["colour"][k : k + 2], 16) for k in (1, 3, 5)]
        assert pixels_of(tmp_path / "run.png", rgb) > 200
