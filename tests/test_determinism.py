"""What results depend on: not on threads or on settings of the user; a resumed run says if the machine is another."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.formats import open_recording
from mstfilter.runs import filter_recording
from mstfilter.runs.presets import load_config
from mstfilter.scene import Frame, render, scene_cache
from tests import hostile
from tests.app.report.runs import recording
from tests.scene.scenes import CAMERA, GRID, table_scene


def completed() -> bytes:
    """What the completion network makes of an object."""
    from mstfilter.mst.completion import NetworkCompleter

    rgb, depth, labels = table_scene()
    frame, mask = Frame(rgb, depth, CAMERA), render(labels, GRID, CAMERA).labels == 1
    scene_cache.clear()
    return NetworkCompleter().complete(np.random.default_rng(0), frame, [mask], GRID)[0].probability.tobytes()


def borders() -> bytes:
    """The output of the border network for an image."""
    from mstfilter.mst.segmentation.border_network import load_border_network

    rgb, depth, _ = table_scene()
    return load_border_network("border").look(Frame(rgb, depth, CAMERA)).border.tobytes()


@pytest.mark.parametrize("result", [completed, borders])
def test_networks_use_one_thread_and_restore_the_number(monkeypatch, result):
    import torch

    from mstfilter.mst.completion import NetworkCompleter
    from mstfilter.mst.segmentation.border_network import load_border_network

    network, name = (
        (NetworkCompleter().network, "forward")
        if result is completed
        else (
            load_border_network("border"),
            "net",
        )
    )
    used, forward = [], getattr(network, name)
    monkeypatch.setattr(network, name, lambda *given: used.append(torch.get_num_threads()) or forward(*given))
    before, found = torch.get_num_threads(), []
    try:
        for n in (1, 2, 5):
            torch.set_num_threads(n)
            found.append(result())
            assert torch.get_num_threads() == n
    finally:
        torch.set_num_threads(before)
    assert used == [1] * len(used) and len(used) >= 3
    assert found[0] == found[1] == found[2]


def test_a_run_states_its_machine_and_is_resumed_on_another(tmp_path, monkeypatch):
    film, config = recording(2), load_config("mst_rules", ["n=2"])
    run = filter_recording(film, config, tmp_path / "run")
    machine = run.description["machine"]
    assert set(machine) == {"cpu", "system", "blas", "threads"} and all(machine.values())
    monkeypatch.setattr("mstfilter.runs.run.machine", lambda: {**machine, "cpu": "another"})
    filter_recording(film, config, tmp_path / "run")
    assert run.description["machine"] == machine


def test_a_matplotlibrc_of_the_user_does_not_change_a_figure():
    import matplotlib

    from mstfilter.app.report.figures import quality_figure

    def drawn() -> str:
        return quality_figure(
            [0, 1], [[0.1, 0.5], [0.4, 0.6]], [[0.5, 0.5], [0.2, 0.8]], {}, {"one blob": [0.1, 0.2]}
        )

    expected = drawn()
    with matplotlib.rc_context(
        {"font.size": 33, "axes.facecolor": "red", "lines.linewidth": 9, "path.sketch": (1, 100, 2)}
    ):
        assert drawn() == expected


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("camera.json", {"width": 0}),
        ("camera.json", {"K": [[1, 2], [3]]}),
        ("camera.json", {"T_world_camera": [[1.0] * 4] * 4}),
        ("camera.json", {"workspace": {"min": [0, 0, 0], "max": [0, 1, 1], "voxel": 0.01}}),
        ("camera.json", {"workspace": {"min": [0, 0, 0], "max": [1e6, 1e6, 1e6], "voxel": 1e-9}}),
        ("manifest.json", {"times": "descending"}),
    ],
)
def test_errors_name_the_file(tmp_path, file, change):
    hostile.KINDS["recording"].write(tmp_path / "recording")
    path = tmp_path / "recording" / file
    data = json.loads(path.read_text())
    if "times" in change:
        data["frames"][1]["time_s"] = -5.0
    path.write_text(json.dumps({**data, **change}))
    with pytest.raises(InputError, match=rf"recording/{file}") as caught:
        open_recording(tmp_path / "recording")
    assert caught.value.message.count(file) == 1
