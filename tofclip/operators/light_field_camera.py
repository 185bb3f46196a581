"""The cameras of compact light-field photography by name: which nonlocal measurements each view of
a light field gets.
"""

from __future__ import annotations

from tofclip.operators.cameras.base import LightFieldCamera
from tofclip.operators.cameras.compressive import (
    AshokCamera,
    BabacanCamera,
    CompressiveCamera,
    MarwahCamera,
    SinglePixelCamera,
)
from tofclip.operators.cameras.lines import CodedLineCamera, EvenAngleLineCamera, LineCamera
from tofclip.operators.cameras.point_spread import (
    CodedApertureCamera,
    CubicPhaseCamera,
    DiffuserCamera,
    MeasuredCamera,
    PointSpreadCamera,
)

__all__ = [
    "CAMERAS",
    "COMPRESSIVE_CAMERAS",
    "AshokCamera",
    "BabacanCamera",
    "CodedApertureCamera",
    "CodedLineCamera",
    "CompressiveCamera",
    "CubicPhaseCamera",
    "DiffuserCamera",
    "EvenAngleLineCamera",
    "LightFieldCamera",
    "LineCamera",
    "MarwahCamera",
    "MeasuredCamera",
    "PointSpreadCamera",
    "SinglePixelCamera",
]

CAMERAS: dict[str, type[LightFieldCamera]] = {
    kind.name: kind
    for kind in (
        LineCamera,
        EvenAngleLineCamera,
        SinglePixelCamera,
        CodedLineCamera,
        CodedApertureCamera,
        CubicPhaseCamera,
        DiffuserCamera,
    )
}

COMPRESSIVE_CAMERAS: dict[str, type[CompressiveCamera]] = {
    kind.name: kind for kind in (AshokCamera, BabacanCamera, MarwahCamera)
}
"""Cameras that are made to recover whole light fields from dense sensors, for comparison
(supplement Note 5).
"""
