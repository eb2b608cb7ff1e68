"""Sphinx configuration: Markdown pages, and reST docstrings of the code; built by ``make docs``."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import sb3_uspl

project = "sb3_uspl"
author = "the authors of sb3_uspl"
release = version = sb3_uspl.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["examples", "results"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
# The docstrings' ``:param:`` say what a type means; in the signatures the types would hide the names.
autodoc_typehints = "none"
autodoc_member_order = "bysource"
html_theme = "furo"
html_title = f"sb3_uspl {release}"
