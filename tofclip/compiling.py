"""How loops and their parts are compiled, where they are kept, and who hears of it.

A loop that Python calls is kept on disk. What only such loops call
needs neither: the caller's machine code holds it. Without entry points for Python and C and without
a file of its own it is compiled in a fifth less time.

Only modules of loops import this one: the compiler takes as long to import as all else.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pickle import UnpicklingError
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numba.core import event
from numba.core.caching import FunctionCache
from numba.extending import register_jitable

# Says at level INFO which function is being compiled; what comes from disk is not reported.
logger = logging.getLogger(__name__)
# What sums in vectors need; unlike all of ``fastmath`` it leaves infinities and NaN what they are.
SUMS_IN_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}
# For loops whose sums stay in the order written, with functions as exact as float32.
SUMS_AS_WRITTEN = {"contract", "nsz", "arcp", "afn"}
# For numbers without a sign: beside one with a sign the compiler would make both floats.
ONE = np.uintp(1)
# What a damaged cache raises, or one of a version whose loops lay in other modules; a full or forbidden one.
UNREADABLE = (EOFError, UnpicklingError, ImportError, AttributeError)
UNUSABLE = (OSError, *UNREADABLE)

F = TypeVar("F", bound=Callable[..., Any])


class _DiskCache(FunctionCache):  # type: ignore[misc]
    """The compiler's cache; a loop that it cannot give or take is compiled for this run alone."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except UNREADABLE:  # which nothing could be added to either
            with suppress(OSError):
                self.flush()
        except OSError:
            pass
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except UNUSABLE:
            _say_not_kept()


@cache
def _say_not_kept() -> None:
    logger.warning(
        "compiled loops cannot be kept, so every run compiles them again: "
        "name a folder with room, which may be written to, in NUMBA_CACHE_DIR"
    )


def compile_and_keep(**options: Any) -> Callable[[Any], Any]:
    """Make the decorator of loops that are kept on disk; `options` are those of `numba.njit`."""

    def decorate(function: Any) -> Any:
        loop: Any = njit(**{"nogil": True, **options})(function)
        if loop is not function:  # as it is where nothing is compiled
            try:
                loop._cache = _DiskCache(function)  # what njit's own `cache` sets as well
            except RuntimeError:  # no folder can be written to
                _say_not_kept()
        return loop

    return decorate


def compile_loop(**options: Any) -> Callable[[Any], Any]:
    """Make the decorator of loops that Python calls and that write into arrays they are given. They
    make no array, so that nothing counts who holds one, and C does not call them: both would be
    compiled into each of them. They are kept as by `compile_and_keep`.
    """
    usual = {"error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}
    return compile_and_keep(**{**usual, **options})


compile_as_part: Callable[..., Callable[[F], F]] = partial(
    register_jitable, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True
)
"""Make the decorator of functions that compiled loops call, with options of `numba.njit` such as
``fastmath``. Called from Python they run as they are written.
"""


inlined = njit(inline="always")
"""Decorator of functions that Numba writes into the loop that calls them, so that constants which
they are given are constants to the compiler.
"""


class _CompileListener(event.Listener):  # type: ignore[misc]
    def on_start(self, event: Any) -> None:
        logger.info(event.data["dispatcher"].py_func.__name__)

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _CompileListener())
