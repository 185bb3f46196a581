"""Who hears of the compiler's work; known before the compiler is imported."""

from __future__ import annotations

from collections.abc import Callable

observers: list[Callable[[str], None]] = []
"""Called with the function's name when its compiling begins, from the thread that compiles. What
comes from disk is not reported."""

suppliers: list[Callable[[str, str], None]] = []
"""Called with module and name of a loop before it is sought on disk; they return when another
process that compiles it has put it there."""
