"""Who is told of each function whose compiling begins; known before the compiler is imported."""

from __future__ import annotations

from collections.abc import Callable

observers: list[Callable[[str], None]] = []
"""Called with the function's name, from the thread that compiles. What comes from disk is not
reported."""
