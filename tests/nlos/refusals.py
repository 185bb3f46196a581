"""Why a method does not image a capture."""

from __future__ import annotations

from typing import Any

from nlos.volume import Grid
from tofclip.errors import InputError


def find_refusal(method: Any, capture: Any, grid: Grid) -> str:
    """Return the reason that a plan is refused for; empty if it is not."""
    try:
        method.plan(capture, grid)
    except InputError as refused:
        return str(refused)
    return ""
