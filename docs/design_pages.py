"""The pictures of the page on designs, drawn by the verb from the descriptions in docs/designs.

``python docs/design_pages.py`` draws them all; the page shows them.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from apps.cli import main
from apps.figures.style import store_picture

DOCS = Path(__file__).parent
LINES = {
    "paper": "--compare even.toml",
    "nine": "",
    "spad_line": "",
    "single_pixel": "",
    "paper_occluder": "--shots 0",
    "better": "--optimise angles",
}
"""Descriptions, and what else is asked of them; "better" begins with the paper's."""


def draw_pages() -> None:
    """Draw every picture of the page."""
    with tempfile.TemporaryDirectory() as folder:
        for name, options in LINES.items():
            drawn = Path(folder) / f"{name}.png"
            source = DOCS / "designs" / f"{'paper' if name == 'better' else name}.toml"
            words = [
                str(DOCS / "designs" / one) if one.endswith(".toml") else one
                for one in options.split()
            ]
            if main(["design", str(source), "--out", str(drawn), *words]):
                raise SystemExit(f"{name}: not drawn")
            store_picture(drawn, DOCS / "pictures" / "design" / f"{name}.png")


if __name__ == "__main__":
    draw_pages()
