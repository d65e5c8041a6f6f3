"""Components by name, overrides and presets."""

from __future__ import annotations

import copy
import json
import os
import pickle
import subprocess
import sys
import traceback
from dataclasses import dataclass
from typing import get_type_hints

import pytest

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.base.resources import preset_names
from mstfilter.base.user_files import load_class
from mstfilter.lab.oracles import TrueQuality
from mstfilter.mst.completion import Completer
from mstfilter.mst.crossover import CrossoverUpdate
from mstfilter.mst.segmentation import ObjectRule
from mstfilter.runs.presets import REGISTRY, build_filter, load_config, preset
from mstfilter.scene import Evidence
from mstfilter.smc import Resampler, Ssp

OVERRIDES = {
    "resampler=sistematic": "did you mean systematic",
    "transition.rule=mzt": "there is no rule",
    "update.n_veiws=3": "did you mean n_views",
    "update.n_views=many": "update.n_views is 'many'",
    "n=-2": "n is -2",
    "n=true": "n is True, expected a number",
    "update.quality_exponent=false": "quality_exponent is False, expected a number",
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
    subclass: CrossoverUpdate
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
    fields = {
        "one": "ssp",
        "subclass": {"component": "crossover", "eta": 2},
        "optional": None,
        "several": ["true_quality"],
    }
    made = REGISTRY.make(Holder, fields)
    assert made == Holder(Ssp(), CrossoverUpdate(eta=2), None, (TrueQuality(),))


def test_what_is_wrong_with_a_file_of_the_user(tmp_path):
    class Plain:
        pass

    with pytest.raises(InputError, match=r"^Plain is no dataclass\nhint: write @dataclass"):
        REGISTRY.make(Plain, {})
    (tmp_path / "mine.py").write_text("from helper_beside import X")
    with pytest.raises(InputError, match="No module named 'helper_beside'") as caught:
        preset("mst", f"resampler={tmp_path / 'mine.py'}:Mine")
    assert "pip install helper_beside" in caught.value.hints[-1]
    (tmp_path / "helper_beside.py").write_text("X = 1")
    with pytest.raises(InputError, match="No module named 'helper_beside'") as caught:
        preset("mst", f"resampler={tmp_path / 'mine.py'}:Mine")
    assert caught.value.hints[-1].endswith(f"PYTHONPATH={tmp_path}")


_RESAMPLER = """
from dataclasses import dataclass
from mstfilter.smc import Multinomial, Resampler, Systematic, Transition, WeightResampler

VALUE = {value!r}


@dataclass(frozen=True)
class Part:
    value: str = VALUE


@dataclass(frozen=True)
class Mine(Systematic):
    part: Part = Part()

    def value(self):
        return Part().value + VALUE
"""


def mine(folder, value="a", name="mine.py"):
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text(_RESAMPLER.format(value=value))
    return path


def load(path, name="Mine"):
    return REGISTRY.build("resampler", f"{path}:{name}", allow_files=True)


def test_files_of_one_name_are_different_modules(tmp_path):
    a, b = load(mine(tmp_path / "a", "a")), load(mine(tmp_path / "b", "b"))
    assert (a.value(), b.value()) == ("aa", "bb")
    assert a != b
    assert sys.modules[type(a).__module__] is not sys.modules[type(b).__module__]


def test_a_file_is_executed_once_for_all_spellings_of_its_path(tmp_path, monkeypatch):
    path = mine(tmp_path / "a")
    path.write_text(path.read_text() + f"\nwith open({str(tmp_path / 'log')!r}, 'a') as log:\n    log.write('x')\n")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link.py").symlink_to(path)
    (tmp_path / "folder").symlink_to(tmp_path / "a")
    spellings = [path, "a/mine.py", "./a/mine.py", "a/../a/mine.py", "link.py", "folder/mine.py"]
    made = [load(spelling) for spelling in spellings]
    assert all(one == made[0] and type(one) is type(made[0]) for one in made)
    assert (tmp_path / "log").read_text() == "x"
    assert {REGISTRY.describe(one)["component"] for one in made} == {"a/mine.py:Mine"}
    assert REGISTRY.build("resampler", REGISTRY.describe(made[0]), allow_files=True) == made[0]


def test_an_edited_file_is_loaded_again(tmp_path):
    path = mine(tmp_path / "a", "a")
    before = load(path)
    mine(tmp_path / "a", "b")  # of the same size, and in the same second
    after = load(path)
    assert (before.value(), after.value()) == ("aa", "bb")
    assert before != after
    assert pickle.loads(pickle.dumps(before)) == before
    mine(tmp_path / "a", "a")
    assert load(path) == before


def test_the_code_of_a_class_includes_the_files_beside_it_that_it_imports(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    path, helper, below = (tmp_path / name for name in ("mine.py", "helper_beside.py", "deeper_beside.py"))
    below.write_text("THREE = 3\n")
    helper.write_text("from deeper_beside import THREE\nTWO = THREE - 1\n")
    path.write_text("import helper_beside\nimport os.path\n\n\nclass Mine:\n    two = helper_beside.TWO\n")

    def code():
        path.write_text(path.read_text() + "#\n")  # another content, so that it is loaded again
        return load_class(str(path), "Mine").__mst_code__

    first = code()
    (tmp_path / "other_beside.py").write_text("1\n")  # not imported
    below.write_text("THREE = 3  # a comment\n")
    assert code() == first
    below.write_text("THREE = 4\n")
    assert code() != first


def test_instances_of_a_file_are_pickled_and_copied(tmp_path):
    one = load(mine(tmp_path / "a"))
    for again in (pickle.loads(pickle.dumps(one)), copy.copy(one), copy.deepcopy(one)):
        assert again == one and type(again) is type(one)
    script = "import pickle, sys; print(pickle.load(sys.stdin.buffer).value())"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    call = [sys.executable, "-c", script]
    done = subprocess.run(call, input=pickle.dumps(one), capture_output=True, env=environment, check=True)
    assert done.stdout == b"aa\n"
    mine(tmp_path / "a", "b")
    done = subprocess.run(call, input=pickle.dumps(one), capture_output=True, env=environment, check=False)
    assert b"has changed since an instance of Mine was pickled" in done.stderr


def test_a_subclass_of_a_class_of_a_file_is_pickled_as_itself(tmp_path):
    global Sub
    Sub = dataclass(frozen=True)(type("Sub", (type(load(mine(tmp_path / "a"))),), {"__module__": __name__}))
    assert type(pickle.loads(pickle.dumps(Sub()))) is Sub


def test_a_file_that_fails_leaves_nothing_behind(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("VALUE = 1\n1 / 0\n")
    known = set(sys.modules)
    for _ in range(2):
        with pytest.raises(InputError, match="ZeroDivisionError") as caught:
            load(path)
    assert "mine.py, line 2: 1 / 0" in caught.value.hints[0]
    path.write_text("import sys\nsys.exit(3)\n")
    with pytest.raises(InputError, match="SystemExit: 3"):
        load(path)
    assert not [name for name in set(sys.modules) - known if "mine" in name]


ABSTRACT = {
    "class Mine(WeightResampler):\n    pass": (
        "Mine has no method select, which WeightResampler asks for",
        "define select as WeightResampler.select describes it",
    ),
    "class Mine(Resampler):\n    def resampel(self, rng, population, n):\n        ...": (
        "Mine has no method resample, which Resampler asks for",
        "rename resampel to resample",
    ),
}


@pytest.mark.parametrize("source", ABSTRACT)
def test_a_class_that_cannot_be_made(source, tmp_path):
    path = mine(tmp_path / "a")
    path.write_text(path.read_text().split("@dataclass")[0] + "@dataclass(frozen=True)\n" + source)
    cls = REGISTRY.find_class("", f"{path}:Mine", allow_files=True)
    message, hint = ABSTRACT[source]
    for where in ("", "resampler"):
        with pytest.raises(InputError) as caught:
            REGISTRY.make(cls, {}, where)
        assert caught.value.message == (f"{where}: " if where else "") + message
        assert caught.value.hints == (hint,)


def test_hints_are_shown_in_python_too():
    error, warning = InputError("depth is empty", "record again"), InputWarning("depth is odd", "check it", "or not")
    assert "".join(traceback.format_exception(error)).endswith("depth is empty\nhint: record again\n")
    assert (str(error), str(warning)) == ("depth is empty", "depth is odd\nhint: check it\nhint: or not")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.hints, again.__notes__) == (str(error), error.hints, error.__notes__)


def test_no_preset_is_properly_weighted():
    for name in preset_names():
        assert not build_filter(load_config(name)).properly_weighted


def test_dates_are_texts():
    assert (
        load_config("mst", ["proposal=mask_folder", "proposal.folder=2024-01-05"])["proposal"]["folder"]
        == "2024-01-05"
    )
