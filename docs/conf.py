"""Sphinx configuration."""

import sys
from pathlib import Path

import fdnt_xp

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "fdnt_xp"
author = "the fdnt_xp developers"
copyright = f"2026, {author}"
version = release = fdnt_xp.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "generated_tables",
]
exclude_patterns = ["_build", "tables"]
templates_path = ["_templates"]

myst_enable_extensions = ["amsmath", "deflist", "dollarmath"]
myst_heading_anchors = 3

# Single backticks in docstrings are code.
default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings state types with shapes and units
numpydoc_show_class_members = False

html_theme = "furo"
html_title = f"fdnt_xp {release}"
