"""Captures of known hidden scenes: the truth that reconstructions are compared with.

`PointScene` is the plainest and exact to float64; `HiddenScene` has letters and triangle meshes
that hide one another.
"""

from nlos.simulate.scene import (
    HiddenScene,
    Lambert,
    Material,
    PointScene,
    Retroreflector,
    Surface,
    add_poisson_noise,
)
from nlos.simulate.walls import WALLS, build_relay_wall

__all__ = [
    "WALLS",
    "HiddenScene",
    "Lambert",
    "Material",
    "PointScene",
    "Retroreflector",
    "Surface",
    "add_poisson_noise",
    "build_relay_wall",
]
