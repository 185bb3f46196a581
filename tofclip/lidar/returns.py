"""Returns: when light came back to each pixel, how much, and how surely.

A recovered frame is no photon count: it went through an inverse problem, whose errors are spread over pixels and bins
and are nearly even in time. For such errors the least-squares fit of the pulse is the maximum-likelihood estimate, so
candidates are judged by the matched filter and refined by Gauss-Newton steps of that fit, below a bin. Histograms of
counted photons are for `tofclip.lidar.photons`, whose estimator is the maximum-likelihood one there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import run_blocks
from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError
from tofclip.lidar.detection import Detection
from tofclip.lidar.pulse import Pulse
from tofclip.transient import Frames
from tofclip.units import SPEED_OF_LIGHT

REFERENCE_RANGE = 1.0  # m; an intensity is what the same surface would send back from here
PIXELS_PER_BLOCK = 128  # their traces fit the second-level cache
SHARPENING = 2.0  # of the filter that looks for candidates; it costs a tenth of the matched filter's sensitivity
SHORTEST_PULSE_BINS = 2.0  # anything shorter falls between the samples


@dataclass(frozen=True)
class Returns:
    """A list of returns, pixel by pixel in raster order, nearest first within a pixel.

    Parameters
    ----------
    y, x : (n,) int32 array
        Row and column of the pixel.
    range : (n,) float64 array
        Distance from the camera along the line of sight, m.
    intensity : (n,) float32 array
        Counts of the return times (range / 1 m)^2: proportional to the surface's reflectance.
    confidence : (n,) float32 array
        Expected standard deviation of the range, m; smaller is surer.
    return_number : (n,) uint8 array
        1 for the nearest return of a pixel.
    time : (n,) float64 array
        Time of flight there and back, s.
    camera : Camera
        The camera that saw them.
    provenance : mapping
        How they came about.
    shear : (n,) float64 array, optional
        Shear at which the picture of that instant was recovered; 0 by default.
    """

    y: NDArray[np.int32]
    x: NDArray[np.int32]
    range: NDArray[np.float64]
    intensity: NDArray[np.float32]
    confidence: NDArray[np.float32]
    return_number: NDArray[np.uint8]
    time: NDArray[np.float64]
    camera: Camera
    provenance: Mapping[str, Any] = field(default_factory=dict)
    shear: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if self.shear.size == 0:
            object.__setattr__(self, "shear", np.zeros(self.y.shape))
        for name in ("x", "range", "intensity", "confidence", "return_number", "time", "shear"):
            if getattr(self, name).shape != self.y.shape:
                raise ShapeError(f"{name} of the returns", self.y.shape, getattr(self, name).shape)

    def __len__(self) -> int:
        return self.y.size

    @property
    def line_of_sight_px(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(rows, columns) of the reference view's pixels in which the returns lie.

        A picture that was not recovered at the shear of its range is displaced by the parallax; here that is undone.
        """
        missing = self.camera.shear_at(self.range) - self.shear
        rows, columns = self.camera.displacement_per_shear
        known = self.camera.lenslet_pitch > 0
        return self.y - known * rows * missing, self.x - known * columns * missing

    def image(self, name: str) -> NDArray[np.float32]:
        """Picture (y, x) of one property of each pixel's most intense return; NaN where nothing came back.

        Parameters
        ----------
        name : str
            ``"range"``, ``"intensity"``, ``"confidence"``, ``"return_number"`` or ``"time"``.
        """
        if name not in ("range", "intensity", "confidence", "return_number", "time"):
            raise InputError(f"returns have no property '{name}' to show as a picture")
        picture = np.full(self.camera.image_shape, np.nan, dtype=np.float32)
        upwards = np.argsort(self.intensity, kind="stable")  # the last one written wins
        picture[self.y[upwards], self.x[upwards]] = getattr(self, name)[upwards]
        return picture


def depth(
    frames: Frames,
    camera: Camera | None = None,
    detection: Detection | None = None,
    pulse: Pulse | None = None,
) -> Returns:
    """Find each pixel's returns in a transient cube.

    Parameters
    ----------
    frames : Frames
        Brightness (time, y, x) on any increasing time axis. The source is co-located: range is ``c * time / 2``.
    camera : Camera, optional
        Takes the place of the camera inside `frames`.
    detection : Detection, optional
        What counts as a return.
    pulse : Pulse, optional
        Shape of a single return; by default a Gaussian as wide as ``camera.pulse_fwhm``. Two returns of similar
        strength are told apart from 1.3 widths on.

    Raises
    ------
    InputError
        Fewer than three frames, or a camera for another picture size.
    """
    camera = frames.camera if camera is None else camera
    detection = Detection() if detection is None else detection
    if camera.image_shape != frames.values.shape[1:]:
        raise ShapeError("frames", f"(time, y, x) with (y, x) = {camera.image_shape}", frames.values.shape)
    if frames.times.size < 3:
        raise InputError(f"a return needs at least three frames to be found in, got {frames.times.size}")
    if pulse is None:
        pulse = Pulse.gaussian(max(camera.pulse_fwhm, SHORTEST_PULSE_BINS * frames.bin_width))
    pixel, time, signal, deviation = _listed(*_search(frames, pulse, detection))
    distance = SPEED_OF_LIGHT * time / 2
    intensity = signal * (distance / REFERENCE_RANGE) ** 2
    kept = (time > 0) & detection.significant(pixel, time, intensity, pulse.fwhm)
    y, x = np.divmod(pixel[kept], camera.image_shape[1])
    return Returns(
        y=y.astype(np.int32),
        x=x.astype(np.int32),
        range=distance[kept],
        intensity=intensity[kept].astype(np.float32),
        confidence=(SPEED_OF_LIGHT * deviation[kept] / 2).astype(np.float32),
        return_number=_rank_within(pixel[kept]),
        time=time[kept],
        camera=camera,
        shear=np.interp(time[kept], frames.times, frames.shears),
        provenance=frames.provenance,
    )


def _search(frames: Frames, pulse: Pulse, detection: Detection) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Candidates of every pixel: (pixels, most returns, 3) of instant, counts, deviation, and how many are filled."""
    from tofclip.lidar.kernels import find_returns

    traces = frames.values.reshape(frames.times.size, -1).astype(np.float32, copy=False)
    pixels = traces.shape[1]
    found = np.empty((pixels, detection.most_returns, 3))
    counts = np.empty(pixels, np.int64)
    sharp, matched = (_filters(frames.times, shape) for shape in (pulse.compressed(SHARPENING), pulse))
    shape = (pulse.samples, pulse.slope, pulse.spacing, pulse.origin, *pulse.support)
    limits = (pulse.fwhm, float(detection.signal_to_noise), float(detection.share_of_pixel))

    def work(piece: slice) -> None:
        block = np.ascontiguousarray(traces[:, piece].T)
        find_returns(block, frames.times, sharp, matched, shape, limits, found[piece], counts[piece])

    run_blocks(work, pixels, PIXELS_PER_BLOCK)
    return found, counts


def _filters(times: NDArray[np.float64], pulse: Pulse) -> NDArray[np.float32]:
    """Unit-energy filter for a return at each bin, (width, bins); the time axis may be uneven.

    Where the axis cuts off most of the pulse the energy stays below one: little would be known of such a return.
    """
    before, after = pulse.support
    half = int(np.ceil(max(-before, after) / np.diff(times).min()))
    filters = np.zeros((2 * half + 1, times.size))
    for row, shift in enumerate(range(-half, half + 1)):
        here = np.arange(max(0, -shift), min(times.size, times.size - shift))
        filters[row, here] = pulse(times[here + shift] - times[here])
    energy = np.sum(filters**2, axis=0)
    filters /= np.sqrt(np.maximum(energy, np.median(energy) / 2))
    return filters.astype(np.float32)


def _listed(
    found: NDArray[np.float64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Turn padded candidates into pixel number, instant, counts and deviation, in raster and time order."""
    filled = np.arange(found.shape[1]) < counts[:, np.newaxis]
    pixel = np.nonzero(filled)[0]
    time, signal, deviation = np.moveaxis(found[filled], -1, 0)
    order = np.lexsort((time, pixel))
    return pixel[order], time[order], signal[order], deviation[order]


def _rank_within(pixel: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Number the entries of each pixel from 1; equal pixels lie side by side."""
    position = np.arange(pixel.size)
    starts_here = np.r_[True, pixel[1:] != pixel[:-1]][: pixel.size]
    start = np.maximum.accumulate(np.where(starts_here, position, 0))
    return (position - start + 1).astype(np.uint8)
