"""What every denoiser offers."""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray

Picture = NDArray[Any]


class Denoiser(Protocol):
    """Removes even noise of a known strength from one picture."""

    def __call__(self, noisy: Picture, pilot: Picture, deviation: float) -> Picture:
        """Return the picture without its noise.

        Parameters
        ----------
        noisy : (rows, columns) array
        pilot : (rows, columns) array
            A cleaner estimate of the same picture, for denoisers that look there for what is alike.
        deviation : float
            Standard deviation of the noise, in the picture's unit.
        """
        ...
