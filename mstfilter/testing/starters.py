"""Starting files for components of your own.

>>> write_starter("resampler", Path("mine.py"))      # mine.py and test_mine.py
"""

from __future__ import annotations

import re
import sys
from importlib.resources import files
from pathlib import Path

from mstfilter.errors import InputError
from mstfilter.testing.properties import Example

__all__ = ["KINDS", "example_of", "write_starter"]

#: Kinds of which there is a starting file.
KINDS = (
    "resampler",
    "transition",
    "proposal",
    "update",
    "trigger",
    "size",
    "lookahead",
    "rejuvenation",
    "codec",
)

_TEST = '''"""{component} keeps what its interface promises."""

from {module} import {imports}

from mstfilter.testing import {contract}


class Test{component}({contract}):
    def make(self):
        return {component}()
'''
_EXTRAS = {
    name: f"""
    def {name}(self, rng, n):
        return {name}(rng, n)
"""
    for name in ("example", "exact")
}


def write_starter(kind: str, path: Path) -> tuple[Path, Path]:
    """Write a commented component that works, and its test.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    path : Path
        Python file to make; the test goes beside it, as ``test_NAME.py``.

    Returns
    -------
    (Path, Path)
        Component and test.

    Raises
    ------
    InputError
        No such kind, a name that cannot be imported, or a file that is there already.
    """
    if kind not in KINDS:
        raise InputError(f"there is no starting file for {kind!r}", f"there are: {', '.join(KINDS)}")
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise InputError(f"{path.name} cannot be imported as a Python module", "choose a name like mine.py")
    test = path.with_name(f"test_{path.name}")
    for file in (path, test):
        if file.exists():
            raise InputError(f"{file} is there already", "choose another name; nothing was written")
    text = files("mstfilter.testing").joinpath("templates", f"{kind}.py").read_text(encoding="utf-8")
    component = f"My{kind.capitalize()}"
    extras = {name: body for name, body in _EXTRAS.items() if f"\ndef {name}(" in text}
    imports = ", ".join([component, *extras])
    body = _TEST + "".join(extras.values())
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(re.sub(rf"\./{kind}\.py:", f"./{path.name}:", text), encoding="utf-8")
    contract = f"{kind.capitalize()}Contract"
    test.write_text(
        body.format(component=component, module=path.stem, imports=imports, contract=contract), encoding="utf-8"
    )
    return path, test


def example_of(cls: type) -> Example | None:
    """The function ``example(rng, n)`` in the module of a class; the scene for components of scenes; else None."""
    found = getattr(sys.modules.get(cls.__module__), "example", None)
    if callable(found):
        return found
    if cls.__module__.startswith("mstfilter.") and not cls.__module__.startswith("mstfilter.smc."):
        from mstfilter.testing.scenes import scene_example

        return scene_example
    return None
