"""Recordings kept on disk: made once, found by their recipe, never half there."""

from dataclasses import replace

import pytest

from mstfilter.errors import InputError
from mstfilter.formats import open_recording
from mstfilter.simulation import recorder
from mstfilter.simulation.families import scene_family
from mstfilter.simulation.recorder import cache_folder, cached_recording, recipe_key

TINY = {"width": 80, "height": 60, "n_actions": 1, "frames_per_clip": 3, "fps": 1.0, "supersample": False}


def test_made_once_and_found_again(tmp_path, monkeypatch):
    first = cached_recording("s1", 3, tmp_path, **TINY)
    assert first.parent == tmp_path and len(open_recording(first)) == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == [".gitignore", first.name]
    monkeypatch.setattr(recorder, "_simulate_into_cache", lambda *_: pytest.fail("made again"))
    assert cached_recording("s1", 3, tmp_path, **TINY) == first
    assert cached_recording(replace(scene_family("s1"), **TINY), 3, tmp_path) == first


def test_key_is_that_of_the_whole_recipe(monkeypatch):
    s1 = scene_family("s1")
    keys = {
        recipe_key(s1, 3),
        recipe_key(s1, 4),
        recipe_key(replace(s1, fps=6.0), 3),
        recipe_key(scene_family("s2"), 3),
    }
    assert len(keys) == 4 and recipe_key(s1, 3) in keys
    monkeypatch.setattr(recorder, "GENERATOR_VERSION", -1)
    assert recipe_key(s1, 3) not in keys


def test_a_quicker_process_wins_and_nothing_else_is_left(tmp_path, monkeypatch):
    simulate_recording = recorder.simulate_recording
    expected = cached_recording("s1", 3, tmp_path / "other", **TINY).name

    def slow(family, seed, path, progress=None):
        rival = tmp_path / "here" / expected
        rival.mkdir()
        (rival / "manifest.json").write_text("{}")
        return simulate_recording(family, seed, path, progress)

    monkeypatch.setattr(recorder, "simulate_recording", slow)
    assert cached_recording("s1", 3, tmp_path / "here", **TINY).name == expected
    assert sorted(p.name for p in (tmp_path / "here").iterdir()) == [".gitignore", expected]
    assert (tmp_path / "here" / expected / "manifest.json").read_text() == "{}"


def test_failure_leaves_nothing(tmp_path, monkeypatch):
    def broken(family, seed, path, progress=None):
        (path.parent / "half").write_text("")
        raise InputError("no")

    monkeypatch.setattr(recorder, "simulate_recording", broken)
    with pytest.raises(InputError):
        cached_recording("s1", 3, tmp_path, **TINY)
    assert [p.name for p in tmp_path.iterdir()] == [".gitignore"]


def test_default_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "a"))
    assert cache_folder() == tmp_path / "a"
    monkeypatch.delenv("MSTFILTER_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "b"))
    assert cache_folder() == tmp_path / "b" / "mstfilter"


def test_mistakes_are_one_clear_error(tmp_path):
    with pytest.raises(InputError, match="no field 'colour'"):
        cached_recording("s1", 3, tmp_path, colour=3)
    with pytest.raises(InputError, match="seed"):
        cached_recording("s1", -1, tmp_path)
    with pytest.raises(InputError, match="scene family"):
        cached_recording("s9", 3, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot keep recordings"):
        cached_recording("s1", 3, tmp_path / "file", **TINY)
