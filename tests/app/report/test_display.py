"""What a person sees of an object: its text, its HTML, plots, the page that can be rotated, tables and progress."""

from __future__ import annotations

import functools

import numpy as np
import pytest

import mstfilter
from mstfilter.app.report.answer import table_cells
from mstfilter.app.report.display import Drawing
from mstfilter.base.errors import InputWarning
from mstfilter.base.resources import preset_names
from mstfilter.mst.testing import scene_example
from mstfilter.runs import filter_recording
from mstfilter.runs.presets import load_config
from mstfilter.scene import Crop, Hypothesis, ObjectRecord, Recording, VoxelGrid
from mstfilter.smc import (
    Candidates,
    Infos,
    Population,
    Ssp,
    Tempered,
    Transition,
    bootstrap,
    linear_gaussian,
    run_many,
)
from tests.app.report.pages import Page, check_html
from tests.mst.belief.test_objects import belief_of, scene, two_readings
from tests.scene.scenes import CAMERA, table_scene

MODEL = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
NUMBERS = bootstrap(MODEL, n=50)
STATE, INFOS = NUMBERS.run([[0.3], [0.1]], seed=0)


@functools.cache
def scenes():
    """Five hypotheses of a scene, and a clip."""
    return scene_example(np.random.default_rng(0), 5)


@functools.cache
def still():
    """A recording of 30 equal images, of which the package warns."""
    rgb, depth, _ = table_scene()
    with pytest.warns(InputWarning, match="identical"):
        return Recording.from_arrays(
            np.repeat(rgb[None], 30, 0),
            np.repeat(depth[None], 30, 0),
            CAMERA.K,
            pauses="every",
            name="a long name " * 10,
        )


def state_of_scenes():
    floor = mstfilter.preset("floor_one_blob")
    return floor.step(floor.start(1), scenes()[1])[0]


#: What is shown, made when it is needed.
OBJECTS = {
    "recording": still,
    "clip": lambda: scenes()[1],
    "clip of one frame": lambda: still().clips()[0],
    "frame": lambda: scenes()[1].after,
    "camera": lambda: CAMERA,
    "hypothesis": lambda: scenes()[0].particles[0],
    "hypothesis of 1000 objects": lambda: Hypothesis.from_labels(
        np.arange(1, 1001).reshape(10, 10, 10), VoxelGrid((0, 0, 0), 0.01, (10, 10, 10))
    ),
    "empty hypothesis": lambda: Hypothesis.from_labels(
        np.zeros((2, 2, 2), int), VoxelGrid((0, 0, 0), 0.01, (2, 2, 2))
    ),
    "record": lambda: ObjectRecord(3, 65539, 1, Crop.of(np.ones((4, 4, 4), bool))),
    "population of hypotheses": lambda: scenes()[0],
    "population of numbers": lambda: STATE.population,
    "population of a mapping": lambda: Population({f"coordinate {k}": np.zeros((90, 3)) for k in range(20)}),
    "candidates": lambda: Population(Candidates(lambda k: k, 1000)),
    "state": lambda: STATE,
    "first state": lambda: NUMBERS.start(0),
    "state of scenes": state_of_scenes,
    "info": lambda: INFOS[1],
    "infos": lambda: INFOS,
    "no infos": Infos,
    "belief": lambda: mstfilter.Belief(scenes()[0]),
    "filter": lambda: NUMBERS,
    "preset": lambda: mstfilter.preset("mst"),
}


@pytest.mark.parametrize("name", OBJECTS)
def test_text_and_html_are_short_and_complete(name):
    shown = OBJECTS[name]()
    text = repr(shown)
    assert 0 < len(text) <= 300
    assert len(text.splitlines()) <= 5
    assert " at 0x" not in text
    assert "array(" not in text
    if hasattr(shown, "_repr_html_"):
        made = shown._repr_html_()
        check_html(made)
        assert text.splitlines()[0].replace("'", "&#x27;") in made
        assert len(made) < 1_000_000


def test_a_table_of_objects_is_a_table_with_colours():
    table = two_readings().objects()
    made = table._repr_html_()
    check_html(made)
    page = Page(made)
    assert made.count("<tr>") == 1 + len(table) == made.count('class="chip"') + 1
    assert repr(table).splitlines()[0] in page.text
    for row in table_cells(table):
        for text in row.values():
            assert text in (made if text.startswith("#") else page.text)
    hidden = [one for one in table if not one.visible]
    assert page.text.count("hidden since pause 1") == len(hidden) == 1
    assert len({row["colour"] for row in table_cells(table)}) == len(table)
    empty = belief_of((1.0, scene())).objects()._repr_html_()
    check_html(empty)
    assert "0 objects" in empty and "<table" not in empty


def test_the_texts_of_components_name_changed_fields():
    for name in preset_names():
        made = mstfilter.preset(name)
        for slot in ("transition", "proposal", "update", "resampler"):
            assert len(repr(getattr(made, slot))) <= 300
    assert repr(mstfilter.preset("mst").transition) == "TrackingTransition()"
    assert repr(Tempered()) == "Tempered()"

    class Plain(Transition):
        def predict(self, rng, population, observation):
            return population

    assert repr(Plain()) == "Plain()"
    assert repr(Tempered(power=0.25, scheme=Ssp())) == "Tempered(scheme=Ssp(), power=0.25)"


def test_plots():
    for figure, axes in (
        (still().plot(), 2 * 6 + 2),  # colour and depth of six pauses, time line, colour bar
        (scenes()[0].plot(), None),
        (STATE.population.plot(), 1),
        (Population({"a": np.arange(9.0), "b": np.zeros((9, 2))}).plot(), 3),
    ):
        assert isinstance(figure, Drawing)
        assert axes is None or len(figure.axes) == axes
        assert figure._repr_png_().startswith(b"\x89PNG")
    bars = STATE.population.plot().axes[0].patches
    assert sum(bar.get_height() for bar in bars) == pytest.approx(1)


def test_progress_is_shown_if_asked(tmp_path, capsys):
    NUMBERS.run([[0.1]] * 4, seed=0)
    assert capsys.readouterr() == ("", "")
    NUMBERS.run([[0.1]] * 4, seed=0, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "4/4" in err
    calls = []
    NUMBERS.run(iter([[0.1]] * 2), seed=0, progress=lambda *call: calls.append(call))
    assert calls == [(0, None), (1, None), (2, None)]
    run_many({"a": NUMBERS}, [[0.1]], range(3), progress=True)
    assert "3/3" in capsys.readouterr().err
    rgb, depth, _ = table_scene()
    arrays = Recording.from_arrays(rgb, depth, CAMERA.K)
    filter_recording(arrays, load_config("floor_one_blob"), tmp_path / "run", progress=True)
    assert "1/1" in capsys.readouterr().err
