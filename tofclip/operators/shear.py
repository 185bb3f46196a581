"""The shear B_k: from the refocused reference picture to the picture that a view sees (supplement
Eq. 3).
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from numpy.typing import DTypeLike

from tofclip.arrays import Array
from tofclip.errors import require
from tofclip.operators.base import LinearOperator

View = tuple[float, float]


class _Shear(LinearOperator):
    """A shift of the whole picture by s times the view's distance from the reference view.

    View (v, u) sees ``p(x, y) = h(x - s (u - u_ref), y - s (v - v_ref))``, s being the shear in
    pixels per view step; the reference may lie anywhere (viewpoint synthesis). The adjoint is the
    opposite shift, exactly.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        shear: float,
        view: View,
        reference: View = (0.0, 0.0),
        dtype: DTypeLike = np.float32,
    ) -> None:
        super().__init__(image_shape, image_shape, dtype)
        self.shift_px = tuple(float(shear * (a - b)) for a, b in zip(view, reference, strict=True))
        require(
            np.all(np.abs(self.shift_px) < np.asarray(image_shape)),
            f"shear {shear} moves view {view} by {self.shift_px} px, out of a {image_shape} picture; "
            "take a shear nearer to zero",
        )

    def _forward(self, block: Array) -> Array:
        return self._shift(block, self.shift_px[0], self.shift_px[1])

    def _adjoint(self, block: Array) -> Array:
        return self._shift(block, -self.shift_px[0], -self.shift_px[1])

    @abstractmethod
    def _shift(self, block: Array, down: float, right: float) -> Array:
        """Shift a (rows, columns, batch) block."""


class LinearShear(_Shear):
    """The shear with linear interpolation between neighbouring pixels; dark beyond the border."""

    def _shift(self, block: Array, down: float, right: float) -> Array:
        from tofclip.operators.kernels import shift_linearly

        rows, columns = (int(np.floor(shift)) for shift in (down, right))
        below, beside = np.array([down - rows, right - columns], self.dtype)
        shifted = np.empty_like(block)
        shift_linearly(block, rows, columns, below, beside, shifted)
        return shifted


class FourierShear(_Shear):
    """The shear with Fourier interpolation: no blur, but periodic: what leaves on one side enters
    on the other.
    """

    def _shift(self, block: Array, down: float, right: float) -> Array:
        import scipy.fft

        rows, columns = self.shape_in
        spectrum = scipy.fft.rfft2(block, axes=(0, 1))
        axes = (np.fft.fftfreq(rows)[:, np.newaxis], down), (np.fft.rfftfreq(columns), right)
        for cycles_per_px, shift_px in axes:
            delay = np.exp(-2j * np.pi * cycles_per_px * shift_px)
            # the Nyquist frequency stands for both signs: its real part alone keeps the picture
            # real, and the shift back the adjoint
            delay = np.where(np.abs(cycles_per_px) == 0.5, delay.real, delay)
            spectrum *= delay[..., np.newaxis]
        shifted = scipy.fft.irfft2(spectrum, s=(rows, columns), axes=(0, 1))
        return np.ascontiguousarray(shifted, dtype=self.dtype)
