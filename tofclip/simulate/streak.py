"""Simulated streak images: a scene of bodies and one pulsed lamp, lenslets with a baseline, a sweep
and a detector that counts photons, in the order in which light goes through them; and what a
perfect instrument would see, with which returns are compared.

Nothing here uses the projection operator that recovery inverts: rays are cast from each lenslet,
and each ray's light is put on the slit where the ray falls and when it arrives.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from tofclip.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IndexArray
from tofclip.camera import Camera, SkewSweep
from tofclip.errors import require, require_shape
from tofclip.lidar import Returns
from tofclip.shots import Frames, Streak
from tofclip.simulate.bodies import (
    NO_BODY,
    Body,
    Lambertian,
    Rectangle,
    Vector,
    accumulate_cells,
    bin_by_time,
    cast_rays,
    compute_irradiance,
    look_up_reflectance,
    number_ray_pixels,
    spread_pulse,
)
from tofclip.simulate.patterns import (
    Pattern,
    make_checkerboard,
    make_letter,
    make_rings,
    make_stripes,
)
from tofclip.storage import collect_provenance
from tofclip.units import FWHM_PER_SIGMA, MAD_TO_SIGMA, SPEED_OF_LIGHT


def make_plate(
    centre: Vector,
    size: tuple[float, float],
    reflectance: ArrayLike,
    yaw: float = 0.0,
    pitch: float = 0.0,
) -> Body:
    """Return a flat, diffusely reflecting rectangle.

    Parameters
    ----------
    centre : (float, float, float)
        Position of its middle, m; x right, y down, z away from the camera.
    size : (float, float)
        Width and height, m.
    reflectance : (rows, columns) array
        Diffuse reflectance over the rectangle, 0..1, row 0 on top. NaN: cut out, light passes.
    yaw, pitch : float
        Turn about the vertical axis (positive: the right side goes back) and then about the plate's
        own horizontal axis (positive: the upper side goes back), rad. Both zero: facing the camera.

    Raises
    ------
    ShapeError, InputError
        A reflectance that is not a picture or lies outside 0..1, a size that is not positive, or
        nothing but holes.

    Examples
    --------
    >>> import numpy as np
    >>> plate = make_plate((0, 0, 2.0), (0.3, 0.2), np.full((1, 1), 0.8))
    >>> plate.intersect(np.zeros(3), np.array([[0.0, 0.0, 1.0]])).distance
    array([2.])
    """
    material = Lambertian(np.array(reflectance, dtype=np.float32))
    require(
        min(size) > 0 and np.all(np.isfinite([*centre, *size, yaw, pitch])),
        "a plate needs a finite position and a positive size",
    )
    right = np.array([np.cos(yaw), 0.0, np.sin(yaw)])
    # The plate is turned about the vertical first, so that its own horizontal axis stays level.
    ahead = np.array([-np.sin(yaw), 0.0, np.cos(yaw)])
    down = np.cos(pitch) * np.array([0.0, 1.0, 0.0]) - np.sin(pitch) * ahead
    # A right-handed frame; its third axis is the normal, which points away from the camera.
    axes = np.stack([right, down, np.cross(right, down)], axis=-1)
    return Body(Rectangle(*size), material, np.asarray(centre, np.float64), axes)


class RayCast(NamedTuple):
    """What the rays of one viewpoint see, ray by ray."""

    body: IndexArray  # number of the body; `NO_BODY` where the ray meets none
    # half of the path of the light from the lamp over the surface to the viewpoint, m
    path: FloatArray
    distance: FloatArray  # of the surface from the lamp, m
    reflectance: FloatArray  # diffuse, times the cosine of incidence; 0 in shadow


@dataclass(frozen=True)
class Scene:
    """`bodies` lit by one pulsed point source, the `lamp`, whose position, m, lies before them. At
    the origin it is co-located with the reference view, which then sees no shadow. `InputError`
    where there is no body.
    """

    bodies: tuple[Body, ...]
    lamp: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        require(self.bodies, "a scene needs at least one body")

    def trace(self, viewpoint: FloatArray, directions: FloatArray) -> RayCast:
        """Follow rays from (3,) `viewpoint`, m, along (n, 3) `directions`, all with z > 0, to the
        nearest surface and from there to the lamp.
        """
        first, lamp = cast_rays(self.bodies, viewpoint, directions), np.asarray(self.lamp)
        seen = first.body != NO_BODY
        # Only what is seen is lit: a missed ray has an infinite distance, which would spread as
        # NaN.
        points = viewpoint + first.distance[seen, np.newaxis] * directions[seen]
        lamp_distance = np.linalg.norm(points - lamp, axis=1)
        irradiance = compute_irradiance(self.bodies, lamp, points, first.normal[seen])

        def scatter(values: Any) -> FloatArray:
            spread = np.zeros(seen.shape)
            spread[seen] = values
            return spread

        return RayCast(
            first.body,
            # Half of the way there and back, which is what a time of flight says of a co-located
            # source.
            scatter((lamp_distance + np.linalg.norm(points - viewpoint, axis=1)) / 2),
            scatter(lamp_distance),
            # The fall-off to the lamp is taken out of the irradiance: who renders puts it back with
            # the whole path.
            look_up_reflectance(self.bodies, first) * scatter(irradiance * lamp_distance**2),
        )


@dataclass(frozen=True)
class StreakDetector:
    """The streak tube's screen, read out in photons: so many `rows` of `bin_width`, s. `peak_photons` are the
    expected signal of the brightest streak pixel, and set the exposure; `background_photons` come to
    every pixel; at `full_scale_photons` one saturates.
    """

    rows: int = 576
    bin_width: float = 20e-12
    peak_photons: float = 2000.0
    background_photons: float = 2.0
    full_scale_photons: float = 65535.0

    def __post_init__(self) -> None:
        require(
            self.rows >= 1 and self.bin_width > 0,
            f"a detector needs rows and a positive bin width, got {self.rows} and {self.bin_width}",
        )
        require(
            self.peak_photons > 0 <= self.background_photons and self.full_scale_photons > 0,
            "peak and full scale must be positive numbers of photons, the background not negative",
        )

    @property
    def row_times(self) -> FloatArray:
        """Instant of each row's middle on the streak's own time axis, s; the first is 0."""
        return np.arange(self.rows, dtype=np.float64) * self.bin_width

    def expose(
        self, signal: FloatArray, noise: np.random.Generator
    ) -> tuple[Float32Array, BoolArray]:
        """Draw one shot of an expected signal, (rows, columns), by `noise`, a generator:
        measurements in photons, none above full scale, and which of them saturated.
        """
        # Background is light as well, so that it brings photon noise of its own.
        photons = noise.poisson(signal + self.background_photons)
        saturated = photons >= self.full_scale_photons
        return np.minimum(photons, self.full_scale_photons).astype(np.float32), saturated


@dataclass(frozen=True)
class Instrument:
    """A `camera` and its `detector`; view k stands at ``x = lenslet_pitch * view_positions[k]``. A picture
    pixel is sampled by the square of `rays_per_pixel_side` rays.
    """

    camera: Camera
    detector: StreakDetector = field(default_factory=StreakDetector)
    rays_per_pixel_side: int = 4

    def __post_init__(self) -> None:
        require(
            self.rays_per_pixel_side >= 1,
            f"the number of rays must be positive, got {self.rays_per_pixel_side}",
        )

    def viewpoint(self, position: float) -> FloatArray:
        """Where the view at `position` view steps stands, m."""
        return np.array([self.camera.lenslet_pitch * position, 0.0, 0.0])

    def pixel_grid(self) -> tuple[FloatArray, FloatArray]:
        """X and Y of a picture's rays from the optical axis, in pixels, flat, in raster order."""
        side, camera = self.rays_per_pixel_side, self.camera
        # Middles of the sub-pixels; pixel centres are whole numbers, hence the half taken off.
        down, across = (
            (np.arange(pixels * side) + 0.5) / side - 0.5 - axis
            for pixels, axis in zip(camera.image_shape, camera.optical_axis_px, strict=True)
        )
        x, y = np.meshgrid(across, down)
        return x.ravel(), y.ravel()

    def look_at(self, scene: Scene, position: float = 0.0) -> RayCast:
        """Return what all rays of the view at `position` view steps see of a `scene`, in `pixel_grid`'s order."""
        return scene.trace(self.viewpoint(position), self.directions(*self.pixel_grid(), position))

    def directions(self, x: FloatArray, y: FloatArray, position: float = 0.0) -> FloatArray:
        """Directions (n, 3), with z = 1, in which the view at `position` view steps sees its picture
        points (x, y), in pixels from the optical axis.

        A view's picture is laid so that a point at the focus distance appears at the same place in
        all views.
        """
        focal = self.camera.focal_length_px
        # Turned towards the point on the axis at the focus distance, where all views coincide.
        aside = self.camera.lenslet_pitch * position / self.camera.focus_distance
        return np.stack([x / focal - aside, y / focal, np.ones_like(x)], axis=-1)


def render_streak(scene: Scene, instrument: Instrument, view: int) -> FloatArray:
    """Put the light of one view, counted from 0, on the streak image: (rows, columns), in arbitrary
    units, the same for all views; proportional to reflectance / range^2.
    """
    camera, detector = instrument.camera, instrument.detector
    (x, y), hits = (
        instrument.pixel_grid(),
        instrument.look_at(scene, float(camera.view_positions[view])),
    )
    bright = (hits.body != NO_BODY) & (hits.reflectance > 0)
    # light falls with the square of the distance, on the way back from a matt surface
    brightness = hits.reflectance[bright] / hits.distance[bright] ** 2
    brightness *= camera.gains[view] / instrument.rays_per_pixel_side**2
    # a cylindrical lenslet turned by the angle images a point as a slanted line, which crosses the
    # slit here
    slit = camera.centres_px[view] + x[bright] - y[bright] * np.tan(camera.angles[view])
    row = (2 * hits.path[bright] / SPEED_OF_LIGHT + camera.time_zero) / detector.bin_width
    stretch = np.ones_like(row)
    if camera.sweep is not None:
        # raw rows for one rectified row, which lengthen the pulse as well
        late, early = (camera.sweep.raw_position(row + half, slit)[0] for half in (0.5, -0.5))
        stretch = late - early
        row, slit = camera.sweep.raw_position(row, slit)
    ray, column, light = _split_over_columns(slit, brightness, instrument.rays_per_pixel_side)
    first, pulse = spread_pulse(row, stretch * compute_pulse_sigma_bins(instrument))
    reach, width = pulse.shape[1], camera.slit_width_px
    seen = (first[ray] > -reach) & (first[ray] < detector.rows) & (column >= 0) & (column < width)
    ray, column, light = ray[seen], column[seen], light[seen]
    # the screen has a margin for pulses it cuts off
    rows = first[ray][:, np.newaxis] + np.arange(reach, 2 * reach)
    amount = light[:, np.newaxis] * pulse[ray]
    with_margin = accumulate_cells(
        rows * width + column[:, np.newaxis], amount, (detector.rows + 2 * reach, width)
    )
    return with_margin[reach:-reach]


def _split_over_columns(
    position: FloatArray, light: FloatArray, side: int
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Split each ray, 1/side of a pixel wide, exactly between the one or two slit pixels that it
    covers; slit pixel j reaches from j - 1/2 to j + 1/2. Returns ray number, slit pixel and amount
    of light, piece by piece.
    """
    left_edge = position - 0.5 / side
    column = np.floor(left_edge + 0.5)
    on_next = np.clip((left_edge + 1 / side - (column + 0.5)) * side, 0.0, 1.0)
    crossing = np.flatnonzero(on_next > 0)
    return (
        np.concatenate([np.arange(position.size), crossing]),
        np.concatenate([column, column[crossing] + 1]).astype(np.intp),
        np.concatenate([light * (1 - on_next), light[crossing] * on_next[crossing]]),
    )


def compute_pulse_sigma_bins(instrument: Instrument) -> float:
    """Standard deviation of the Gaussian pulse in rows of the rectified streak image."""
    return float(instrument.camera.pulse_fwhm / FWHM_PER_SIGMA / instrument.detector.bin_width)


MIN_REFLECTANCE = 0.1  # a surface that reflects less says too little about where it is


@dataclass(frozen=True)
class GroundTruth:
    """The reference view, (y, x): `range` along the line of sight, m, of the plate that fills most of the
    pixel, NaN where there is none; `reflectance`, times the cosine of incidence, averaged over the
    pixel; `target`, whether the range can be asked for: the pixel and its eight neighbours lie on one
    plate, with a reflectance of at least 0.1 everywhere. `bin_width` of the shot, s, sets the scale of
    range errors.
    """

    range: Float32Array
    reflectance: Float32Array
    target: BoolArray
    bin_width: float

    @classmethod
    def from_scene(cls, scene: Scene, instrument: Instrument) -> GroundTruth:
        """Look at `scene` from the reference viewpoint of an instrument."""
        hits = instrument.look_at(scene)
        (rows, columns), side = instrument.camera.image_shape, instrument.rays_per_pixel_side

        def group_by_pixel(values: AnyArray) -> AnyArray:
            by_side = values.reshape(rows, side, columns, side)
            return by_side.swapaxes(1, 2).reshape(rows, columns, side**2)

        plate, path, reflectance = map(group_by_pixel, (hits.body, hits.path, hits.reflectance))
        filled = np.stack([np.mean(plate == body, axis=-1) for body in range(len(scene.bodies))])
        own = plate == np.argmax(filled, axis=0)[..., np.newaxis]
        count = own.sum(axis=-1)
        with np.errstate(invalid="ignore"):  # NaN where there is nothing
            distance = ((path * own).sum(axis=-1) / count).astype(np.float32)
        firm, around = np.all(reflectance >= MIN_REFLECTANCE, axis=-1), np.ones((3, 3))
        whole = [scipy.ndimage.binary_erosion((one == 1) & firm, around) for one in filled]
        return cls(
            range=distance,
            reflectance=reflectance.mean(axis=-1).astype(np.float32),
            target=np.logical_or.reduce(whole),
            bin_width=instrument.detector.bin_width,
        )


def render_true_frames(
    scene: Scene, instrument: Instrument, exposure: float = 1.0, position: float = 0.0
) -> Frames:
    """Transient frames that a perfect camera at the reference viewpoint, or at that of another
    view, `position` view steps away, would deliver of a `scene`, without noise or background,
    on the time axis of the streak images of `instrument`, time zero taken off. `exposure`:
    photons for reflectance 1 at 1 m that fills a pixel.
    """
    camera, detector = instrument.camera, instrument.detector
    hits = instrument.look_at(scene, position)
    pixel = number_ray_pixels(camera.image_shape, instrument.rays_per_pixel_side)
    seen = hits.body != NO_BODY
    brightness = hits.reflectance[seen] / hits.distance[seen] ** 2
    brightness *= exposure / instrument.rays_per_pixel_side**2
    row = (2 * hits.path[seen] / SPEED_OF_LIGHT + camera.time_zero) / detector.bin_width
    shape = (int(np.prod(camera.image_shape)), detector.rows)
    sigma = compute_pulse_sigma_bins(instrument)
    by_pixel = bin_by_time(pixel[seen], row, brightness, sigma, shape)
    values = np.ascontiguousarray(by_pixel.T, np.float32).reshape(-1, *camera.image_shape)
    times = detector.row_times - camera.time_zero
    # The reference view itself has no parallax: its pictures are those that the right shear would
    # give.
    distances = np.maximum(SPEED_OF_LIGHT * times / 2, detector.bin_width * SPEED_OF_LIGHT)
    return Frames(values, times, camera, shears=camera.shear_at(distances))


def score_returns(returns: Returns, truth: GroundTruth) -> dict[str, float]:
    """Compare each target pixel's most intense return with the true range.

    Parameters
    ----------
    returns : Returns
    truth : GroundTruth

    Returns
    -------
    dict
        ``median_depth_error_m``: median absolute range error of the target pixels that have a
        return; ``share_within_one_bin``: fraction of all target pixels whose return is within ``c *
        bin_width / 2`` of the truth, so that a missing return counts against it;
        ``share_with_return``: fraction of the target pixels that have a return;
        ``false_return_share``: fraction of all returns that lie more than a pixel away from anything
        in the scene; ``range_z``: robust standard deviation of the range errors of the target
        pixels in units of what each return says of its own, 1 if that is true; ``bin_m``: ``c *
        bin_width / 2``.

    Raises
    ------
    ShapeError, InputError
        Another picture size, or no target pixel with a return.
    """
    distance = returns.image("range")
    require_shape("the returns' picture", truth.range.shape, distance.shape)
    error = np.abs(distance - truth.range)[truth.target]
    found = np.isfinite(error)
    require(found.any(), "no target pixel of the truth has a return")
    sigma = returns.image("confidence")[truth.target]
    ratio = error[found] / np.maximum(sigma[found], np.finfo(np.float32).tiny)
    bin_m = SPEED_OF_LIGHT * truth.bin_width / 2
    # a return beside a border may belong to either side
    near_anything = scipy.ndimage.binary_dilation(np.isfinite(truth.range), np.ones((3, 3)))
    return {
        "median_depth_error_m": float(np.median(error[found])),
        "share_within_one_bin": float(np.mean(error <= bin_m)),
        "share_with_return": float(np.mean(found)),
        "false_return_share": float(np.mean(~near_anything[returns.y, returns.x])),
        "range_z": float(MAD_TO_SIGMA * np.median(ratio)),
        "bin_m": bin_m,
    }


@dataclass(frozen=True)
class SimulatedShot:
    """A `streak` image in photons, with noise, background and saturation, and the truth behind it: the
    `camera` with the gains and the sweep that made it; the `truth` of the reference view; `signal`
    (rows, columns), expected photons of each streak pixel without background; and `exposure`, photons
    for reflectance 1 at 1 m that fills a picture pixel, in a view of gain 1.
    """

    streak: Streak
    camera: Camera
    truth: GroundTruth
    signal: Float32Array
    exposure: float


def simulate_shot(scene: Scene, instrument: Instrument, seed: int) -> SimulatedShot:
    """Take one shot of `scene` by an `instrument`; the same `seed`, of the photon noise, gives the same shot.
    `InputError` where no light of the scene reaches the streak image.
    """
    camera, detector = instrument.camera, instrument.detector
    # In relative units: the exposure below decides what a unit is in photons.
    light = np.zeros((detector.rows, camera.slit_width_px))
    for view in range(camera.views):
        light += render_streak(scene, instrument, view)
    require(
        light.any(),
        "no light of the scene reaches the streak image: check positions, number of rows and time zero",
    )
    # Scaled by the brightest pixel, as one opens the iris of a real camera until it almost
    # saturates.
    exposure = detector.peak_photons / float(light.max())
    counts, saturated = detector.expose(exposure * light, np.random.default_rng(seed))
    settings = {"seed": seed, "peak_photons": detector.peak_photons, "exposure": exposure}
    streak = Streak(
        counts,
        detector.row_times,
        saturated,
        camera=camera,
        source="simulated streak image",
        provenance=collect_provenance(settings),
    )
    truth, signal = GroundTruth.from_scene(scene, instrument), (exposure * light).astype(np.float32)
    return SimulatedShot(streak, camera, truth, signal, exposure)


CENTRES_PX = (147.7, 320.0, 490.2, 664.1, 835.5, 1011.5, 1192.3)
ANGLES_DEG = (-43.3, -25.7, -12.7, 0.6, 22.9, 37.5, 48.0)
GAINS = (0.92, 1.08, 1.02, 0.90, 1.02, 0.96, 1.10)
OFFSETS_BINS = (-16.3, -10.4, -4.8, 0.0, 3.9, 8.2, 12.0)
STRETCHES = (0.009, 0.008, 0.004, 0.0, -0.001, -0.006, -0.006)
TIME_ZERO_S = -10.784e-9
CENTRE_ERROR_PX = 0.4  # the calibration's, by which a recovery starts off
FOCAL_LENGTH_PX = 560.0
LENSLET_PITCH_M = 2.3e-3
FOCUS_DISTANCE_M = 2.3


def make_default_camera() -> Camera:
    """Return the demonstration's camera, with its true gains and sweep: modelled on the seed paper's, seven
    lenslets whose lines lie between -43 and 48 degrees, skewed against each other by up to 16 rows.
    """
    return Camera(
        centres_px=np.array(CENTRES_PX),
        angles=np.radians(ANGLES_DEG),
        image_shape=(128, 128),
        slit_width_px=1344,
        gains=np.array(GAINS),
        sweep=SkewSweep(np.array(CENTRES_PX), np.array(OFFSETS_BINS), np.array(STRETCHES)),
        time_zero=TIME_ZERO_S,
        pulse_fwhm=60e-12,
        focal_length_px=FOCAL_LENGTH_PX,
        lenslet_pitch=LENSLET_PITCH_M,
        focus_distance=FOCUS_DISTANCE_M,
    )


def make_nominal_camera(camera: Camera) -> Camera:
    """Return a camera as focus pictures would give it.

    They cannot know sweep and gains, and know the slit centres to half a pixel only: these have to
    be found from the shot.
    """
    errors_px = CENTRE_ERROR_PX * np.cos(np.pi * np.arange(camera.views))
    return camera.replace(
        sweep=None, gains=np.ones(camera.views), centres_px=camera.centres_px + errors_px
    )


def make_default_instrument() -> Instrument:
    """Return the demonstration's camera with a detector of 2000 photons in the brightest pixel."""
    return Instrument(make_default_camera(), StreakDetector(full_scale_photons=1900.0))


def make_default_scene() -> Scene:
    """Return four cut-out letters and three textured plates between 1.7 and 3.2 m."""
    # pattern, middle and side in pixels, depth in m, yaw and pitch in rad
    plates: tuple[tuple[Pattern, Any, float, float, float, float], ...] = (
        (make_letter("U", 0.8), (-25, -24), 34, 1.75, 0.0, 0.0),
        (make_letter("C", 0.8), (23, -27), 34, 2.05, 0.15, 0.0),
        (make_letter("L", 0.8), (-24, 22), 32, 2.35, 0.0, 0.0),
        (make_letter("A", 0.8), (22, 20), 36, 2.62, 0.0, -0.15),
        (make_checkerboard(4, 0.3, 0.9), (2, -2), 36, 2.85, -0.3, 0.0),
        (make_rings(3, 0.3, 0.9), (-2, 36), 36, 3.0, 0.0, 0.0),
        (make_stripes(4, 0.3, 0.9), (0, 0), 96, 3.18, 0.0, 0.0),
    )
    return Scene(tuple(place_plate(*plate) for plate in plates))


def place_plate(
    pattern: Pattern,
    middle_px: tuple[float, float],
    side_px: float,
    depth: float,
    yaw: float = 0.0,
    pitch: float = 0.0,
    focal_length_px: float = FOCAL_LENGTH_PX,
) -> Body:
    """Square plate `side_px` wide around pixel offset `middle_px` (x, y) from the optical axis."""
    pixel = depth / focal_length_px
    centre: Vector = (middle_px[0] * pixel, middle_px[1] * pixel, depth)
    return make_plate(centre, (side_px * pixel, side_px * pixel), pattern, yaw, pitch)
