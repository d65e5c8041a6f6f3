"""Components by name, overrides and presets."""

from __future__ import annotations

import json
import pickle
import traceback
from dataclasses import dataclass
from typing import get_type_hints

import pytest

import mstfilter.registry
from mstfilter.completion import Completer
from mstfilter.errors import InputError, InputWarning
from mstfilter.fusion import Agreement, Evidence, FusionUpdate
from mstfilter.presets import REGISTRY, build_filter, load_config, preset
from mstfilter.resources import preset_names
from mstfilter.segmentation import ObjectRule
from mstfilter.smc import Resampler, Ssp

OVERRIDES = {
    "resampler=sistematic": "did you mean systematic",
    "transition.rule=mzt": "there is no rule",
    "update.n_veiws=3": "did you mean n_views",
    "update.n_views=many": "update.n_views is 'many'",
    "n=-2": "n is -2",
    "colour=blue": "no field 'colour'",
    "update": "path=value",
    "n.x=3": "has no fields",
    "update.reach=-1": "reach is -1",
    "resampler=./nowhere.py:Mine": "does not exist",
}


@pytest.mark.parametrize("override", OVERRIDES)
def test_wrong_overrides_are_one_clear_error(override):
    with pytest.raises(InputError) as caught:
        build_filter(load_config("mst", [override]), allow_files=True)
    assert OVERRIDES[override] in " ".join([caught.value.message, *caught.value.hints])


def test_overrides_change_what_they_name():
    filter = build_filter(
        load_config(
            "mst",
            ["n=7", "resampler=residual", "update.n_views=2", "transition.rule=paper", "update.free_space=none"],
        )
    )
    assert filter.n == 7
    assert type(filter.resampler).__name__ == "Residual"
    assert filter.update.n_views == 2
    assert type(filter.transition.rule).__name__ == "PaperRule"
    assert type(filter.update.free_space).__name__ == "NoFreeSpace"
    assert filter.update.completer == build_filter(load_config("mst")).update.completer
    authors = build_filter(load_config("authors", ["transition.rule.sift.descriptor_radius=200"])).transition.rule
    plain = build_filter(load_config("authors")).transition.rule
    assert authors.sift.descriptor_radius == 200
    assert authors.sift.mutual == plain.sift.mutual  # the rule's own default, not the part's
    with pytest.raises(InputError, match="there is no preset 'best'"):
        load_config("best")


@pytest.mark.parametrize("kind", REGISTRY.kinds)
def test_every_registered_component_can_be_built_and_described(kind):
    for name in REGISTRY.known(kind):
        component = REGISTRY.build(kind, name)
        described = json.loads(json.dumps(REGISTRY.describe(component)))
        assert described["component"] == name
        assert REGISTRY.build(kind, described) == component
        assert isinstance(component, REGISTRY.interface(kind))


@dataclass(frozen=True)
class Holder:
    one: Resampler
    subclass: FusionUpdate
    optional: Completer | None = None
    several: tuple[Evidence, ...] = ()
    plain: float = 1.0
    settings: ObjectRule = ObjectRule()  # noqa: RUF009 (frozen)


def test_the_kind_of_a_field_follows_from_its_annotation():
    hints = get_type_hints(Holder)
    kinds = {name: REGISTRY.kind_of(hint) for name, hint in hints.items()}
    assert kinds == {
        "one": "resampler",
        "subclass": "update",
        "optional": "completer",
        "several": "evidence",
        "plain": None,
        "settings": None,
    }
    fields = {"one": "ssp", "subclass": {"component": "fusion", "eta": 2}, "optional": None, "several": ["agreement"]}
    made = REGISTRY.make(Holder, fields)
    assert made == Holder(Ssp(), FusionUpdate(eta=2), None, (Agreement(),))


def test_what_is_wrong_with_a_file_of_the_user(tmp_path):
    class Plain:
        pass

    with pytest.raises(InputError, match=r"^Plain is no dataclass\nhint: write @dataclass"):
        REGISTRY.make(Plain, {})
    (tmp_path / "mine.py").write_text("from helper_beside import X")
    with pytest.raises(InputError, match="No module named 'helper_beside'") as caught:
        preset("mst", f"resampler={tmp_path / 'mine.py'}:Mine")
    assert "PYTHONPATH" in caught.value.hints[-1]


def test_hints_are_shown_in_python_too():
    error, warning = InputError("depth is empty", "record again"), InputWarning("depth is odd", "check it", "or not")
    assert "".join(traceback.format_exception(error)).endswith("depth is empty\nhint: record again\n")
    assert (str(error), str(warning)) == ("depth is empty", "depth is odd\nhint: check it\nhint: or not")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.hints, again.__notes__) == (str(error), error.hints, error.__notes__)


def test_entry_points_add_components(monkeypatch):
    @dataclass(frozen=True)
    class Entry:
        name: str
        value: str

    monkeypatch.setattr(
        mstfilter.registry,
        "entry_points",
        lambda group: [Entry("resampler.mine", "mstfilter.smc.resampling:Residual")],
    )
    mstfilter.registry._installed_components.cache_clear()
    try:
        assert type(REGISTRY.build("resampler", "mine")).__name__ == "Residual"
        assert "mine" not in REGISTRY.known("trigger")
    finally:
        mstfilter.registry._installed_components.cache_clear()


def test_presets_are_complete():
    assert {"authors", "mst", "paper", "samples_only", "single_frame", "tracking_only", "union"} <= set(
        preset_names()
    )
    for name in preset_names():
        assert not build_filter(load_config(name)).properly_weighted
