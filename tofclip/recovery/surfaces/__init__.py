"""Surfaces instead of frames: range and amplitude of every pixel from the whole shot at once.

A frame is a thin slice through surfaces, often a ring or a sliver, which no prior on pictures fits.
Here the prior is on the surfaces. Surface k has a range r_k(p), its inverse depth a smooth function
over the picture (`shapes`), and an amplitude a_k(p) >= 0; the raw streak image is

    y = sum_k sum_p a_k(p) g_v s_v(p, r_k(p)) h(t - 2 r_k(p) / c),

with the gains g_v of the views, the place s_v of the pixel on the slit at the shear of its range,
and the pulse h. With photon weights w the objective is

    J(a, r) = 1/2 |A(r) a - y|^2_w + sum_k weight_k TV(a_k) + 1/2 sum_k |bending of 1/z_k|^2.

`patches` finds surfaces in the returns of a fast recovery of frames, `pulse` the shot's pulse;
`points` says where surfaces are and their light falls, `model` is A(r) at a state of surfaces and
camera, with its loops in `kernels`; `amplitudes` solves for a by FISTA, `ranges` for the state by
Gauss-Newton steps. `recovery` is the method that `tofclip recover` runs: `start` lays surfaces out or
refuses the shot, `fit` has the order of all steps, of which `extents` says how far surfaces reach,
`straighten` which shapes they have and `others` what frames see beside them; `returns` lists all.
docs/recovery_algorithm.md derives it.
"""

from tofclip.recovery.surfaces.recovery import SurfaceRecovery

__all__ = ["SurfaceRecovery"]
