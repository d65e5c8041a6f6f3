"""Sphinx configuration."""

from mstfilter import __version__

project = "mstfilter"
author = "The mstfilter developers"
copyright = "2026, the mstfilter developers"
release = version = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
html_theme = "furo"
html_title = "mstfilter"
exclude_patterns = ["_build"]
suppress_warnings = ["ref.python"]
