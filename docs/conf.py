"""The documentation as a site: ``make docs``. Pages are Markdown, the reference is made from docstrings."""

import importlib.metadata
import os
import sys
from pathlib import Path

project = "dropo_torch"
author = "the dropo_torch developers"
copyright = "the dropo_torch developers, MIT license"
version = release = importlib.metadata.version("dropo_torch")

extensions = [
    "myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon", "sphinx_copybutton",
    "sphinxcontrib.programoutput",
]  # fmt: skip
exclude_patterns = ["_build"]

# Markdown and notebooks. Notebooks hold no results: they are run when the site is built.
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence", "dollarmath"]
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

# The reference: what the package exports, in the order of its stub file.
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_google_docstring = True
napoleon_use_ivar = True
napoleon_numpy_docstring = False

# What `dropo COMMAND --help` prints is shown as it is now.
os.environ |= {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", "COLUMNS": "100"}

html_theme = "furo"
html_title = "dropo_torch"
html_static_path = ["_static"]
html_css_files = ["site.css"]
