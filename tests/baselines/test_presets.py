"""Presets of the baselines: what they share with mst_rules, and presets that stand on another."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.presets import build_filter, describe_filter, load_config
from mstfilter.resources import preset_names

MST = describe_filter(build_filter(load_config("mst_rules", ["proposal.completer=network"])))
BASELINES = (
    "single_frame",
    "samples_only",
    "tracking_only",
    "union",
    "floor_one_blob",
    "floor_components",
    "floor_image",
)


def described(name, *overrides):
    return describe_filter(build_filter(load_config(name, overrides)))


def differences(a, b, where=""):
    """Paths at which two descriptions differ; a component of another name is one difference."""
    if not (isinstance(a, dict) and isinstance(b, dict)) or a.get("component") != b.get("component"):
        return [] if a == b else [where]
    return [d for k in {**a, **b} for d in differences(a.get(k), b.get(k), f"{where}.{k}".strip("."))]


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_share_budget_selection_and_completion(name):
    config = described(name)
    for field in ("n", "n_proposed", "resample", "resampler", "trigger", "initial", "size"):
        assert config[field] == MST[field], field
    proposal = config["proposal"].get("proposal", config["proposal"])
    assert proposal["completer"] == MST["proposal"]["completer"]
    assert proposal["objects"] == MST["proposal"]["objects"]
    assert proposal["threshold"] == MST["proposal"]["threshold"]


def test_baselines_differ_only_where_they_must():
    assert differences(described("mst_rules"), MST) == ["proposal.completer"]
    rules = {"n_proposed", "resampler", "proposal.completer", "update"}  # mst has the same front end and tracker
    assert set(differences(described("mst"), MST)) == rules
    assert differences(described("samples_only"), MST) == ["transition", "update"]
    assert sorted(differences(described("single_frame"), MST)) == ["proposal.sampler", "transition", "update"]
    assert differences(described("tracking_only"), MST) == ["proposal", "update"]
    assert described("tracking_only")["proposal"]["proposal"] == MST["proposal"]
    assert described("tracking_only")["update"]["free_space"] == MST["update"]["free_space"]
    assert differences(described("union"), MST) == ["update"]
    assert described("union")["update"]["fusion"] == MST["update"]


@pytest.mark.parametrize("whose", ["paper", "authors"])
def test_published_fusions_behind_the_front_end_of_mst(whose):
    """Update and resampler of the one, all else of the other."""
    both, theirs = described(f"{whose}_fusion"), described(whose)
    assert both["update"] == theirs["update"]
    assert both["resampler"] == theirs["resampler"]
    assert sorted(differences(both, MST)) == sorted(["proposal.weight_rule", "resampler", *_in_update(both)])


def _in_update(config):
    return [f"update.{d}" for d in differences(config["update"], MST["update"])]


@pytest.mark.parametrize(
    "overrides, where",
    [
        (["update.crossover.merge=always"], ["update.crossover.merge"]),
        (["update.crossover.merge=never"], ["update.crossover.merge"]),
        (["update.quality_exponent=0", "update.evidence=[]"], ["update.evidence", "update.quality_exponent"]),
        (["n=1", "update.eta=25"], ["n", "update.eta"]),
    ],
)
def test_arms_that_are_changes_to_a_preset_change_no_more(overrides, where):
    """As documented; what the preset does so already is no difference."""
    assert set(differences(described("mst_rules", *overrides), described("mst_rules"))) <= set(where)


def test_changes_to_a_preset_reach_the_baselines(tmp_path, monkeypatch):
    """A preset holds its differences alone: another base, and it is a baseline of that one."""
    from mstfilter import resources

    models = tmp_path / "models"
    models.mkdir()
    for name in preset_names():
        (models / f"{name}.toml").write_bytes(resources.find_preset(name).read_bytes())
    (models / "mst.toml").write_text((models / "mst.toml").read_text().replace("n = 5\n", "n = 9\n"))
    (models / "mst_rules.toml").write_text((models / "mst_rules.toml").read_text().replace("eta = 5", "eta = 4"))
    monkeypatch.setattr(resources, "models_folder", lambda: models)
    assert described("union")["n"] == 9
    assert described("union")["update"]["fusion"]["eta"] == 4


@pytest.mark.parametrize(
    "text, says",
    [
        ('base = "nothing"', "there is no preset 'nothing'"),
        ("base = 3", "base must be a name"),
        ('base = "mst"\noverrides = "n=3"', "lists of path=value"),
        ('base = "mst"\nwrap = ["update=union"]', "wrap 'update=union' is not slot.field=component"),
        ('base = "mst"\nwrap = ["updates.fusion=union"]', "of a slot that is set"),
        ('base = "mst"\noverrides = ["n"]', "not of the form path=value"),
        ('base = "mst"\nwrap = ["update.fusion=unoin"]', "there is no update 'unoin'"),
        (
            'base = "mst_rules"\nwrap = ["update.fusion=union", "update.fusion=union"]',
            "expected a FusionUpdate",
        ),
    ],
)
def test_what_is_wrong_with_a_preset_is_one_clear_error(tmp_path, text, says):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(InputError) as caught:
        described(str(tmp_path / "mine.toml"))
    assert says in caught.value.message


def test_a_preset_does_not_stand_on_itself(tmp_path):
    a, b = tmp_path / "a.toml", tmp_path / "b.toml"
    a.write_text(f'base = "{b}"')
    b.write_text(f'base = "{a}"')
    with pytest.raises(InputError, match="extends itself"):
        load_config(str(a))


def test_a_preset_on_another_changes_only_what_it_says(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text('description = "x"\nbase = "union"\nn = 7\noverrides = ["update.fusion.eta=2"]')
    assert sorted(differences(described(str(mine)), described("union"))) == ["n", "update.fusion.eta"]
    assert np.isclose(described(str(mine))["update"]["fusion"]["quality_exponent"], MST["update"]["quality_exponent"])
