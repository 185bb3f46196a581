#!/usr/bin/env python3
"""Count the house: lines, words and tokens of each package and of the tests, as a table.

``code`` is all lines less blank lines, comments and docstrings, where blank lines within docstrings
are taken off twice, so that figures compare with those of earlier counts: it rises a little where
docstrings get shorter. ``held`` are the lines that really hold code. Tokens are Python's own,
without comments, docstrings and line structure. Only files that git keeps count.
"""

from __future__ import annotations

import ast
import io
import subprocess
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("tofclip", "nlos", "devices", "apps")
COLUMNS = ("files", "all", "code", "held", "docstring", "words", "tokens", "functions", "classes")
STRUCTURE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENCODING, tokenize.ENDMARKER),
}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def count_file(text: str) -> dict[str, int]:
    """Return one file's figures, by column."""
    nodes = list(ast.walk(ast.parse(text)))
    homes = [one for one in nodes if isinstance(one, (*FUNCTIONS, ast.ClassDef, ast.Module))]
    docstrings = [
        home.body[0] for home in homes if ast.get_docstring(home, clean=False) is not None
    ]
    spans = {line for one in docstrings for line in range(one.lineno, one.end_lineno + 1)}
    starts = {(one.lineno, one.col_offset) for one in docstrings}
    tokens = [
        token
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in STRUCTURE and token.start not in starts
    ]
    lines = [line.strip() for line in text.splitlines()]
    return {
        "files": 1,
        "all": len(lines),
        "code": sum(bool(line) and line[0] != "#" for line in lines) - len(spans),
        "held": len({n for one in tokens for n in range(one.start[0], one.end[0] + 1)}),
        "docstring": len(spans),
        "words": sum(len(one.value.value.split()) for one in docstrings),
        "tokens": len(tokens),
        "functions": sum(isinstance(one, FUNCTIONS) for one in nodes),
        "classes": sum(isinstance(one, ast.ClassDef) for one in nodes),
    }


def count_folder(folder: str) -> dict[str, int]:
    """Return the sums over a folder's Python files."""
    listing = ["git", "ls-files", "-z", "--", f"{folder}/*.py"]
    names = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    paths = [ROOT / name for name in names.split("\0") if name]
    counts = [count_file(path.read_text("utf-8")) for path in paths if path.exists()]
    return {column: sum(count[column] for count in counts) for column in COLUMNS}


if __name__ == "__main__":
    rows = {name: count_folder(name) for name in PACKAGES}
    rows["packages"] = {column: sum(row[column] for row in rows.values()) for column in COLUMNS}
    rows["tests"] = count_folder("tests")
    print("".join(f"{head:>10}" for head in ("", *COLUMNS)))
    for name, row in rows.items():
        print(f"{name:>10}" + "".join(f"{count:>10,}" for count in row.values()))
