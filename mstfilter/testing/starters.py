"""Starting files for components of a user: the examples of the documentation, with other names.

>>> write_starter("resampler", Path("mine.py"))                # mine.py and test_mine.py
>>> write_starter("transition", Path("mine.py"), "numbers")    # particles are numbers instead of hypotheses
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import NamedTuple

from mstfilter import smc
from mstfilter.errors import InputError, check_choice, suggestion
from mstfilter.lazy import exported
from mstfilter.resources import examples_folder

_TEST = '''"""{name} keeps the contract of its interface."""

from {module} import {names}

from {package} import {contract}


class Test{name}({contract}):
    def make(self):
        return {name}()
'''
_METHOD = """
    def {function}(self, rng, n):
        return {function}(rng, n)
"""


class Starter(NamedTuple):
    """A starting file that was written."""

    component: Path
    test: Path | None  #: None if the interface has no contract
    commands: list[str]  #: commands that run the component, as its docstring lists them


_TARGETS = ("scenes", "numbers")
_BOTH = ("resampler", "trigger", "size")  # use the weights only, so one file is for both


def starter_kinds(target: str = "") -> list[str]:
    """Kinds of component that have a starting file: for "scenes", for "numbers", or for either."""
    folders = map(_folder, [target] if target else _TARGETS)
    return sorted({path.stem for folder in folders for path in folder.glob("*.py")} | set(_BOTH))


def _folder(target: str) -> Path:
    return examples_folder() / "scenes" if target == "scenes" else examples_folder()


def write_starter(kind: str, path: Path, target: str = "") -> Starter:
    """Write a commented component of one of `starter_kinds` that works, and its test ``test_NAME.py``.

    `target` states the kind of particles: "scenes" (hypotheses) or "numbers". The default is scenes, if there is a
    file for them. Raises InputError if the kind has no file, the name cannot be imported, or a file already exists.
    """
    check_choice("the target", target or "scenes", _TARGETS)
    kinds = starter_kinds(target)
    if kind not in kinds:
        fact = f"there is no starting file of {kind!r}" + f" for {target}" * bool(target)
        raise InputError(fact, *suggestion(kind, kinds), f"there are: {', '.join(kinds)}")
    target = target or ("scenes" if kind in starter_kinds("scenes") else "numbers")
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise InputError(f"{path.name} cannot be imported as a Python module", "choose a name like mine.py")
    source = _folder("numbers" if kind in _BOTH else target) / f"{kind}.py"
    text = re.sub(rf"(\./|python ){kind}\.py\b", rf"\g<1>{path.name}", source.read_text(encoding="utf-8"))
    files = {path: text}
    test = path.with_name(f"test_{path.name}")
    tested = _test_of(text, path.stem)
    if tested is not None:
        files[test] = tested
    for file in files:
        if file.exists():
            raise InputError(f"{file} exists already", "choose another name; nothing was written")
    path.parent.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        file.write_text(content, encoding="utf-8")
    lines = (ast.get_docstring(ast.parse(text)) or "").splitlines()
    place = path.as_posix() if path.is_absolute() else f"./{path.as_posix()}"
    commands = [line for line in lines if re.match("mstfilter |python ", line)]
    if path.parent != Path("."):
        commands = [re.sub(rf"(\./)?\b{re.escape(path.name)}\b", place, command) for command in commands]
    return Starter(path, test if tested is not None else None, commands)


def _test_of(text: str, module: str) -> str | None:
    """The test of the component in a file, by the contract of its base class; None if it has none."""
    found = re.search(r"^class (My\w+)\((\w+)\)", text, flags=re.M)
    assert found is not None
    name, contract = found[1], f"{found[2]}Contract"
    if "mstfilter check" not in text:
        return None
    functions = [f for f in ("exact", "example") if re.search(rf"^(def {f}\(|{f} = )", text, flags=re.M)]
    contracts = exported(Path(__file__).with_name("__init__.py"))
    contracts |= exported(Path(smc.__file__).with_name("testing") / "__init__.py")
    contract = contract if contract in contracts else "StageContract"
    package = contracts[contract].rpartition(".")[0]
    names = ", ".join([name, *functions])
    test = _TEST.format(name=name, module=module, names=names, package=package, contract=contract)
    return test + "".join(_METHOD.format(function=f) for f in reversed(functions))
