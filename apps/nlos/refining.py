"""Iterative refinement for the command line: which prior, how strong, how long."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar, cast

from apps.nlos.methods import ImagingSettings, build_method
from apps.settings import setting_field
from nlos import Refinement
from nlos.refinement.refine import build_total_variation
from tofclip.errors import InputError
from tofclip.solvers import Sparse

if TYPE_CHECKING:
    from nlos import Grid, Hybrid

PRIORS = ("l1", "tv")
REFINED_METHOD = "hybrid"
"""The method that is iterated."""

DEFAULT_ITERATIONS, DEFAULT_PRIOR_WEIGHT = 60, 2e-2


@dataclass(frozen=True)
class RefinementSettings(ImagingSettings):
    """Whether and how an image is refined; None is left to `nlos.Refinement`."""

    refine: str | None = setting_field(
        "NAME",
        "Iterate the hybrid's image: l1 for few bright things, tv for even surfaces.",
        shown="no",
        choices=PRIORS,
    )
    iterations: int | None = setting_field(
        "N",
        "With --refine: steps at most; each costs some four images.",
        shown=str(DEFAULT_ITERATIONS),
    )
    prior_weight: float | None = setting_field(
        "SHARE",
        "With --refine: how much the prior counts, of the weight that leaves nothing.",
        shown=str(DEFAULT_PRIOR_WEIGHT),
    )


Refining = TypeVar("Refining", bound=RefinementSettings)


def require_valid_refinement(settings: RefinementSettings, method: str | None) -> None:
    """Refuse a refinement that makes no sense, and settings of one that is not asked for.

    Parameters
    ----------
    settings : RefinementSettings
    method : str, optional

    Raises
    ------
    InputError
        One of these is the case.
    """
    if settings.refine is None:
        for name in ("iterations", "prior_weight"):
            if getattr(settings, name) is not None:
                raise InputError(
                    f"{name} is a setting of --refine; tell --refine {' or '.join(PRIORS)} as well"
                )
        return
    if settings.refine not in PRIORS:
        raise InputError(f"unknown prior '{settings.refine}'; refine by {' or '.join(PRIORS)}")
    if method not in (None, REFINED_METHOD):
        raise InputError(
            f"--refine iterates the {REFINED_METHOD} method, not {method}; leave --method out"
        )
    if settings.iterations is not None and settings.iterations < 1:
        raise InputError(f"iterations must be 1 or more, got {settings.iterations}")
    if settings.prior_weight is not None and not 0 <= settings.prior_weight < 1:
        raise InputError(
            f"prior_weight is a share from 0 to less than 1, got {settings.prior_weight}"
        )


def build_refinement(settings: Refining, grid: Grid) -> tuple[Refining, Refinement]:
    """Build the refinement that settings ask for on a grid; the settings come back with the
    defaults filled in.

    Parameters
    ----------
    settings : RefinementSettings
    grid : Grid

    Returns
    -------
    settings : RefinementSettings
    refinement : Refinement
    """
    weight = DEFAULT_PRIOR_WEIGHT if settings.prior_weight is None else settings.prior_weight
    iterations = settings.iterations or DEFAULT_ITERATIONS
    prior = (
        build_total_variation(grid, weight, iterations)
        if settings.refine == "tv"
        else Sparse(weight, iterations)
    )
    hybrid = cast("Hybrid", build_method(REFINED_METHOD, settings))
    return replace(settings, prior_weight=weight, iterations=iterations), Refinement(hybrid, prior)
