"""Every default of a method, a detector and a search, and the place that measures or explains it.

Who changes one says here where the new one was measured.
"""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path
from typing import Any

import pytest

import nlos
from nlos.backprojection import Weighting
from nlos.refinement.l1 import build_total_variation
from nlos.refinement.photons import PhotonRefinement
from tofclip.lidar import Detection
from tofclip.lidar.photons import PhotonDetector, Smoothness
from tofclip.recovery import DepthLockedFocus, FixedFocus, SurfaceRecovery
from tofclip.simulate import StreakDetector
from tofclip.solvers import (
    LeastSquares,
    LinearInverse,
    PlugAndPlay,
    RegularisationByDenoising,
    Sparse,
    TotalVariation,
    Wavelets,
)
from tofclip.solvers.denoising import CollaborativeWiener, NonlocalMeans
from tofclip.solvers.fista import LightFieldVariation

FISTA = "docs/recovery_algorithm.md: ## 4. Frames from f, with a prior: FISTA"
LINEAR = "docs/recovery_algorithm.md: ## 5. Frames from f, without: the linear inverse"
RANGES = "docs/recovery_algorithm.md: ## 6. From frames to ranges"
SURFACES = "docs/recovery_algorithm.md: ## 7. Surfaces instead of frames"
SHEARS = "docs/recovery_algorithm.md: ## 3. Which shear each frame has"
REFOCUS = "docs/results/reproduction.md: ## Refocusing a recovered light field beside direct recovery, SR = 1"
HIDDEN = "docs/nlos.md: ## Which method for which capture"
REFINED = "docs/nlos.md: ## Refined"
FEW_PHOTONS = "docs/nlos.md: ## Few photons"
BUYS = "docs/nlos_algorithm.md: ## What each step buys"
ROOT = Path(__file__).parents[1]
CHOSEN = "chosen: no study compares it with others"

PROXIMAL = {"tolerance": 0.0, "data_term": LeastSquares, "gap": 1e-3, "further": 0}
PROXIMAL |= {"noise_fall": 0.0}
WIENER = CollaborativeWiener()
DEFAULTS: dict[str, dict[Any, dict[str, Any]]] = {
    FISTA: {
        Sparse: {"weight": 2e-3, "iterations": 40, **PROXIMAL},
        TotalVariation: {"weight": 1e-3, "iterations": 60, **PROXIMAL},
    },
    LINEAR: {LinearInverse: {"damping": 1e-2}},
    RANGES: {
        Detection: {
            "signal_to_noise": 5.0,
            "min_scene_fraction": 0.05,
            "min_time_bin_fraction": 0.12,
            "min_pixel_fraction": 0.2,
            "max_returns": 4,
        }
    },
    SURFACES: {
        SurfaceRecovery: {
            "weight": 2.0,
            "iterations": 60,
            "start": Sparse(),
            "detection": Detection(5.0, 0.0, 0.0, 0.0),
            "otherwise": None,
        }
    },
    SHEARS: {DepthLockedFocus: {"tolerance_px": 0.25}, FixedFocus: {"shear": 0.0}},
    REFOCUS: {
        LightFieldVariation: {
            "weight": 1e-2,
            "iterations": 200,
            "grid": (1, 1),
            "angular": 0.5,
            **PROXIMAL,
        }
    },
    "its docstring": {
        PlugAndPlay: {
            "start": TotalVariation(),
            "denoiser": WIENER,
            "calls": 8,
            "strength": 0.12,
            "coupling": 0.1,
        }
    },
    HIDDEN: {
        nlos.Backprojection: {"cycles": 3.0, "weighting": Weighting(1.0, 0.0)},
        nlos.FilteredBackprojection: {"sigma": 0.02, "weighting": Weighting(0.0, 0.0)},
        nlos.LightCone: {"signal_to_noise": 0.8, "falloff": 4.0},
        nlos.FKMigration: {"falloff": 4.0},
    },
    BUYS: {
        nlos.PlanarRSD: {"cycles": 3.0, "tolerance": 1e-2},
        nlos.Hybrid: {"cycles": 3.0, "propagation": "spectral", "tolerance": 1e-2, "plane_z": None},
    },
    REFINED: {
        nlos.Refinement: {"prior": Sparse(weight=2e-2, iterations=60)},
        build_total_variation: {"weight": 2e-2, "iterations": 60},
    },
    FEW_PHOTONS: {
        PhotonRefinement: {
            "iterations": 12,
            "prior_weight": 1.0,
            "blank": 0.0,
            "ramp": 0.0,
            "response_sigma": None,
        }
    },
    CHOSEN: {
        Wavelets: {"weight": 2e-3, "iterations": 60, **PROXIMAL},
        RegularisationByDenoising: {
            "start": TotalVariation(),
            "denoiser": WIENER,
            "calls": 8,
            "strength": 0.08,
            "coupling": 0.3,
        },
        NonlocalMeans: {"patch_px": 5, "reach_px": 10, "filtering": 0.6},
        CollaborativeWiener: {"patch_px": 6, "stride_px": 3, "reach_px": 10, "group": 40},
        PhotonDetector: {
            "false_alarm_rate": 0.01,
            "max_returns": 1,
            "min_photons": 20.0,
            "background": None,
        },
        Smoothness: {"slope_cost": 1.0, "jump_cost": 6.0, "reach_px": 1},
        StreakDetector: {
            "rows": 576,
            "bin_width": 2e-11,
            "peak_photons": 2000.0,
            "background_photons": 2.0,
            "full_scale_photons": 65535.0,
        },
    },
}


def find_defaults(made: Any) -> dict[str, Any]:
    """Return the defaults of what a class or function is given, by name."""
    if not dataclasses.is_dataclass(made):
        given = inspect.signature(made).parameters.values()
        return {one.name: one.default for one in given if one.default is not one.empty}
    defaults = {}
    for field in dataclasses.fields(made):
        if field.init and field.default is not dataclasses.MISSING:
            defaults[field.name] = field.default
        elif field.init and field.default_factory is not dataclasses.MISSING:
            defaults[field.name] = field.default_factory()
    return defaults


@pytest.mark.parametrize(
    ("where", "made"),
    [(where, made) for where, measured in DEFAULTS.items() for made in measured],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_default_is_what_was_measured(where: str, made: Any) -> None:
    expected, found = DEFAULTS[where][made], find_defaults(made)
    for name in sorted(expected.keys() | found.keys()):
        before, now = expected.get(name, "nothing"), found.get(name, "nothing")
        assert before == now, (
            f"{made.__name__}'s default {name} was {before} ({where}) and is {now} now: "
            "measure it anew, and say here and there what was found"
        )


def test_the_places_where_defaults_were_measured_exist() -> None:
    for place in (where for where in DEFAULTS if where.startswith("docs/")):
        page, heading = place.split(": ", 1)
        lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
        assert any(line.startswith(heading) for line in lines), place
    for made in DEFAULTS["its docstring"]:
        assert "strength" in str(inspect.getdoc(made)), made.__name__
