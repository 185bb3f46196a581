"""Imaging around corners: from transients on a relay wall to a volume of the hidden scene.

Conventions, used everywhere in this package:

* Coordinates are metres in the wall's frame: x to the right, y down, and the hidden scene on the
  side of larger z, so a volume ``(z, y, x)`` begins at the wall. Pictures look along +z, from the
  wall into the hidden scene.
* Light goes laser spot r_L -> hidden point r -> wall point r_p. Bin i of a capture holds what
  arrives after a path ``|r_L - r| + |r - r_p|`` of ``start + i * c * bin_width``; the ways from and
  to the device are taken off.
* With L_i the path of bin i and k a wavenumber of the virtual pulse, a wall point's signal H has
  the phasor ``P_k = G_k * sum_i H_i * exp(-1j * k * L_i)`` and voxel r gets ``sum_k sum_p P_k(r_p)
  * exp(+1j * k * (|r_L - r| + |r - r_p|)) / |r - r_p|``: the phase of a wave that left the laser
  spot grows along its path, and the picture focuses where all phasors are turned back to the same
  phase.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nlos.backprojection import Backprojection
    from nlos.capture import Capture
    from nlos.confocal.light_cone import LightCone
    from nlos.confocal.migration import FKMigration
    from nlos.filtered import FilteredBackprojection
    from nlos.geometry import Grid
    from nlos.hybrid import Hybrid
    from nlos.portable.prepared import PreparedImaging
    from nlos.propagation.propagate import propagate
    from nlos.refinement.refine import Refinement
    from nlos.rsd.planar import PlanarRSD
    from nlos.video import TransientImaging, TransientVideo
    from nlos.volume import Volume

__all__ = [
    "Backprojection",
    "Capture",
    "FKMigration",
    "FilteredBackprojection",
    "Grid",
    "Hybrid",
    "LightCone",
    "PlanarRSD",
    "PreparedImaging",
    "Refinement",
    "TransientImaging",
    "TransientVideo",
    "Volume",
    "propagate",
]

_HOMES = {
    "Backprojection": "nlos.backprojection",
    "Capture": "nlos.capture",
    "FKMigration": "nlos.confocal.migration",
    "FilteredBackprojection": "nlos.filtered",
    "Grid": "nlos.geometry",
    "Hybrid": "nlos.hybrid",
    "LightCone": "nlos.confocal.light_cone",
    "PlanarRSD": "nlos.rsd.planar",
    "PreparedImaging": "nlos.portable.prepared",
    "Refinement": "nlos.refinement.refine",
    "TransientImaging": "nlos.video",
    "TransientVideo": "nlos.video",
    "Volume": "nlos.volume",
    "propagate": "nlos.propagation.propagate",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that ``import nlos`` stays quick."""
    if name not in _HOMES:
        raise AttributeError(f"module 'nlos' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *__all__})
