"""How the documentation is built: ``sphinx-build -W docs docs/_build``. Nothing is fetched from the
network.
"""

from __future__ import annotations

import sys
from pathlib import Path

from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

from verb_pages import write_pages  # noqa: E402 - the path has to be known first

from tofclip import __version__  # noqa: E402

project = "ToF-CLIP"
author = "The ToF-CLIP developers"
copyright = author  # noqa: A001 - Sphinx wants this name
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = [
    "_build",
    "notebooks/*.ipynb",
    "reproduction/*.md",
]  # those are parts of reproduction.md
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3

smartquotes = False  # they would turn -- of an option into a dash
default_role = "py:obj"
autodoc_default_options = {"members": True}
autodoc_typehints = "signature"  # the docstrings add shapes and units
# NumPy's own unions fill five lines of a signature
autodoc_type_aliases = {"DTypeLike": "DTypeLike", "ArrayLike": "ArrayLike"}
napoleon_google_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False

html_theme = "furo"
html_static_path = ["static"]
html_js_files, html_css_files = ["copy.js"], ["copy.css"]
html_title = f"ToF-CLIP {release}"
html_show_sphinx = False


def write_verb_pages(app: Sphinx) -> None:
    """Make a page for each verb from the program, before pages are looked for."""
    write_pages(Path(app.srcdir) / "verbs")


def setup(app: Sphinx) -> None:
    """Register what Sphinx has to do first."""
    app.connect("builder-inited", write_verb_pages)
