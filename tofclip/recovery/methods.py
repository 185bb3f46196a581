"""The methods of recovery by their names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tofclip.errors import InputError
from tofclip.recovery.surfaces import SurfaceRecovery
from tofclip.solvers import Backprojection, LinearInverse, Method, Sparse, TotalVariation

AnyMethod = Method | SurfaceRecovery

FURTHER_SPARSE_ITERATIONS = 40
"""Of `l1` where their number is not given: a bright shot needs more of them than a dark one."""

SPARSE_NOISE_FALL = 2e-3
"""Of `l1` where iterations are not given. In shots with 20 photons in the brightest pixel the solution
without negative values turns the noise into single bright pixels, and empties those between: after
25 iterations 25 and 34 % of two scenes' pixels are missed, after 40 33 and 41 %. Noise alone falls as
slowly from the 19th iteration on."""


def make_sparse(**settings: Any) -> Sparse:
    """Make the method `l1`, which goes on while its objective falls, and ends before it follows the
    noise, unless iterations are given.
    """
    if "iterations" in settings:
        return Sparse(**settings)
    return Sparse(
        **{"further": FURTHER_SPARSE_ITERATIONS, "noise_fall": SPARSE_NOISE_FALL, **settings}
    )


METHODS: dict[str, Callable[..., AnyMethod]] = {
    "tv": TotalVariation,
    "l1": make_sparse,
    "linear": LinearInverse,
    "adjoint": Backprojection,
    "surfaces": SurfaceRecovery,
}


def make_method(name: str, **settings: Any) -> AnyMethod:
    """Make a recovery method by its short name, with settings of its own where given.

    Parameters
    ----------
    name : str
        ``"tv"``, ``"l1"``, ``"linear"``, ``"adjoint"`` or ``"surfaces"``.
    **settings
        Passed on, such as ``iterations`` and ``weight`` of the iterative methods; None stands for
        the method's own.

    Raises
    ------
    InputError
        There is no such method, or it has no such setting.

    Examples
    --------
    >>> make_method("tv", iterations=100, weight=None).iterations
    100
    """
    if name not in METHODS:
        raise InputError(f"unknown method '{name}'; choose one of {', '.join(METHODS)}")
    given = {setting: value for setting, value in settings.items() if value is not None}
    try:
        return METHODS[name](**given)
    except TypeError as fault:
        raise InputError(f"method '{name}' does not take {', '.join(given)}") from fault
