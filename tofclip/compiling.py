"""How the parts of compiled loops are compiled, and who hears of it when that takes time.

A loop that Python calls is compiled by `numba.njit` and kept on disk. What only such loops call
needs neither: the caller's machine code holds it. Without entry points for Python and C and without
a file of its own it is compiled in a fifth less time.

The compiler itself is imported with the first loop: it takes as long to import as all else.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_observers: list[Callable[[str], None]] = []


def compile_as_part(**options: Any) -> Callable[[F], F]:
    """Make the decorator of functions that compiled loops call; called from Python they run as they
    are written.

    Parameters
    ----------
    **options
        Of `numba.njit`, such as ``fastmath``.

    Returns
    -------
    callable
        The decorator; it leaves the function as it is.
    """
    from numba.extending import register_jitable

    _listen_to_compiler()
    decorate: Callable[[F], F] = register_jitable(
        error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, **options
    )
    return decorate


def observe_compiling(report: Callable[[str], None]) -> Callable[[], None]:
    """Call `report` with the name of each function whose compiling begins; what comes from disk is
    not reported.

    Parameters
    ----------
    report : callable
        Takes the name; called from the thread that compiles.

    Returns
    -------
    callable
        Ends it.
    """
    _observers.append(report)
    return lambda: _observers.remove(report)


@cache
def _listen_to_compiler() -> None:
    from numba.core import event

    class CompileListener(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            for report in tuple(_observers):
                report(event.data["dispatcher"].py_func.__name__)

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", CompileListener())
