"""Errors keep their class, message, hints and attributes wherever a place is added, and hints can be followed."""

from __future__ import annotations

import copy
import pickle
import re
import tomllib
from dataclasses import dataclass

import pytest

from mstfilter.base.errors import InputError, LostRunError, MissingLibraryError, exhausted, missing_library, naming
from mstfilter.base.lazy import import_open3d
from mstfilter.base.registry import Registry
from mstfilter.smc import ParticleFilter, Population, Proposal, Transition, run_many
from tests.conftest import REPOSITORY


class NoGripper(InputError):
    """A user's error with a constructor of its own."""

    def __init__(self, robot: str, joint: int) -> None:
        super().__init__(f"robot {robot} has no gripper at joint {joint}", "attach one")
        self.robot = robot


class Collision(InputError):
    """A user's error whose constructor does not call that of InputError."""

    def __init__(self, place: str) -> None:
        self.place = place


ERRORS = [
    NoGripper("R2", 3),
    Collision("the table collides"),
    LostRunError("no particle is left", "take more"),
    MissingLibraryError("needs a library", "pip install it"),
    InputError("plain"),
]


def is_same_but_for(error, other, place):
    """Whether `error` is `other` with a place before its message."""
    assert type(error) is type(other)
    assert error.message == f"{place}{other.message}" == str(error)
    assert error.hints == other.hints and getattr(error, "__notes__", []) == getattr(other, "__notes__", [])
    return all(getattr(error, name) == value for name, value in vars(other).items() if name != "message")


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_a_place_is_added_to_an_error_of_any_class(error):
    assert error.message
    with pytest.raises(InputError) as found, naming("arm 'a'"):
        raise error
    assert is_same_but_for(found.value, error, "arm 'a': ") and found.value.__cause__ is error
    with pytest.raises(InputError) as again, naming("arm 'a'"):
        raise found.value
    assert again.value is found.value  # which contains the place


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_errors_are_copied_and_pickled(error):
    for made in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert is_same_but_for(made, error, "")


@dataclass(frozen=True)
class Points(Proposal):
    def sample(self, rng, observation, n):
        return Population(rng.random(n))


@dataclass(frozen=True)
class Fails(Transition):
    number: int = 0

    def predict(self, rng, population, observation):
        raise ERRORS[self.number]


@pytest.mark.parametrize("number", range(len(ERRORS)))
def test_a_step_names_itself_in_an_error_of_a_component(number):
    with pytest.raises(InputError) as found:
        ParticleFilter(initial=Points(), transition=Fails(number), n=3).run([0.0, 0.0])
    assert is_same_but_for(found.value, ERRORS[number], "step 1, transition: ")


def test_an_error_of_a_worker_keeps_its_class():
    filter = ParticleFilter(initial=Points(), transition=Fails(0), n=3)
    with pytest.raises(NoGripper, match="seed 0: step 1, transition: robot R2 has no gripper at joint 3") as found:
        run_many(filter, [0.0, 0.0], [0], workers=2)
    assert found.value.robot == "R2" and found.value.hints == ("attach one",)


@dataclass(frozen=True)
class Unmakeable:
    number: int = 0

    def __post_init__(self):
        raise ERRORS[self.number]


@pytest.mark.parametrize("number", range(len(ERRORS)))
def test_a_component_that_cannot_be_made_says_why(number):
    with pytest.raises(InputError) as found:
        Registry().make(Unmakeable, {"number": number}, "update.completer")
    assert is_same_but_for(found.value, ERRORS[number], "update.completer: ")


# --- hints --------------------------------------------------------------------------------------------------------
def test_hints_name_extras_that_exist():
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    folders = ("mstfilter", "models", "docs", "experiments")
    files = [path for folder in folders for path in (REPOSITORY / folder).rglob("*")]
    files = [path for path in files if path.suffix in (".py", ".pyi", ".md", ".toml") and "_build" not in path.parts]
    named = {
        (path.relative_to(REPOSITORY), extra.strip())
        for path in [*files, REPOSITORY / "README.md", REPOSITORY / "pyproject.toml"]
        for group in re.findall(r"mstfilter\[([\w, -]+)\]", path.read_text(encoding="utf-8"))
        for extra in group.split(",")
    }
    assert len(named) >= 5  # the pattern finds what there is
    assert {(path, extra) for path, extra in named if extra not in extras} == set()


# --- libraries that cannot be imported ----------------------------------------------------------------------------
def caused_by(error, cause):
    error.__cause__ = cause
    return error


SHORT = [
    ImportError("libtorch_cpu.so: failed to map segment from shared object"),
    ImportError("libtorch_cpu.so: cannot open shared object file: Cannot allocate memory"),
    caused_by(ImportError("numpy could not be imported", name="numpy"), MemoryError()),
]


@pytest.mark.parametrize("error", SHORT, ids=str)
def test_a_library_that_cannot_be_loaded_for_lack_of_memory_is_not_missing(error):
    assert exhausted(error).message == "out of memory"
    found = missing_library(error, "this tracker", library="torch")
    assert not isinstance(found, MissingLibraryError)
    assert found.message.startswith("out of memory: this tracker cannot load torch: ")
    assert not any("pip install" in hint for hint in found.hints)


def test_a_library_that_is_missing_or_broken():
    missing = missing_library(ModuleNotFoundError("No module named 'rosbags'", name="rosbags"), "reading bags")
    assert isinstance(missing, MissingLibraryError) and missing.hints == ("pip install 'mstfilter[bags]'",)
    broken = missing_library(ImportError("cannot import name 'x' from 'torch'", name="torch"), "this tracker")
    assert isinstance(broken, MissingLibraryError)
    assert broken.hints == ("if torch is damaged or incomplete, install it again: pip install torch",)
    tls = ImportError("libgomp.so.1: cannot allocate memory in static TLS block")
    assert exhausted(tls) is None and isinstance(missing_library(tls, "open3d"), MissingLibraryError)


@pytest.mark.parametrize("error", [OSError("libOpen3D.so: failed to map segment from shared object"), SHORT[0]])
def test_open3d_without_memory(error, monkeypatch):
    def fail(name):
        raise error

    monkeypatch.setattr("mstfilter.base.lazy.import_module", fail)
    with pytest.raises(InputError, match="out of memory: open3d cannot be loaded: lib") as found:
        import_open3d()
    assert not isinstance(found.value, MissingLibraryError)
