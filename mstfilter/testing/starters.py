"""Starting files for components of a user: the examples of the documentation, under another name.

>>> write_starter("resampler", Path("mine.py"))      # mine.py and test_mine.py
"""

from __future__ import annotations

import re
from pathlib import Path

from mstfilter.errors import InputError
from mstfilter.resources import examples_folder


def starter_kinds() -> list[str]:
    """Kinds of component that have a starting file."""
    return sorted(path.stem for path in examples_folder().glob("*.py") if not path.stem.startswith("test_"))


def write_starter(kind: str, path: Path) -> tuple[Path, Path]:
    """Write a commented component of one of `starter_kinds` that works, and its test beside it as ``test_NAME.py``.

    Returns both paths. Raises InputError if there is no such kind, the name cannot be imported, or a file exists
    already.
    """
    if kind not in starter_kinds():
        raise InputError(f"there is no starting file for {kind!r}", f"there are: {', '.join(starter_kinds())}")
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise InputError(f"{path.name} cannot be imported as a Python module", "choose a name like mine.py")
    files = {path: f"{kind}.py", path.with_name(f"test_{path.name}"): f"test_{kind}.py"}
    for file in files:
        if file.exists():
            raise InputError(f"{file} exists already", "choose another name; nothing was written")
    path.parent.mkdir(parents=True, exist_ok=True)
    for file, source in files.items():
        text = (examples_folder() / source).read_text(encoding="utf-8")
        text = re.sub(rf"\./{kind}\.py:", f"./{path.name}:", text)
        file.write_text(
            re.sub(rf"^from {kind} import", f"from {path.stem} import", text, flags=re.M), encoding="utf-8"
        )
    component, test = files
    return component, test
