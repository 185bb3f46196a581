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

import lazy_loader as lazy

# `__init__.pyi` beside this file lists the public names.
__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
