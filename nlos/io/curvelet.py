"""Pairs of CC-SOCR, whose points are numbers of a lattice that a MATLAB script beside them scales.

Liu et al., "Non-line-of-sight imaging with arbitrary illumination and detection pattern", Nat.
Commun. 14, 3230 (2023): ``sub_Sig`` (pairs, t), with laser spots and wall points in ``C_i.mat`` and
``C_d.mat`` beside it, (pairs, 3), counted in steps (depth, to the left, up) of ``bx``, ``by`` and
``bz`` metres; ``experimental_setup.m``, in the same folder or the one above, sets these steps and
``c * delta_t``, the path of a bin. Seen from their wall the second number grows to the left and the
third upwards: their letters N T read as N T only so.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.io.fields import NamedArrays, read_matlab
from tofclip.errors import FileFormatError
from tofclip.files import translate_read_errors
from tofclip.units import SPEED_OF_LIGHT

SETUP_FILE = "experimental_setup.m"
STEP_NAMES = ("bx", "by", "bz")
SETUP_NAMES = ("c", "delta_t", *STEP_NAMES)

BIN_WIDTH_S = 32e-12
"""Where no script says otherwise."""

MIN_SPEED_IN_SECONDS = 1e8
"""Where the script's c is larger, its delta_t is in s; else c is 1 and delta_t is a path, m."""

MIN_LATTICE_EXTENT = 8
"""Whole numbers that reach over less than this may be metres."""

TO_SCENE = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Turns (depth, to the left, up) into (x to the right, y down, z into the scene)."""

MAX_SCRIPT_BYTES = 1 << 20

OPERATIONS: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}


def read_curvelet_data(fields: NamedArrays) -> Capture:
    """Read ``sub_Sig`` with the pairs' points, and the script that scales them, beside the file.

    Without the script points are metres: (depth, to the left, up) where the first does not vary,
    else (x, y, z).
    """
    counts = fields.array("sub_Sig", None, None)
    laser, wall = (_read_points(fields, name, len(counts)) for name in ("C_i.mat", "C_d.mat"))
    script = _find_script(fields.path)
    if script is not None:
        found = parse_setup(script)
        steps = np.array([found[name] for name in STEP_NAMES])
        laser, wall = ((points * steps) @ TO_SCENE.T for points in (laser, wall))
        speed, bin_width = found["c"], found["delta_t"]
        if speed < MIN_SPEED_IN_SECONDS:
            bin_width *= speed / SPEED_OF_LIGHT
        return Capture(counts.T, wall, laser, bin_width)
    if _are_lattice_numbers(wall):
        raise FileFormatError(
            fields.path,
            f"has pairs counted in steps of a lattice; it needs {SETUP_FILE} beside it or in the "
            "folder above, which sets c, delta_t, bx, by and bz; see docs/own_wall.md",
        )
    if np.ptp(wall[:, 0]) == 0 and np.ptp(laser[:, 0]) == 0:
        laser, wall = laser @ TO_SCENE.T, wall @ TO_SCENE.T
    return Capture(counts.T, wall, laser, BIN_WIDTH_S)


def parse_setup(path: str | Path) -> Mapping[str, float]:
    """Read the first value of each of `SETUP_NAMES` in a MATLAB script.

    `path`: assignments of sums and products of numbers, and of names set before.
    """
    with translate_read_errors(path), open(path, "rb") as file:
        text = file.read(MAX_SCRIPT_BYTES).decode(errors="replace")
    found: dict[str, float] = {}
    for line in text.splitlines():
        for name, value in re.findall(r"\b([a-z]\w*)\s*=([^=;]+);", line.split("%")[0]):
            if name in SETUP_NAMES and name not in found:
                found[name] = _evaluate(value.strip(), found)
    for name in SETUP_NAMES:
        if not found.get(name, 0.0) > 0 or not np.isfinite(found[name]):
            raise FileFormatError(path, f"does not set {name} to a positive number")
    return found


def _evaluate(text: str, known: Mapping[str, float]) -> float:
    """Evaluate a sum or product of numbers and known names; NaN for anything else."""

    def value_of(node: ast.expr) -> float:
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATIONS:
            return OPERATIONS[type(node.op)](value_of(node.left), value_of(node.right))
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            return float(node.value)
        return known.get(node.id, np.nan) if isinstance(node, ast.Name) else np.nan

    try:
        return value_of(ast.parse(text, mode="eval").body)
    except (SyntaxError, ValueError, ArithmeticError, RecursionError, MemoryError):
        return np.nan


def _find_script(path: Path) -> Path | None:
    folders = (path.parent, path.resolve().parent.parent)
    return next((f / SETUP_FILE for f in folders if (f / SETUP_FILE).is_file()), None)


def _are_lattice_numbers(points: NDArray[np.float64]) -> bool:
    whole = bool(np.all(points == np.round(points)))
    return whole and float(np.ptp(points, axis=0).max()) >= MIN_LATTICE_EXTENT


def _read_points(fields: NamedArrays, name: str, pairs: int) -> NDArray[np.float64]:
    """Points (pairs, 3), as they stand in the file of that name beside the signals."""
    path = fields.path.with_name(name)
    if not path.is_file():
        raise FileFormatError(
            fields.path,
            f"holds sub_Sig of {pairs} pairs; it needs C_i.mat (laser spots) and C_d.mat (wall points) beside it, "
            "see docs/own_wall.md",
        )
    beside = read_matlab(path)
    for one in sorted(beside.names):
        points = beside.read_numbers(one).astype(np.float64)
        if points.shape == (pairs, 3):
            return points
    raise FileFormatError(path, f"holds no points of shape ({pairs}, 3)")
