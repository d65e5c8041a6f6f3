"""Sentences of the documentation and the docstrings, to be counted or read.

    python tests/sentences.py                   # 60 sentences, drawn at random, for a reader
    python tests/sentences.py --seed 7 -n 20
    python tests/sentences.py --context         # each with its signature and its paragraph
    python tests/sentences.py --longer 30       # all sentences of more than 30 words, with their files

Code, tables, formulas, headings and numpydoc's lines of names and types are left out.
"""

from __future__ import annotations

import argparse
import ast
import random
import re
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
PAGES = ("README.md", "docs/*.md", "models/*/README.md", "experiments/*/README.md")
_BLOCKS = (
    r"\A---\n.*?\n---\n",  # settings of a page
    r"^[ ]*(```|~~~).*?^[ ]*\1[ ]*$",  # code, directives
    r"^\$\$.*?\$\$",  # formulas
    r"^[ ]*\|.*?$",  # tables
    r"^#.*?$",  # headings
    r"^={3,}.*?^={3,}.*?^={3,}[ =]*$",  # tables of reStructuredText, with or without a head
    r"^={3,}.*?^={3,}[ =]*$",
    r"^[ ]*(>>>|\.\.\.)[^\n]*\n(?:[^\n]+\n)*",  # examples and what they print
    r"^[ ]*\w[\w ]*\n[ ]*-{3,}$",  # sections of numpydoc
    r"^(?![ ]*(?:[-*]|\d+\.) )([ ]*)\S[^\n]*$(?=\n\1[ ]{4}\S)",  # names and types above their description
    r"^[^\n]+$(?=\n: )",  # terms of a glossary
    r"^\.\. .*?$",
    r"<!--.*?-->",
    r"<[^>\n]+>",
)
_CODE = r"``[^`]+``|`[^`]+`|\$[^$]+\$"
_ITEM = re.compile(r"^[ ]*(?:[-*] |\d+\. |: |[\w*, .]+ : .*$)", re.MULTILINE)
_END = re.compile(r"(?<=[.!?:])[\"')*]*\s+(?=[\"'(*\[$]*[A-Z`])")


def paragraphs(text: str) -> Iterator[list[str]]:
    """Sentences of each paragraph of a page or a docstring. A colon before a capital letter also ends a sentence."""
    text += "\n"  # a docstring may end with an example
    for pattern in _BLOCKS:
        text = re.sub(pattern, "\n\n", text, flags=re.MULTILINE | re.DOTALL if ".*?" in pattern else re.MULTILINE)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = _ITEM.sub("\n\n", text)
    for paragraph in re.split(r"\n\s*\n", text):
        found = [sentence.strip() for sentence in _END.split(" ".join(paragraph.split()))]
        yield [s for s in found if len(re.findall(r"[A-Za-z]{2,}", re.sub(_CODE, "", s))) >= 3]


def sentences(text: str) -> Iterator[str]:
    """Sentences of a page or a docstring."""
    for paragraph in paragraphs(text):
        yield from paragraph


def signature(node: ast.AST) -> str:
    """First line of a definition."""
    if isinstance(node, ast.FunctionDef):
        return f"def {node.name}({ast.unparse(node.args)})" + (
            f" -> {ast.unparse(node.returns)}" if node.returns else ""
        )
    return f"class {node.name}" if isinstance(node, ast.ClassDef) else "module"


def texts() -> Iterator[tuple[str, str, str]]:
    """Place, first line and text of each page, and of each docstring of the package."""
    for path in sorted(p for pattern in PAGES for p in REPOSITORY.glob(pattern)):
        yield str(path.relative_to(REPOSITORY)), "", path.read_text(encoding="utf-8")
    for path in sorted((REPOSITORY / "mstfilter").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
                yield f"{path.relative_to(REPOSITORY)}:{getattr(node, 'name', 'module')}", signature(node), text


def n_words(sentence: str) -> int:
    """Words of a sentence; an inline formula or piece of code counts as one."""
    short = re.sub(_CODE + r"|\[[-+.\d, ]+\]", "x", sentence)
    return len(re.findall(r"[\w\].%]*[A-Za-z0-9][^\s]*", short))


def every_sentence() -> list[tuple[str, str]]:
    """(place, sentence) of the whole project."""
    return [(place, sentence) for place, _, text in texts() for sentence in sentences(text)]


def every_context() -> list[str]:
    """First line of the definition, and the paragraph with the sentence marked, in the order of `every_sentence`."""
    return [
        f"{line}\n  " + " ".join([*paragraph[:i], f">>> {sentence} <<<", *paragraph[i + 1 :]]) + "\n"
        for _, line, text in texts()
        for paragraph in paragraphs(text)
        for i, sentence in enumerate(paragraph)
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--longer", type=int, help="list the sentences of more than this number of words instead")
    parser.add_argument("--context", action="store_true", help="print what a reader of the file sees, too")
    options = parser.parse_args()
    found = every_sentence()
    if options.context:
        found = [(place, context) for (place, _), context in zip(found, every_context(), strict=True)]
    if options.longer:
        found = [(f"{n_words(s):3} {place}", s) for place, s in found if n_words(s) > options.longer]
    else:
        found = random.Random(options.seed).sample(found, options.n)
    print("\n".join(f"{place}: {sentence}" for place, sentence in found))
