"""How loops and their parts are compiled, and who hears of it when that takes time.

A loop that Python calls is kept on disk. What only such loops call
needs neither: the caller's machine code holds it. Without entry points for Python and C and without
a file of its own it is compiled in a fifth less time.

Only modules of loops import this one: the compiler takes as long to import as all else.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numba.core import event
from numba.core.caching import FunctionCache
from numba.extending import register_jitable

from tofclip.compile_observers import observers, suppliers

SUMS_IN_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}
"""What sums in vectors need; unlike all of ``fastmath`` it leaves infinities and NaN what they are."""

ONE = np.uintp(1)
"""For numbers without a sign: beside one with a sign the compiler would make both floats."""

F = TypeVar("F", bound=Callable[..., Any])


class _SuppliedCache(FunctionCache):  # type: ignore[misc]
    """The compiler's cache, to which another process may be about to add the loop."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        for supply in tuple(suppliers):
            supply(self._py_func.__module__, self._py_func.__name__)
        return super().load_overload(sig, target_context)


def compile_loop(**options: Any) -> Callable[[Any], Any]:
    """Make the decorator of loops that Python calls and that write into arrays they are given.

    They make no array, so that nothing counts who holds one, and C does not call them: both would
    be compiled into each of them.

    Parameters
    ----------
    **options
        Of `numba.njit`, such as ``fastmath``.

    Returns
    -------
    callable
    """
    usual = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}

    def decorate(function: Any) -> Any:
        loop: Any = njit(**{**usual, **options})(function)
        if loop is not function:  # as it is where nothing is compiled
            loop._cache = _SuppliedCache(function)  # what njit's own `cache` sets as well
        return loop

    return decorate


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
        for report in tuple(observers):
            report(event.data["dispatcher"].py_func.__name__)

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _CompileListener())
