"""Surfaces instead of frames: range and amplitude of every pixel from the whole shot at once.

A frame is a thin slice through surfaces, often a ring or a sliver, which no prior on pictures fits.
Here the prior is on the surfaces. Surface k has a range r_k(p), its inverse depth a quadratic over the picture, and an
amplitude a_k(p) >= 0; the raw streak image is

    y = sum_k sum_p a_k(p) g_v s_v(p, r_k(p)) h(t - 2 r_k(p) / c),

with the gains g_v of the views, the place s_v of the pixel on the slit at the shear of its range,
and the pulse h. With photon weights w the objective is

    J(a, r) = 1/2 |A(r) a - y|^2_w + weight * sum_k TV(a_k).

Surfaces come from a fast recovery of frames (`tofclip.recovery.surface_patches`) and reach beyond
their returns, since the data of a range window decide where a surface ends. Amplitudes are solved
for by FISTA with a step size for each surface; ranges, gains, delays and pulse widths of the views
by Gauss-Newton steps, each taken only if it lowers the misfit. docs/recovery_algorithm.md derives it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.camera import Camera, estimate_dark_level, measure
from tofclip.errors import InputError
from tofclip.lidar import Detection, Returns, compute_ray_directions, depth
from tofclip.recovery.surface_patches import COEFFICIENTS, Patch, evaluate_monomials, find_patches
from tofclip.shots import Frames, Streak
from tofclip.solvers import Method, Progress, Sparse, ignore_progress
from tofclip.threads import map_parallel, run_blocks, split_blocks, thread_count
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]

MARGIN_PX = 10  # how far a surface may reach beyond the returns that showed it
START_ITERATIONS = 40
REFINEMENTS, REFINEMENT_ITERATIONS = 3, 25
PROX_ITERATIONS = 6  # of the dual, which is kept from step to step
NORM_ITERATIONS = 10
NORM_MARGIN = 1.1
MODEL_ERROR_FRACTION = (
    0.015  # of the brightest measurement: what the model leaves even without noise
)
PULSE_ROWS = 11  # a pulse of 60 ps on rows of 20 ps reaches 3 of them to either side
EXTENT_SIGMAS = 3.5  # 5e-4 of a pulse lie outside
SLIT_PIXELS, SUBROWS = 4, 3
SMALLEST_STEP = 1 / 16  # of a Gauss-Newton step, halved until it lowers the misfit
WIDTH_STEP = 0.02  # relative; for the derivative by a pulse's width
MIN_SURFACE_SHARE = 0.5  # of the returns' light: below, the shot is not one of surfaces
POINTS_PER_BLOCK = 4096
MIN_INVERSE_DEPTH = 1e-3  # 1/m; a surface that bends away ends a kilometre off
SURE_SIGMAS = 20.0  # points of which a surface certainly consists
MIN_BRIGHTNESS_FRACTION = 0.25  # of the surface's usual brightness: light beside its border is less
NEIGHBOURHOOD_PX = 7  # side of the square whose measurements decide whether a point is there
FWHM_PER_SIGMA = 2 * np.sqrt(2 * np.log(2))


class _Shares(NamedTuple):
    """How the light of each surface point is spread over the raw image, (points, views, ...)."""

    first_row: NDArray[np.int32]
    time: Image
    slopes: Image
    first_column: NDArray[np.int32]
    slit: Image


@dataclass
class SurfaceState:
    """What is solved for.

    Parameters
    ----------
    coefficients : (surfaces, 6) float array
        Inverse depths, 1/m, over `evaluate_monomials`.
    gains : (views,) float array
    delays : (views,) float array
        Rows by which the views are later than the camera's sweep says.
    widths : (views,) float array
        Pulse widths, relative to the camera's.
    """

    coefficients: FloatArray
    gains: FloatArray
    delays: FloatArray
    widths: FloatArray


class SurfaceModel:
    """A(r): amplitudes of surface points to a raw streak image.

    Parameters
    ----------
    streak : Streak
    camera : Camera
        With its sweep.
    masks : (surfaces, rows, columns) bool array
        Where each surface may be.
    state : SurfaceState

    Notes
    -----
    Memory: 60 bytes for each point and view, and two raw images for each thread.
    """

    def __init__(
        self, streak: Streak, camera: Camera, masks: NDArray[np.bool_], state: SurfaceState
    ) -> None:
        self.camera, self.masks = camera, masks
        self.bin_width = float(np.mean(np.diff(streak.times)))
        self.start = float(streak.times[0])
        dark = estimate_dark_level(streak.counts)
        self.image = (streak.counts - np.float32(dark)).astype(np.float32)
        smooth = np.maximum(scipy.ndimage.gaussian_filter(streak.counts.astype(np.float32), 1.0), 0)
        # The variance of a measurement is its photons; the floor stands for what the model cannot explain.
        weights = 1 / (smooth + MODEL_ERROR_FRACTION * smooth.max() + max(dark, 0.0))
        if streak.saturated is not None:
            weights[streak.saturated] = 0
        weights[:, camera.dead_columns] = 0
        self.weights = weights.astype(np.float32)
        self.surface, y, x = np.nonzero(masks)
        self.pixel = y * masks.shape[2] + x
        self.monomials = evaluate_monomials(self.pixel, camera.image_shape)
        self._directions = compute_ray_directions(camera, y, x)
        self._ray_length = 1 / self._directions[:, 2]
        axis_row, axis_column = camera.optical_axis_px
        self._across = (x - axis_column)[:, np.newaxis] - (y - axis_row)[:, np.newaxis] * np.tan(
            camera.angles
        )
        self.place(state)

    @property
    def distance(self) -> FloatArray:
        """Range of every point, m."""
        inverse = (self.monomials * self.state.coefficients[self.surface]).sum(axis=1)
        distance: FloatArray = self._ray_length / np.maximum(inverse, MIN_INVERSE_DEPTH)
        return distance

    @property
    def distance_slopes(self) -> FloatArray:
        """Derivative of each point's range by its surface's coefficients, (points, 6), m^2."""
        by_inverse = -(self.distance**2) / self._ray_length
        slopes: FloatArray = by_inverse[:, np.newaxis] * self.monomials
        return slopes

    def place(self, state: SurfaceState) -> None:
        """Move the surfaces to where `state` has them."""
        self.state = state
        self._row, position, self.stretch = self._locate()
        first_row, time, slopes = self._spread(state.widths)
        count, views = position.shape
        first_column = np.empty((count, views), np.int32)
        slit = np.empty((count, views, SLIT_PIXELS), np.float32)
        from tofclip.recovery.surface_kernels import split_over_slit

        split_over_slit(position, np.tan(self.camera.angles), SUBROWS, first_column, slit)
        self._shares = _Shares(first_row, time, slopes, first_column, slit)

    def _locate(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Raw row and column of every point in every view, and raw rows per instant there."""
        camera, distance = self.camera, self.distance
        points = self._directions * distance[:, np.newaxis]
        views = np.zeros((camera.views, 3))
        views[:, 0] = camera.lenslet_pitch * camera.view_positions
        back = np.linalg.norm(points[:, np.newaxis] - views, axis=2)
        time = (distance[:, np.newaxis] + back) / SPEED_OF_LIGHT + camera.time_zero - self.start
        shear = camera.shear_at(points[:, 2])
        slit = camera.centres_px + self._across + shear[:, np.newaxis] * camera.view_positions
        row = time / self.bin_width
        if camera.sweep is None:
            return row + self.state.delays, slit, np.ones_like(row)
        raw_row, raw_column = camera.sweep.raw_position(row, slit)
        later, _ = camera.sweep.raw_position(row + 0.5, slit)
        earlier, _ = camera.sweep.raw_position(row - 0.5, slit)
        return raw_row + self.state.delays, np.asarray(raw_column, np.float64), later - earlier

    def _spread(self, widths: FloatArray) -> tuple[NDArray[np.int32], Image, Image]:
        """Shares of the pulse on rows, for pulses of some widths."""
        from tofclip.recovery.surface_kernels import split_over_time

        sigma = self.camera.pulse_fwhm / FWHM_PER_SIGMA / self.bin_width * self.stretch
        first = np.empty(self._row.shape, np.int32)
        # wide enough for pulses that turn out a fifth longer than the camera's
        reach = max(PULSE_ROWS, 2 * int(np.ceil(1.2 * EXTENT_SIGMAS * sigma.max() + 0.5)) + 1)
        shares = np.empty((*self._row.shape, reach), np.float32)
        slopes = np.empty_like(shares)
        split_over_time(self._row, sigma * widths, first, shares, slopes)
        return first, shares, slopes

    def render(self, amplitude: Image, gains: FloatArray, time: Image | None = None) -> Image:
        """Return the raw image of surface points, (rows, columns).

        Parameters
        ----------
        amplitude : (points,) float32 array
        gains : (views,) float array
        time : (points, views, reach) float32 array, optional
            Other shares along time than the pulse's.
        """
        from tofclip.recovery.surface_kernels import add_light

        shares = self._shares
        profile = shares.time if time is None else time

        def part(block: slice) -> Image:
            image = np.zeros(self.image.shape, np.float32)
            add_light(
                amplitude[block],
                gains,
                shares.first_row[block],
                profile[block],
                shares.first_column[block],
                shares.slit[block],
                image,
            )
            return image

        size = max(1, -(-amplitude.size // thread_count()))
        total = np.zeros(self.image.shape, np.float32)
        for image in map_parallel(part, split_blocks(amplitude.size, size)):
            total += image
        return total

    def gather(self, image: Image, squared: bool = False) -> Image:
        """Return A' of an image, (points,); squared: with the squares of all entries."""
        from tofclip.recovery.surface_kernels import gather_light

        shares, found = self._shares, np.empty(self.surface.size, np.float32)
        power = 2 if squared else 1

        def work(block: slice) -> None:
            gather_light(
                image,
                self.state.gains**power,
                shares.first_row[block],
                shares.time[block] ** power if squared else shares.time[block],
                shares.first_column[block],
                shares.slit[block] ** power if squared else shares.slit[block],
                found[block],
            )

        run_blocks(work, found.size, POINTS_PER_BLOCK)
        return found

    def misfit(self, amplitude: Image) -> float:
        """Half the weighted squared misfit."""
        error = self.render(amplitude, self.state.gains) - self.image
        return float(np.sum(self.weights * error**2, dtype=np.float64)) / 2

    def iterate_derivatives(self, amplitude: Image) -> Iterator[tuple[str, int, Image]]:
        """Yield the image's derivative by each unknown of the state: what it is of, which, image."""
        gains = self.state.gains
        by_range = (self._shares.slopes * self.stretch[..., np.newaxis]).astype(np.float32)
        rows_per_metre, slopes = 2 / SPEED_OF_LIGHT / self.bin_width, self.distance_slopes
        for surface in range(len(self.masks)):
            own = amplitude * (self.surface == surface) * rows_per_metre
            for number in range(COEFFICIENTS):
                moved = (own * slopes[:, number]).astype(np.float32)
                image = self.render(moved, gains, by_range)
                yield "coefficients", surface * COEFFICIENTS + number, image
        _, wider, _ = self._spread(self.state.widths * (1 + WIDTH_STEP))
        for view in range(gains.size):
            alone = np.where(np.arange(gains.size) == view, gains, 0.0)
            plain = self.render(amplitude, alone)
            yield "gains", view, plain
            yield "delays", view, self.render(amplitude, alone, self._shares.slopes)
            yield "widths", view, (self.render(amplitude, alone, wider) - plain) / WIDTH_STEP


class AmplitudeSolver:
    """FISTA for the amplitudes, a step size for each surface.

    Different surfaces hardly share measurements, so that a step for each is as safe as one for all and
    does not hold the bright ones back.

    Parameters
    ----------
    model : SurfaceModel
    amplitude : (points,) float32 array
        Start.
    weight : float
        Of total variation.
    """

    def __init__(self, model: SurfaceModel, amplitude: Image, weight: float) -> None:
        self.model, self.amplitude, self.weight = model, amplitude, weight
        self._dual = np.zeros((len(model.masks), 2, *model.camera.image_shape), np.float32)

    def run(self, iterations: int, progress: Progress, frames: int) -> None:
        """Take some steps; `progress` hears of `frames` after each."""
        model = self.model
        steps = 1 / (NORM_MARGIN * self._estimate_norms())
        step = steps[model.surface].astype(np.float32)
        ahead, age = self.amplitude, 1.0
        for _ in range(iterations):
            error = model.render(ahead, model.state.gains) - model.image
            moved = self._shrink(ahead - step * model.gather(model.weights * error), steps)
            if np.sum((ahead - moved) * (moved - self.amplitude)) > 0:
                age = 1.0  # the momentum points uphill (O'Donoghue and Candes, 2015)
            older = (1 + np.sqrt(1 + 4 * age**2)) / 2
            ahead = moved + np.float32((age - 1) / older) * (moved - self.amplitude)
            self.amplitude, age = moved, older
            progress(frames)

    def _estimate_norms(self) -> FloatArray:
        """Largest eigenvalue of A'WA for each surface, by power iteration."""
        model, count = self.model, len(self.model.masks)
        vector, norms = np.ones(model.surface.size, np.float32), np.ones(count)
        for _ in range(NORM_ITERATIONS):
            vector = model.gather(model.weights * model.render(vector, model.state.gains))
            norms = np.sqrt(np.bincount(model.surface, vector.astype(np.float64) ** 2, count))
            norms = np.maximum(norms, 1e-3 * norms.max())
            vector /= norms[model.surface].astype(np.float32)
        return norms

    def _shrink(self, amplitude: Image, steps: FloatArray) -> Image:
        """The proximal step of total variation on each surface."""
        from tofclip.recovery.surface_kernels import prox_masked_tv

        masks = self.model.masks
        pictures, found = np.zeros(masks.shape, np.float32), np.empty(masks.shape, np.float32)
        pictures[masks] = amplitude

        def work(block: slice) -> None:
            for one in range(block.start, block.stop):
                prox_masked_tv(
                    pictures[one],
                    masks[one],
                    self.weight * steps[one],
                    PROX_ITERATIONS,
                    self._dual[one],
                    found[one],
                )

        run_blocks(work, len(masks), 1)
        shrunk: Image = found[masks]
        return shrunk


def refine_state(model: SurfaceModel, amplitude: Image) -> FloatArray:
    """Take a Gauss-Newton step on ranges, gains, delays and pulse widths, if it lowers the misfit.

    Parameters
    ----------
    model : SurfaceModel
        Moved in place. The mean gain and the mean delay stay.
    amplitude : (points,) float32 array

    Returns
    -------
    (surfaces, 6, 6) float array
        Covariance of each surface's coefficients: the inverse of the data's Fisher information,
        gains, delays and widths unknown, times the misfit per measurement where that exceeds 1.
    """
    state, before = model.state, model.misfit(amplitude)
    lit = model.render(amplitude, state.gains).max(axis=1) > 0
    weights = model.weights[lit].ravel()
    names, columns = [], []
    for name, number, image in model.iterate_derivatives(amplitude):
        names.append((name, number))
        columns.append(image[lit].ravel())
    jacobian = np.stack(columns)
    error = (model.image - model.render(amplitude, state.gains))[lit].ravel()
    normal = ((jacobian * weights) @ jacobian.T).astype(np.float64)
    # A delay of all views is a range of all surfaces: the mean delay is pinned to zero.
    delays = np.array([name == "delays" for name, _ in names])
    normal[np.ix_(delays, delays)] += np.diag(normal)[delays].max()
    scale = np.sqrt(np.diag(normal)) + np.finfo(np.float32).tiny
    inverse = np.linalg.inv(normal / np.outer(scale, scale) + 1e-6 * np.eye(scale.size))
    inverse /= np.outer(scale, scale)
    change = inverse @ (jacobian @ (weights * error)).astype(np.float64)
    step = 1.0
    while step >= SMALLEST_STEP:
        model.place(_move(state, names, step * change))
        if model.misfit(amplitude) < before:
            break
        step /= 2
    else:
        model.place(state)
    excess = max(1.0, float(np.sum(weights * error**2) / max(np.count_nonzero(weights), 1)))
    size = COEFFICIENTS * len(state.coefficients)
    blocks = inverse[:size, :size].reshape(-1, COEFFICIENTS, len(state.coefficients), COEFFICIENTS)
    own = np.arange(len(state.coefficients))
    covariance: FloatArray = excess * blocks[own, :, own, :]
    return covariance


def _move(state: SurfaceState, names: list[tuple[str, int]], change: FloatArray) -> SurfaceState:
    """The state after a step; gains and widths change relatively, the mean gain stays."""
    moved = SurfaceState(
        state.coefficients.copy(), state.gains.copy(), state.delays.copy(), state.widths.copy()
    )
    for (name, number), value in zip(names, change, strict=True):
        values = getattr(moved, name).reshape(-1)
        values[number] += value * (values[number] if name in ("gains", "widths") else 1.0)
    moved.gains *= state.gains.mean() / moved.gains.mean()
    return moved


@dataclass(frozen=True)
class SurfaceRecovery:
    """Surfaces from a whole shot, and frames as their rendering.

    Parameters
    ----------
    weight : float
        Of total variation of the amplitudes, in photons' units: 1 is a count of a measurement whose
        variance is 1.
    iterations : int
        Of FISTA after the ranges are known; before that there are 115 more.
    start : Method
        Recovers the frames in whose returns the surfaces are looked for.
    detection : Detection
        Which points of the surfaces are returned.

    Notes
    -----
    Right for shots of surfaces: smoke, light in flight and relay walls stay with frames. Views are
    taken to see the same surfaces: what one hides from a view but not from another is not modelled.
    """

    weight: float = 0.15
    iterations: int = 60
    start: Method = field(default_factory=lambda: Sparse(iterations=40))
    detection: Detection = field(default_factory=Detection)
    name = "surfaces"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.weight) and self.weight > 0 and self.iterations >= 1):
            raise InputError("surfaces need a positive weight and at least one iteration")

    @property
    def steps(self) -> int:
        """All iterations of FISTA."""
        return START_ITERATIONS + REFINEMENTS * REFINEMENT_ITERATIONS + self.iterations

    def work(self, frames: int) -> int:
        """Frame iterations that are reported: the start's, and one per frame and iteration."""
        return self.start.work(frames) + self.steps * frames

    def recover_surfaces(
        self, streak: Streak, frames: Frames, progress: Progress = ignore_progress
    ) -> Frames:
        """Recover the surfaces of a shot.

        Parameters
        ----------
        streak : Streak
        frames : Frames
            A fast recovery of the same shot, with the camera to use.
        progress : callable
            Called with the number of frame iterations just done.

        Returns
        -------
        Frames
            With ``.returns``.

        Raises
        ------
        InputError
            Most of the light does not come from surfaces.
        """
        camera, count = frames.camera, frames.times.size
        found = depth(frames)
        bin_m = SPEED_OF_LIGHT * frames.bin_width / 2
        directions = compute_ray_directions(camera, *np.indices(camera.image_shape).reshape(2, -1))
        ray_length = (1 / directions[:, 2]).reshape(camera.image_shape)
        patches = find_patches(found.image("range").astype(np.float64), ray_length, bin_m)
        _require_surfaces(found, patches)
        masks = np.zeros((len(patches), *camera.image_shape), bool)
        pictures = np.zeros(masks.shape, np.float32)
        brightness = frames.values.sum(axis=0).ravel()
        for patch, mask, picture in zip(patches, masks, pictures, strict=True):
            mask.ravel()[patch.pixels] = True
            picture.ravel()[patch.pixels] = brightness[patch.pixels]
            mask[...] = scipy.ndimage.binary_dilation(mask, np.ones((3, 3)), MARGIN_PX)
        state = SurfaceState(
            np.stack([patch.coefficients for patch in patches]),
            camera.gains.copy(),
            np.zeros(camera.views),
            np.ones(camera.views),
        )
        model = SurfaceModel(streak, camera, masks, state)
        solver = AmplitudeSolver(model, pictures[masks], self.weight)
        solver.run(START_ITERATIONS, progress, count)
        for _ in range(REFINEMENTS):
            covariance = refine_state(model, solver.amplitude)
            solver.run(REFINEMENT_ITERATIONS, progress, count)
        solver.run(self.iterations, progress, count)
        return self._make_frames(frames, model, solver.amplitude, covariance)

    def _make_frames(
        self, start: Frames, model: SurfaceModel, amplitude: Image, covariance: FloatArray
    ) -> Frames:
        camera = model.camera.replace(gains=model.state.gains)
        # Rectified like every other method's: its residual is of measurements, not of raw pixels.
        rendered = model.render(amplitude, model.state.gains)
        predicted, measured = (
            measure(image, model.weights == 0, model.camera, 0.0)
            for image in (rendered, model.image)
        )
        error = (predicted.values - measured.values)[measured.valid]
        residual = float(np.linalg.norm(error) / np.linalg.norm(measured.values[measured.valid]))
        distance = np.maximum(SPEED_OF_LIGHT * start.times / 2, start.bin_width * SPEED_OF_LIGHT)
        figures: dict[str, Any] = {
            "method": self.name,
            "focus": "depth-locked",
            "iterations": self.steps,
            "stopped_because": "iteration limit",
            "relative_residual": residual,
            "surfaces": len(model.masks),
        }
        return replace(
            start,
            values=_render_frames(start, model, amplitude),
            camera=camera,
            figures={**start.figures, **figures},
            shears=np.asarray(camera.shear_at(distance)),
            returns=self._list_returns(model, camera, amplitude, covariance),
        )

    def _list_returns(
        self, model: SurfaceModel, camera: Camera, amplitude: Image, covariance: FloatArray
    ) -> Returns:
        """Points that stand out of the noise and of their neighbourhood, pixel by pixel."""
        distance = model.distance
        # A pixel alone is hardly above the photons' noise: its neighbours on the surface, which the
        # prior ties to it, count as well.
        information = np.zeros(model.masks.shape, np.float32)
        information[model.masks] = model.gather(model.weights, squared=True)
        pooled = NEIGHBOURHOOD_PX**2 * scipy.ndimage.uniform_filter(
            information, (0, NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX), mode="constant"
        )
        significance = amplitude * np.sqrt(pooled[model.masks])
        own = covariance[model.surface]
        slopes = model.distance_slopes
        variance = np.einsum("pi,pij,pj->p", slopes, own, slopes)
        # The sweep's time zero is one view's; the views' delays say how well each is known.
        zero = np.std(model.state.delays) * model.bin_width * SPEED_OF_LIGHT / 2
        intensity = amplitude * distance**2
        usual = np.zeros(len(model.masks))
        for one in range(usual.size):
            sure = amplitude[(model.surface == one) & (significance > SURE_SIGMAS)]
            usual[one] = np.median(sure) if sure.size else np.inf  # no point of it is sure
        bright = np.flatnonzero(
            (significance > self.detection.signal_to_noise)
            & (amplitude > MIN_BRIGHTNESS_FRACTION * usual[model.surface])
        )
        strong = self.detection.find_significant(
            model.pixel[bright],
            2 * distance[bright] / SPEED_OF_LIGHT,
            intensity[bright],
            camera.pulse_fwhm,
        )
        chosen = bright[strong]
        chosen = chosen[np.lexsort((distance[chosen], model.pixel[chosen]))]
        y, x = np.divmod(model.pixel[chosen], camera.image_shape[1])
        starts = np.flatnonzero(np.diff(model.pixel[chosen], prepend=-1))
        rank = np.arange(chosen.size) - np.repeat(starts, np.diff(starts, append=chosen.size)) + 1
        return Returns(
            y=y.astype(np.int32),
            x=x.astype(np.int32),
            range=distance[chosen],
            intensity=intensity[chosen].astype(np.float32),
            confidence=np.sqrt(np.maximum(variance[chosen], 0) + zero**2).astype(np.float32),
            return_number=rank.astype(np.uint8),
            time=2 * distance[chosen] / SPEED_OF_LIGHT,
            camera=camera,
            shear=np.asarray(camera.shear_at(distance[chosen])),
        )


def _require_surfaces(found: Returns, patches: list[Patch]) -> None:
    """Refuse a shot whose light does not come from surfaces."""
    on_surface = np.zeros(found.camera.image_shape, bool)
    for patch in patches:
        on_surface.ravel()[patch.pixels] = True
    light = float(found.intensity.sum())
    share = float(found.intensity[on_surface[found.y, found.x]].sum()) / light if light else 0.0
    if share < MIN_SURFACE_SHARE:
        raise InputError(
            f"only {100 * share:.0f} % of this shot's light comes from surfaces; choose "
            '`method="tv"`'
        )


def _render_frames(start: Frames, model: SurfaceModel, amplitude: Image) -> Image:
    """The surfaces as a reference view without blur would see them over time."""
    from tofclip.recovery.surface_kernels import split_over_time

    lit = np.flatnonzero(amplitude)
    row = (2 * model.distance[lit] / SPEED_OF_LIGHT - start.times[0]) / start.bin_width
    sigma = model.camera.pulse_fwhm / FWHM_PER_SIGMA / start.bin_width
    reach = 2 * int(np.ceil(EXTENT_SIGMAS * sigma + 0.5)) + 1
    first = np.empty((lit.size, 1), np.int32)
    shares = np.empty((lit.size, 1, reach), np.float32)
    width = np.full((lit.size, 1), sigma)
    split_over_time(row[:, np.newaxis], width, first, shares, np.empty_like(shares))
    rows = first + np.arange(reach)
    values = np.zeros(start.values.shape, np.float32)
    flat = values.reshape(len(values), -1)
    inside = (rows >= 0) & (rows < len(values))
    pixel = np.broadcast_to(model.pixel[lit][:, np.newaxis], rows.shape)
    light = amplitude[lit][:, np.newaxis] * shares[:, 0]
    np.add.at(flat, (rows[inside], pixel[inside]), light[inside])
    return values
