"""Presets of the baselines: what they share with mst, and presets that extend another."""

from __future__ import annotations

import pytest

from mstfilter.base.errors import InputError
from mstfilter.base.resources import preset_names
from mstfilter.runs.presets import build_filter, describe_filter, load_config


def described(name, *overrides):
    return describe_filter(build_filter(load_config(name, overrides)))


MST = described("mst")


def differences(a, b, where=""):
    """Paths at which two descriptions differ; a component of another name is one difference."""
    if not (isinstance(a, dict) and isinstance(b, dict)) or a.get("component") != b.get("component"):
        return [] if a == b else [where]
    return [d for k in {**a, **b} for d in differences(a.get(k), b.get(k), f"{where}.{k}".strip("."))]


#: Where a preset on `base` differs from `mst`, beside the update and the completer of the proposal: `mst` completes
#: in its update, the others complete samples by the same network (`mst_rules`, without networks, by extrusion).
DIFFERENCES = {
    "mst_rules": ["proposal.tree"],
    "union": [],
    "samples_only": ["transition"],
    "single_frame": ["proposal.sampler", "transition"],
    "tracking_only": ["proposal"],
    "object_fusion": ["n", "n_proposed", "proposal.sampler"],
    "paper_fusion": ["proposal.weight_rule", "resampler"],
    "authors_fusion": ["proposal.weight_rule", "resampler"],
    "floor_one_blob": ["proposal", "transition"],
    "floor_components": ["proposal", "transition"],
    "floor_image": ["proposal", "transition"],
}


def test_all_presets_but_the_published_ones_stand_on_one_base():
    assert {*DIFFERENCES, "mst", "paper", "authors"} == set(preset_names())


@pytest.mark.parametrize("name", DIFFERENCES)
def test_a_baseline_differs_from_mst_only_where_it_must(name):
    config = described(name)
    assert config["n_proposed"] == (1 if name == "object_fusion" else 30)
    proposal = config["proposal"].get("proposal", config["proposal"])
    completer = MST["update"]["completer"] if name != "mst_rules" else described("paper")["proposal"]["completer"]
    assert proposal["completer"] == completer
    assert all(proposal[field] == MST["proposal"][field] for field in ("objects", "threshold"))
    allowed = {*DIFFERENCES[name], "proposal.completer", "update"}
    assert {*DIFFERENCES[name], "update"} <= set(differences(config, MST)) <= allowed


def test_tracking_wraps_the_samples_of_the_base():
    assert described("tracking_only")["proposal"] == {
        "component": "first_pause",
        "proposal": described("samples_only")["proposal"],
    }


@pytest.mark.parametrize("whose", ["paper", "authors"])
def test_published_fusions_behind_the_front_end_of_mst(whose):
    """Update, resampler and weights of samples of the one, all else of the other."""
    both, theirs = described(f"{whose}_fusion"), described(whose)
    for slot in ("update", "resampler"):
        assert both[slot] == theirs[slot]
    assert both["proposal"]["weight_rule"] == theirs["proposal"]["weight_rule"]


@pytest.mark.parametrize(
    "text, says",
    [
        ('base = "nothing"', "there is no preset 'nothing'"),
        ("base = 3", "base must be a name"),
        ('base = "mst"\nwrap = ["update=union"]', "wrap a table"),
        ('base = "mst"\nwrap = { updates = "union" }', "wrap.updates names no slot that its base sets"),
        ('base = "mst"\nwrap = { proposal = "first_puase" }', "there is no proposal 'first_puase'"),
        ('base = "mst"\nn.x = 3', "n is 5, which has no fields"),
        ('base = "mine.toml"', "extends itself"),
    ],
)
def test_what_is_wrong_with_a_preset_is_one_clear_error(tmp_path, monkeypatch, text, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(InputError, match=says):
        described("mine.toml")


def test_the_base_is_no_preset():
    with pytest.raises(InputError, match="there is no preset 'base'"):
        load_config("base")


def test_a_preset_on_another_changes_only_what_it_says(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text('description = "x"\nbase = "union"\nn = 7\n[update]\nquality_exponent = 2')
    assert sorted(differences(described(str(mine)), described("union"))) == ["n", "update.quality_exponent"]
    again = tmp_path / "again.toml"
    again.write_text(f'base = "{mine}"\nupdate = "partition"')  # naming a component resets its fields
    assert differences(described(str(again))["update"], described("mst", "update=partition")["update"]) == []
