"""Sphinx configuration. Pages with ``file_format: mystnb`` are notebooks as text: the build executes them."""

import os
import pkgutil
import re
from copy import deepcopy
from pathlib import Path

import latex2mathml.converter
from docutils import nodes

import mstfilter
from mstfilter import __version__

project = "mstfilter"
author = "The mstfilter developers"
copyright = "2026, the mstfilter developers"
release = version = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.autosummary", "sphinx.ext.viewcode"]
templates_path = ["_templates"]
html_math_renderer = "mathml"  # drawn by the browser, without a script or a network
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
os.environ["PYTHONPATH"] = os.pathsep.join(  # the cells of exactness.md import from there
    [str(Path(__file__).parent.parent / "experiments" / "miniature"), os.environ.get("PYTHONPATH", "")]
)
nb_execution_mode = "auto"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True
autosummary_context = {  # a front door only re-exports, so its page has no members
    "front_doors": {m.name for m in pkgutil.walk_packages(mstfilter.__path__, "mstfilter.") if m.ispkg}
}
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
html_theme = "furo"
html_title = "mstfilter"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_search_scorer = str(Path(__file__).parent / "_templates" / "search_scorer.js")
exclude_patterns = ["_build"]
suppress_warnings = ["ref.python", "mystnb.unknown_mime_type"]

_THIN = '<mspace width="0.15em"/>'  # around exp and log, which browsers set without space


def show_pictures(app, tree, page):
    """Put the first picture of each page that a heading of the gallery links to below that heading."""
    if page != "gallery":
        return
    for link in list(tree.findall(nodes.reference)):
        target = link.get("refuri", "").removesuffix(".html").partition("#")[0]
        if not isinstance(link.parent, nodes.title) or target not in app.env.found_docs:
            continue
        pictures = list(app.env.get_doctree(target).findall(nodes.image))
        if pictures:
            title = link.parent
            title.parent.insert(title.parent.index(title) + 1, deepcopy(pictures[0]))


def add_mathml(display):
    """A visitor that writes a formula as MathML."""

    def visit(translator, node):
        formula = latex2mathml.converter.convert(node.astext(), display=display)
        formula = re.sub(r"(?<!<msub>)(?<!<msup>)(<mi>(?:exp|log)</mi>)", rf"{_THIN}\1{_THIN}", formula)
        translator.body.append(formula if display == "inline" else f'<div class="formula">{formula}</div>')
        raise nodes.SkipNode

    return visit


def link_to_modules(app, env):
    """Links back from the source lead to the page of the module; viewcode names the package of the same object."""
    entries = getattr(env, "_viewcode_modules", {})
    for name, entry in list(entries.items()):
        if entry and f"reference/modules/{name}" in env.found_docs:
            entries[name] = (*entry[:3], name)
        elif not entry:
            del entries[name]  # without source, for example builtins


def setup(app):
    app.add_html_math_renderer("mathml", (add_mathml("inline"), None), (add_mathml("block"), None))
    app.connect("doctree-resolved", show_pictures)
    app.connect("env-updated", link_to_modules)
