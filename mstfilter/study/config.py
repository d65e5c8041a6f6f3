"""What a study is made of: a TOML file, checked.

>>> study = load_study("experiments/main/study.toml")
>>> study.arms[0].preset, study.scenes[0].family

The file::

    description = "does a quicker resampler cost quality?"
    seeds = "0-2"                          # of the filter; the same for all arms

    [[scenes]]
    family = "demo"                        # simulated, made when it is missing
    seeds = "0-4"
    set = { width = 160, height = 120 }    # changes to the family

    [[scenes]]
    recordings = "recordings/table-*"      # folders, relative to this file
    group = "kitchen"

    [[arms]]
    preset = "mst, paper"                  # a comma makes a grid
    set = ["resampler=systematic,residual", "n=5"]

    [smoke]                                # replaces what stands above under --smoke
    seeds = [0]
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from mstfilter.errors import InputError

__all__ = ["ArmEntry", "SceneEntry", "StudyConfig", "load_study"]


def _seeds(value: Any) -> Any:
    """``"0-4, 7"``, one number or a list of numbers as a tuple of numbers."""
    if isinstance(value, int) and not isinstance(value, bool):
        return (value,)
    if not isinstance(value, str):
        return value
    found: list[int] = []
    for part in value.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdigit() or (dash and not last.strip().isdigit()):
            raise ValueError(f"{value!r} is not of the form 0-4, 7")
        found.extend(range(int(first), int(last if dash else first) + 1))
    return tuple(found)


def _texts(value: Any) -> Any:
    """One text as a list of one."""
    return (value,) if isinstance(value, str) else value


Seeds = Annotated[tuple[Annotated[int, Field(ge=0)], ...], BeforeValidator(_seeds)]
Texts = Annotated[tuple[str, ...], BeforeValidator(_texts)]


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneEntry(_Entry):
    """Scenes: a family with seeds, or recordings of any format that `mstfilter run` reads.

    Parameters
    ----------
    family : str
        A simulated family; `set` changes its fields.
    seeds : numbers
        One scene each.
    set : table
        Fields of the family.
    recordings : list of str
        Files or folders; a ``*`` stands for any text.
    format, options, pauses
        How they are read, as for `mstfilter run`; by default they say it themselves.
    group : str
        What the tables call the family. Default: the family's name, ``recordings`` for folders.
    """

    family: str = ""
    seeds: Seeds = ()
    set: dict[str, Any] = Field(default_factory=dict)
    recordings: Texts = ()
    format: str = ""
    options: Texts = ()
    pauses: str = ""
    group: str = ""

    @model_validator(mode="after")
    def _one_kind(self) -> SceneEntry:
        if bool(self.family) == bool(self.recordings):
            raise ValueError("needs either family and seeds, or recordings")
        if self.family and not self.seeds:
            raise ValueError(f"family {self.family!r} has no seeds")
        if self.recordings and (self.seeds or self.set):
            raise ValueError("recordings have neither seeds nor set")
        return self


class ArmEntry(_Entry):
    """What is compared: a preset and changes to it; commas make a grid.

    Parameters
    ----------
    preset : str or list of str
        Names, or paths of TOML files.
    set : list of str
        ``path=value`` each, as `mstfilter run` takes them; ``path=a,b`` is two arms.
    name : str
        What the tables call it. Default: the preset and what the grid varies.
    beside : bool
        Shown beside the others (a floor, a ceiling), and no part of the comparisons that are adjusted together.
    """

    preset: Texts = ("mst",)
    set: Texts = ()
    name: str = ""
    beside: bool = False


class StudyConfig(_Entry):
    """A study.

    Parameters
    ----------
    name : str
        Default: the name of the file.
    description : str
    arms, scenes : lists of tables
    seeds : numbers
        Of the filter. Nested in scenes: averaged before arms are compared.
    reference : str
        The arm that the others are compared with. Default: the first.
    keep : {"all", "tables"}
        What stays of a run: its whole folder, from which a report can be made, or its figures alone.
    tries : int
        How often a run is begun whose worker dies.
    timeout_s : float
        A run that takes longer counts as a worker's death. 0: no limit.
    cache_gb : float
        Bound of the work kept on disk for other arms and later runs; 0 keeps none.
    smoke : table
        Replaces fields of the study under ``--smoke``.
    """

    name: str
    description: str = ""
    arms: tuple[ArmEntry, ...] = ()
    scenes: tuple[SceneEntry, ...] = ()
    seeds: Seeds = (0, 1, 2)
    reference: str = ""
    keep: Annotated[str, Field(pattern="^(all|tables)$")] = "all"
    tries: Annotated[int, Field(ge=1)] = 3
    timeout_s: Annotated[float, Field(ge=0)] = 0.0
    cache_gb: Annotated[float, Field(ge=0)] = 4.0
    smoke: dict[str, Any] = Field(default_factory=dict)
    folder: Path = Path()  # where relative paths begin


def load_study(path: str | Path, *, smoke: bool = False) -> StudyConfig:
    """The study of a TOML file.

    Parameters
    ----------
    path : path
    smoke : bool
        Apply the table ``[smoke]``: the small form that shows that all works.

    Raises
    ------
    InputError
        The file is missing, is no TOML or says what a study does not know.
    """
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text())
    except OSError as error:
        raise InputError(f"study {path} cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"study {path} is not valid TOML: {error}") from error
    if smoke:
        small = data.get("smoke")
        if not small:
            raise InputError(f"study {path} has no table [smoke]", "it says what --smoke replaces, e.g. seeds = [0]")
        data = {**data, **small}
    return study_of({"name": path.stem, **data, "folder": path.parent}, str(path))


def study_of(data: dict[str, Any], where: str = "study") -> StudyConfig:
    """The study of plain values."""
    try:
        return StudyConfig(**data)
    except ValidationError as error:
        first = error.errors()[0]
        at = ".".join(str(part + 1 if isinstance(part, int) else part) for part in first["loc"])
        known = ", ".join(k for k in StudyConfig.model_fields if k != "folder")
        hints = (
            [f"fields of a study: {known}"] if first["type"] == "extra_forbidden" and len(first["loc"]) == 1 else []
        )
        message = first["msg"].removeprefix("Value error, ")
        raise InputError(f"{where}: {at}: {message[:1].lower()}{message[1:]}", *hints) from error
