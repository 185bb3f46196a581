"""The search for returns: from each pixel's brightness over time to when light came back, how much,
and how surely.

A recovered frame is not a photon count: it went through an inverse problem, whose errors are spread
over pixels and bins and are nearly even in time. For such errors the least-squares fit of the pulse
is the maximum-likelihood estimate, so candidates are judged by the matched filter and refined by
Gauss-Newton steps of that fit, below a bin. Histograms of counted photons are for
`tofclip.lidar.photons`, whose estimator is the maximum-likelihood one there.

The steps, for each pixel (`tofclip.lidar.trace_search` takes some of them at once):

1. Filter the trace with a pulse compressed to half its width, which still shows two returns where
   the matched filter would merge them; its local maxima are the candidates.
2. Take candidates from the strongest down (`take_strongest_peaks`). Each claims the bins that its
   pulse reaches; background and noise are those of the bins that nothing claims.
3. Keep those that the matched filter confirms against noise and the pixel's strongest return, and
   place them below a bin (`confirm_peaks`).
4. Fit arrival and height by Gauss-Newton steps on one return at a time, each against what the
   others leave: on an even time axis by a table of the pulse (`fit_returns`), elsewhere exactly
   (`fit_returns_exactly`).
5. Measure what the fit confirms: sum over the bins and the arrival's standard deviation
   (`measure_returns_by_table`).
6. Add the recovery's own errors to the deviation, by what neighbours show (`add_recovery_error`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from tofclip.arrays import Float32Array, FloatArray, IntArray, to_numpy
from tofclip.camera import Camera
from tofclip.camera.model import compute_ray_directions
from tofclip.camera.noise import MeasurementNoise
from tofclip.errors import InputError, ShapeError, require, require_type
from tofclip.lidar.pulse import PictureTraces, Pulse, PulseFilters, TraceBins, Traces
from tofclip.lidar.range_calibration import correct_returns
from tofclip.lidar.significance import (
    CANDIDATES,
    DEFAULT_FALSE_ALARM,
    Detection,
    EvidenceJudge,
    join_candidates,
)
from tofclip.shots import Frames, Returns, number_returns
from tofclip.threads import run_blocks, split_blocks
from tofclip.units import SPEED_OF_LIGHT

BATCH_BYTES, MAX_PIXELS_PER_BATCH = 1 << 19, 512  # traces that fit the second-level cache
# the response at the bin of a peak is up to 5 % below that at its top, and the fit makes up for more
SAMPLE_THRESHOLD_FACTOR = 0.85
MIN_SAMPLED_BATCHES, SAMPLING_STEP = 32, 7  # odd, or all of a sample might lie in one column
# Of counted photons: a histogram's length at least, in bins and pulses, returns of a pixel at most,
# and how often one is announced where there is none.
MIN_COUNTED_BINS, MIN_COUNTED_PULSES = 16, 10.0
MAX_COUNTED_RETURNS, DEFAULT_COUNTED_ALARM = 3, 0.01
MIN_PULSE_BINS = 2.0  # anything shorter falls between the samples


class ReturnSearch:
    """What stays the same from shot to shot in the search for returns. `times` (time,): time of
    flight of each frame, s, increasing; `pulse`: shape of a single return, by default a Gaussian as
    wide as ``camera.pulse_fwhm``. Two returns of similar strength are separated from 1.3 widths on;
    `shears` (time,): shear at which each frame is recovered, pixels per view step; 0 by default.
    """

    def __init__(
        self,
        camera: Camera,
        times: FloatArray,
        detection: Detection | None = None,
        pulse: Pulse | None = None,
        shears: FloatArray | None = None,
    ) -> None:
        if times.size < 3:
            raise InputError(
                f"a return needs at least three frames to be found in, got {times.size}"
            )
        shortest = MIN_PULSE_BINS * float(times[-1] - times[0]) / (times.size - 1)
        self.camera, self.times = camera, times
        self.detection = Detection() if detection is None else detection
        self.pulse = Pulse.gaussian(max(camera.pulse_fwhm, shortest)) if pulse is None else pulse
        self.shears = np.zeros(times.size) if shears is None else shears

    def find_returns(
        self,
        traces: Traces,
        provenance: Mapping[str, Any] | None = None,
        judge: EvidenceJudge | None = None,
    ) -> Returns:
        """Find the returns in the traces of all pixels. `judge` decides which candidates count; by
        default the fractions of `Detection`. Takes 256 KiB of traces a thread, and 100 bytes a
        pixel.
        """
        # the compiler takes as long to import as all else
        from tofclip.lidar.neighbours import add_recovery_error

        pixel, found = self._find_candidates(traces, judge is not None)
        doubt = np.empty(0)
        if judge is not None:
            pixel, found = join_candidates(judge.frames, self.pulse, pixel, found)
            doubt = judge.judge(pixel, *found[:2])
            kept = doubt <= judge.max_false_alarm
        time, signal, deviation = found
        intensity = signal * _square_distance(time)
        if judge is None:
            kept = self.detection.find_significant(pixel, time, intensity, self.pulse.fwhm)
        kept &= time > 0
        chosen = np.flatnonzero(kept)
        pixel, time = pixel.take(chosen), time.take(chosen)
        y, x = np.divmod(pixel.astype(np.int32), np.int32(self.camera.image_shape[1]))
        distance = SPEED_OF_LIGHT / 2 * time
        sigma = add_recovery_error(
            SPEED_OF_LIGHT / 2 * deviation.take(chosen),
            distance,
            self._along_axis.take(pixel),
            pixel,
            self.camera.image_shape,
            SPEED_OF_LIGHT / 2 * self.pulse.fwhm,
        )
        shear = np.full(time.size, self.shears[0])
        # looking up every instant takes longer than placing it in space
        if np.ptp(self.shears) > 0:
            shear = np.interp(time, self.times, self.shears)
        return correct_returns(
            Returns(
                y=y,
                x=x,
                range=distance,
                intensity=intensity.take(chosen).astype(np.float32),
                confidence=sigma.astype(np.float32),
                return_number=number_returns(pixel),
                time=time,
                camera=self.camera,
                shear=shear,
                provenance={} if provenance is None else provenance,
                false_alarm=doubt[kept] if doubt.size else doubt,
            )
        )

    @cached_property
    def _along_axis(self) -> FloatArray:
        """Depth along the optical axis for a range of 1, of every pixel."""
        rows, columns = np.indices(self.camera.image_shape).reshape(2, -1)
        return np.ascontiguousarray(compute_ray_directions(self.camera, rows, columns)[:, 2])

    @property
    def reach_bins(self) -> int:
        """How many bins on either side of a return its search and its fit look at."""
        # the responses of a peak's neighbours tell where its top is
        return max(len(self._filters.matched) // 2 + 1, self._filters.table.half)

    @cached_property
    def _filters(self) -> PulseFilters:
        return PulseFilters.build(self.pulse, self.times)

    def _find_candidates(self, traces: Traces, judged: bool) -> tuple[IntArray, FloatArray]:
        """Pixel number of every candidate, and (3, n) instants, counts and deviations, in raster
        and time order. Unless all candidates are `judged`, those that are too weak beside what a
        sample of the pixels shows are not fitted.
        """
        # the compiler takes as long to import as all else
        from tofclip.lidar.trace_search import TraceSearch

        times = self.times[traces.bins.numbers]
        size = min(max(BATCH_BYTES // (4 * times.size), 1), MAX_PIXELS_PER_BATCH)
        batches = list(split_blocks(traces.pixels.size, size))
        loops = TraceSearch(times, traces, self._filters, self.detection, size)

        def search(chosen: list[slice]) -> None:
            run_blocks(lambda piece: loops.find_returns(chosen[piece]), len(chosen), 1)

        if judged or len(batches) < MIN_SAMPLED_BATCHES:
            search(batches)
        else:
            search(batches[::SAMPLING_STEP])
            loops.set_least(self._compute_least_responses(*loops.list_found(), times, traces))
            search([one for place, one in enumerate(batches) if place % SAMPLING_STEP])
        return loops.list_found()

    def _compute_least_responses(
        self, pixel: IntArray, values: FloatArray, at: FloatArray, traces: Traces
    ) -> Float32Array:
        """Response of the matched filter, (bins,), below which no candidate can become a return.
        `pixel, values`: what was found in some of the pixels. Those of all pixels are brighter or
        as bright, so that nothing is lost.
        """
        if pixel.size == 0:
            return np.zeros(at.size, np.float32)
        time, signal, _ = values
        needed = self.detection.compute_least_intensity(
            pixel, time, signal * _square_distance(time), self.pulse.fwhm, at
        )
        # The response to a pulse is its sum, over that of the filter.
        tiny = np.finfo(np.float32).tiny
        sums = np.maximum(self._filters.sums[traces.bins.numbers], tiny)
        squares = np.maximum(_square_distance(at), tiny)
        least: Float32Array = SAMPLE_THRESHOLD_FACTOR * needed / (squares * sums)
        return least.astype(np.float32)


def depth(
    frames: Frames,
    camera: Camera | None = None,
    detection: Detection | None = None,
    pulse: Pulse | None = None,
    false_alarm: float | None = None,
) -> Returns:
    """Find each pixel's returns in a transient cube.

    Frames of a recovery with a prior know their measurements and how noisy these were: their returns
    are judged by that (`tofclip.lidar.significance`). Those of other frames, or where `detection` is
    given, are judged by its fractions.

    Frames that were made from surfaces carry their returns (``.returns``): where nothing else is given
    these are the answer, up to `false_alarm` as well. Found again in frames that hold no noise they
    would seem far too exact.

    Counted photons, whole numbers that a camera of one view saw (`Camera.pinhole`), are no recovered
    frames: their returns are found pixel by pixel by `tofclip.lidar.photons.estimate_pixels`, and
    deviations are those of photons.

    Parameters
    ----------
    frames : Frames
        Brightness (time, y, x) on any increasing time axis, fetched from the device where it is.
        The source is co-located: range is ``c * time / 2``.
    camera : Camera, optional
        Takes the place of the camera inside `frames`.
    detection, pulse
        As for `ReturnSearch`.
    false_alarm : float, optional
        Probability of being false, noise or spread by the recovery, up to which a candidate counts as a
        return; 0.1 by default. 1 keeps them all. Of counted photons the share of pixels without a
        return in which one is announced, 0.01 by default.

    Returns
    -------
    tofclip.lidar.Returns
        Range in m, intensity, and the range's standard deviation in m.

    Raises
    ------
    InputError
        Fewer than three frames, a camera for another picture size, or a probability of false alarms
        that is none, or for frames that do not know their measurements' noise.

    Examples
    --------
    >>> import numpy as np
    >>> import tofclip
    >>> camera = tofclip.Camera([20.0], [0.0], (16, 16), 41, pulse_fwhm=60e-12)
    >>> times = np.arange(100) * 10e-12
    >>> cube = np.zeros((100, 16, 16), np.float32)
    >>> cube[:, 3, 4] = np.exp(-0.5 * ((times - 400e-12) / 25.5e-12) ** 2)
    >>> returns = tofclip.depth(tofclip.Frames(cube, times, camera))
    >>> int(returns.y[0]), int(returns.x[0]), round(float(returns.range[0]), 4)
    (3, 4, 0.06)
    """
    require_type(frames, Frames, "returns are found in Frames, see tofclip.recover")
    require(
        false_alarm is None or 0 < false_alarm <= 1,
        f"the probability of a false alarm lies between 0 and 1, got {false_alarm}",
    )
    if frames.returns is not None and camera is None and detection is None and pulse is None:
        return keep_probable(frames.returns, false_alarm)
    camera = frames.camera if camera is None else camera
    if camera.image_shape != frames.values.shape[1:]:
        raise ShapeError(
            "frames", f"(time, y, x) with (y, x) = {camera.image_shape}", frames.values.shape
        )
    shape = Pulse.gaussian(camera.pulse_fwhm) if pulse is None else pulse
    if detection is None and _holds_counts(frames, shape):
        return _count_returns(frames, camera, shape, false_alarm)
    judged = detection is None and frames.measured.size > 0
    noise = MeasurementNoise.from_figures(frames.figures) if judged else None
    if noise is None and false_alarm is not None:
        raise InputError(
            "these frames do not hold their measurements and how noisy they were, as a probability of "
            "false alarms needs it: recover them again, by a method with a prior"
        )
    search = ReturnSearch(
        camera, frames.times, detection if noise is None else CANDIDATES, pulse, frames.shears
    )
    judge = None
    if noise is not None:
        limit = DEFAULT_FALSE_ALARM if false_alarm is None else false_alarm
        judge = EvidenceJudge(replace(frames, camera=camera), noise, search.pulse, limit)
    traces = PictureTraces(to_numpy(frames.values), TraceBins.all_bins(frames.times.size))
    return search.find_returns(traces, frames.provenance, judge)


def keep_probable(returns: Returns, false_alarm: float | None = None) -> Returns:
    """Return those that are false with a probability of `false_alarm`, 0.1 by default, at most."""
    limit = DEFAULT_FALSE_ALARM if false_alarm is None else false_alarm
    kept = returns[~(returns.false_alarm > limit)]
    pixel = kept.y.astype(np.int64) * kept.camera.image_shape[1] + kept.x
    return replace(kept, return_number=number_returns(pixel))


def _holds_counts(frames: Frames, pulse: Pulse) -> bool:
    """Whether frames are counted photons: whole numbers on an even axis of several pulses."""
    if frames.camera.views > 1 or frames.measured.size or len(frames) < MIN_COUNTED_BINS:
        return False
    steps = np.diff(frames.times)
    if steps.sum() < MIN_COUNTED_PULSES * pulse.fwhm:
        return False
    values = to_numpy(frames.values)
    whole = values.max() > 1 and values.min() >= 0 and not np.any(values != np.rint(values))
    return bool(whole and np.ptp(steps) < 1e-3 * steps.mean())


def _count_returns(
    frames: Frames, camera: Camera, pulse: Pulse, false_alarm: float | None
) -> Returns:
    from tofclip.lidar.photons import PhotonImage, estimate_pixels

    cube = np.moveaxis(to_numpy(frames.values), 0, -1)
    found = estimate_pixels(
        PhotonImage.from_cube(cube, frames.bin_width),
        pulse,
        DEFAULT_COUNTED_ALARM if false_alarm is None else false_alarm,
        max_returns=MAX_COUNTED_RETURNS,
    )
    # the frames' times are times of flight already
    found = found.calibrate(camera.replace(time_zero=0.0), float(frames.times[0]))
    return found.to_returns(camera, frames.provenance)


def _square_distance(time: FloatArray) -> FloatArray:
    """Square of the range of a return, m^2: an intensity is what its surface would send back from 1 m."""
    return (SPEED_OF_LIGHT / 2 * time) ** 2
