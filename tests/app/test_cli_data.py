"""convert, quality, and run on data of other formats, from the command line."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.formats import RecordingWriter, open_recording
from mstfilter.scene import VoxelGrid
from mstfilter.scoring import ask
from tests.app.test_cli import call
from tests.formats import layouts
from tests.formats.bags import scene_messages, write as write_bag
from tests.scene.scenes import CAMERA, table_scene
from tests.scene.test_recording import write

K = "K=131,131,79.5,59.5"


def clear_error(err):
    """One line `error:`, then hints, nothing else but a bar of progress."""
    lines = [line for line in err.splitlines() if line.strip() and not line.startswith("convert   ")]
    assert lines, "there is no message"
    assert lines[0].startswith("error: "), err
    assert all(line.startswith("hint: ") for line in lines[1:]), err
    assert "Traceback" not in err


def late_fault(path):
    """Only the last image is broken: most is written before that is seen."""
    layouts.write_redwood(path)
    file = max((path / "depth").iterdir())
    file.write_bytes(file.read_bytes()[:-20])
    return path


ERRORS = {
    "missing intrinsics": (layouts.write_tum, [], "intrinsics are missing"),
    "wrong format": (layouts.write_redwood, ["--format", "tum"], "not a TUM folder"),
    "no pause": (layouts.write_redwood, [], "no pause found"),  # at 30 fps nothing holds still for half a second
    "broken at the end": (late_fault, ["-o", "fps=10"], "image is truncated"),
    "unknown option": (layouts.write_redwood, ["-o", "scale=2"], "no field 'scale'"),
}


@pytest.mark.parametrize(("command", "fault"), [*(("convert", fault) for fault in ERRORS), ("run", "no pause")])
def test_errors_leave_no_files(tmp_path, capsys, command, fault):
    make, options, message = ERRORS[fault]
    path = make(tmp_path / "data")
    before = sorted(tmp_path.iterdir())
    arguments = [tmp_path / "out"] if command == "convert" else ["--out", tmp_path / "out"]
    code, _, err = call(command, path, *arguments, *options, capsys=capsys)
    assert code == 2, err
    clear_error(err)
    assert message in err
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("stop", "expected"), [(KeyboardInterrupt(), 130), (OSError(28, "No space left on device"), 2)]
)
def test_a_stopped_conversion_leaves_no_folder(tmp_path, capsys, monkeypatch, stop, expected):
    """An interruption, and a disk that is full at the fifth image."""
    from mstfilter.formats import folder

    count, usual = [], folder.write_image

    def write_image(path, image):
        count.append(path)
        if len(count) == 5:
            raise stop
        usual(path, image)

    monkeypatch.setattr(folder, "write_image", write_image)
    data = layouts.write_redwood(tmp_path / "data")
    code, _, err = call("convert", data, tmp_path / "out", "-o", "fps=10", capsys=capsys)
    assert code == expected
    assert ("interrupted: nothing" if expected == 130 else "No space left on device") in err
    assert len(count) == 5
    assert list(tmp_path.iterdir()) == [data]


def test_run_reads_a_bag_as_its_conversion(tmp_path, capsys):
    """The same hypotheses whether the data were converted before or not."""
    path = write_bag(tmp_path / "data", "mcap", scene_messages(False))
    options = ["--no-report", "n=3", "n_proposed=2"]
    code, out, err = call("run", path, "--out", tmp_path / "direct", *options, capsys=capsys)
    assert code == 0, err
    assert "pause 1     " in out and "3 hypotheses, ESS" in out
    assert call("convert", path, tmp_path / "r", capsys=capsys)[0] == 0
    assert call("run", tmp_path / "r", "--out", tmp_path / "later", *options, capsys=capsys)[0] == 0
    for t in ("000", "001"):
        a, b = (
            np.load(tmp_path / run / "pauses" / t / "state.npz")["particles/labels"] for run in ("direct", "later")
        )
        np.testing.assert_array_equal(a, b)


def test_quality(tmp_path, capsys):
    recording = write(tmp_path / "slide")
    code, _, err = call(
        "run", recording, "n=3", "n_proposed=2", "--out", tmp_path / "run", "--no-report", capsys=capsys
    )
    assert code == 0, err
    code, out, err = call("quality", tmp_path / "run", recording, "--csv", tmp_path / "q.csv", capsys=capsys)
    assert code == 0, err
    table, belief = out.split("\n\n")
    one = open_recording(recording)
    shares = [ask(one, t).outcomes(one.truth(t)).mean() for t in range(3)]
    base_rates = [float(line.split()[2]) for line in belief.splitlines()[2:5]]
    assert base_rates == pytest.approx([-p * np.log(p) - (1 - p) * np.log(1 - p) for p in shares], abs=6e-4)
    rows = csv.DictReader((tmp_path / "q.csv").open())
    means = [float(row["mean"]) for row in rows if row["form"] == "objects"]
    assert float(table.splitlines()[-3].split()[2]) == pytest.approx(np.mean(means), abs=6e-4)
    for arguments, message in (
        ((tmp_path / "run", tmp_path / "none"), "does not exist"),
        ((tmp_path, recording), "not a run folder"),
        ((tmp_path / "run", tmp_path / "q.csv"), "has no known format"),
    ):
        code, _, err = call("quality", *arguments, capsys=capsys)
        assert code == 2
        clear_error(err)
        assert message in err


def test_a_workspace_that_misses_is_one_error(tmp_path, capsys):
    with RecordingWriter(tmp_path / "r", CAMERA, VoxelGrid((5, 5, 0), 0.01, (30, 30, 20))) as writer:
        rgb, depth, _ = table_scene()
        writer.add_frame(rgb, depth, 0.0, "static")
    code, _, err = call("run", tmp_path / "r", "n=2", "--out", tmp_path / "run", "--no-report", capsys=capsys)
    assert code == 2
    (told,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert "no depth reading is in the workspace" in told
    assert "hint: give a workspace" in err
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="no depth reading is in the workspace"):
        open_recording(tmp_path / "r").check()
