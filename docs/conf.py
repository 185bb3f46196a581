"""How the documentation is built: ``sphinx-build -W docs docs/_build``. Nothing is fetched from the
network.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

from verb_pages import write_pages  # noqa: E402 - the path has to be known first

from tofclip import __version__  # noqa: E402

project = "ToF-CLIP"
author = "The ToF-CLIP developers"
copyright = author  # noqa: A001 - Sphinx wants this name
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
exclude_patterns = [
    "_build",
    "notebooks/*.ipynb",
    "results/reproduction/*.md",
]  # those are parts of reproduction.md
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3

smartquotes = False  # they would turn -- of an option into a dash
default_role = "py:obj"
autodoc_default_options = {"members": True}
autodoc_typehints = "signature"  # the docstrings add shapes and units
# NumPy's own unions fill five lines of a signature
autodoc_type_aliases = {"DTypeLike": "DTypeLike", "ArrayLike": "ArrayLike"}
autosummary_generate = False  # the tables of what is called first; every name has its place already
napoleon_google_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False

html_theme = "furo"
html_static_path = ["static"]
html_js_files, html_css_files = ["copy.js"], ["copy.css"]
html_search_scorer = str(HERE / "static" / "scorer.js")
html_title = f"ToF-CLIP {release}"
html_show_sphinx = False


def write_verb_pages(app: Sphinx) -> None:
    """Make a page for each verb from the program, before pages are looked for."""
    write_pages(Path(app.srcdir) / "verbs")


NUMPY_ARRAY = re.compile(
    r"~?numpy\.ndarray\[tuple\[~?typing\.Any, \.\.\.\], ~?numpy\.dtype\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\]"
)
CLASS = re.compile(r"<class '(?:builtins\.)?([\w.]+)'>")  # a default, as Python shows it


def shorten_signature(
    app: Sphinx,
    what: str,
    name: str,
    obj: object,
    options: Any,
    signature: str | None,
    returned: str | None,
) -> tuple[str | None, str | None]:
    """Write arrays as the code does, and defaults so that Sphinx can read the signature.

    What it cannot read, such as ``<factory>``, it prints as it is, with full paths and no links.
    """

    def shorten(text: str | None) -> str | None:
        text = text and CLASS.sub(r"\1", text)
        return text and NUMPY_ARRAY.sub(r"~numpy.typing.NDArray[\1]", text)

    return shorten(signature and signature.replace("<factory>", "...")), shorten(returned)


def protect_plain_text(
    app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]
) -> None:
    """Keep napoleon and reST from reading sentences as markup.

    "m." and an author's initial at the beginning of a line would begin a list, and what stands
    before a colon in a property's first line would become its type.
    """
    if what in {"attribute", "data", "property"} and lines:
        lines[0] = lines[0].replace(": ", " -- ")
    lines[:] = [re.sub(r"^(\s*)([A-Za-z])\.(?=\s|$)", r"\1\\\2.", line) for line in lines]


def setup(app: Sphinx) -> None:
    """Register what Sphinx has to do first."""
    app.connect("builder-inited", write_verb_pages)
    app.connect("autodoc-process-signature", shorten_signature)
    app.connect("autodoc-process-docstring", protect_plain_text, priority=400)  # before napoleon
