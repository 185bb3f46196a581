"""The notebooks, run as they stand: tests do it, and the pages of the documentation come from it.

``python docs/notebooks.py docs/notebooks/wall.ipynb FOLDER`` runs a notebook where all files of
FOLDER are at hand, and puts its page and pictures beside it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

TIMEOUT_S = 600


def run_notebook(notebook: Path, folder: Path) -> Path:
    """Run a notebook in a folder by ``jupyter nbconvert --execute``, and write its page there.

    Parameters
    ----------
    notebook : Path
    folder : Path
        With the files that it reads.

    Returns
    -------
    Path
        The page, in Markdown; its pictures are beside it.

    Raises
    ------
    subprocess.CalledProcessError
        A cell failed; the trace is on standard error.
    """
    copy = shutil.copy(notebook, folder)
    words = ["--to", "markdown", "--execute", f"--ExecutePreprocessor.timeout={TIMEOUT_S}", copy]
    subprocess.run([sys.executable, "-m", "nbconvert", *words], check=True, cwd=folder)
    return folder / f"{notebook.stem}.md"


def format_page(page: Path) -> None:
    """Format the code of a page in its place, by the rules of the folder that it lies in.

    nbconvert copies cells as they stand, with the semicolons that keep a notebook from printing.
    """
    subprocess.run(
        [sys.executable, "-m", "ruff", "format", "--quiet", page.name], check=True, cwd=page.parent
    )


def make_page(notebook: Path, files: Path) -> None:
    """Run a notebook with copies of files at hand and put its page and pictures beside it.

    The page is formatted as all code of the project is (``pip install 'tofclip[lint]'``).

    Parameters
    ----------
    notebook : Path
    files : Path
        Folder whose files it may read.
    """
    with tempfile.TemporaryDirectory() as folder:
        for file in files.iterdir():
            if file.is_file():
                shutil.copy(file, folder)
        page = run_notebook(notebook, Path(folder))
        format_page(Path(shutil.copy(page, notebook.parent)))
        pictures = notebook.parent / f"{notebook.stem}_files"
        shutil.rmtree(pictures, ignore_errors=True)
        shutil.copytree(page.with_name(pictures.name), pictures)


if __name__ == "__main__":
    make_page(Path(sys.argv[1]), Path(sys.argv[2]))
