"""Surfaces instead of frames: range and amplitude of every pixel from the whole shot at once.

A frame is a thin slice through surfaces, often a ring or a sliver, which no prior on pictures fits.
Here the prior is on the surfaces. Surface k has a range r_k(p), its inverse depth a smooth function
over the picture, and an amplitude a_k(p) >= 0; the raw streak image is

    y = sum_k sum_p a_k(p) g_v s_v(p, r_k(p)) h(t - 2 r_k(p) / c),

with the gains g_v of the views, the place s_v of the pixel on the slit at the shear of its range,
and the pulse h (`model`). With photon weights w the objective is

    J(a, r) = 1/2 |A(r) a - y|^2_w + sum_k weight_k TV(a_k) + 1/2 sum_k |bending of 1/z_k|^2.

The modules in the order of the work:

* `patches` finds surfaces in the returns of a fast recovery of frames, and `refusal` shots without
  them. Surfaces reach beyond their returns, since the measurements decide where a surface ends;
  their shapes are sums over a `basis`.
* `model` is A(r): where points fall (`places`), the pulse (`pulse`), at the `state` of surfaces and
  camera; `weights` has the measurements. Its loops are in `kernels`.
* `amplitudes` solves for a by FISTA, with a step size for each surface; `ranges` for the state by
  Gauss-Newton steps on its `derivatives`, each taken only if it lowers the misfit.
* `fit` has the order of these, and `returns` lists the points and how far off each may be.
* `recovery` is the method that `tofclip recover` runs.

docs/recovery_algorithm.md derives it.
"""

from tofclip.recovery.surfaces.fit import SurfaceRecovery

__all__ = ["SurfaceRecovery"]
