"""The demonstration: one scene with an occluder, and three cameras that look at it; the scenes; and small
targets behind an occluder, by which the formula of the inactive region is tested.

* Compact light-field photography with time of flight: a row of views, nonlocal measurements in
  every time bin.
* A single view with as many pixels as the other has measurements; it has time of flight too.
* A conventional light-field camera: every pixel of every view, but no time of flight; it can only
  defocus the occluder.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from tofclip.arrays import AnyArray
from tofclip.errors import InputError, require_known
from tofclip.light_field import LightField
from tofclip.light_field.views import CameraSetup
from tofclip.metrics import correlation_coefficient
from tofclip.occlusion import (
    TV_WEIGHT,
    InactiveRegion,
    Rig,
    SeparatedImages,
    TimedMeasurements,
    add_poisson_noise,
    measure_views,
    separate_occluder,
)
from tofclip.recovery.light_field import MAX_ITERATIONS, OBJECTIVE_TOLERANCE
from tofclip.simulate.bodies import Body, Lambertian, Rectangle, Sphere
from tofclip.simulate.light_fields import (
    CameraArray,
    PulsedScene,
    TimeAxis,
    render_flash,
    render_flash_view,
)
from tofclip.simulate.patterns import (
    cut_pattern,
    make_letter,
    make_mottled_pattern,
    make_plain_pattern,
    make_rings,
    make_text_pattern,
)
from tofclip.solvers import TotalVariation

Bodies = tuple[Body, ...]

VIEW_COUNT = 7
WALK_PLACES_M = np.linspace(-18e-3, 18e-3, 14).tolist()  # of a target that walks past
MIDDLE_VIEW = (0.0, 0.0)
FIELD_OF_VIEW_RAD = 0.45  # rad across the picture
BIN_WIDTH_S, PULSE_FWHM_S = 20e-12, 60e-12  # the paper's streak camera
RANGE_MARGIN_M = 20e-3  # before the occluder and behind the target, m

OBLIQUE_LAMP_M = (-55e-3, -25e-3, 0.0)
ILLUMINATIONS = ("diodes", "oblique", "co-located")

# of the brightest measurement: one of a single pixel gathers half the picture's light and learns
# little of it
DEFAULT_PHOTONS = {"line": 2e3, "single-pixel": 1e6}


@dataclass(frozen=True)
class ExperimentSettings:
    """How the scene is lit and measured."""

    side_px: int = 128  # rows and columns of the picture
    encoder: str = "line"  # A name of `tofclip.operators.cameras.CAMERAS`
    sampling_ratio: float = 0.5  # measurements over pixels of one picture
    # ``diodes``: one beside each view; ``oblique``: one far to the side; ``co-located``: one beside
    # the middle view, whose light the occluder keeps from everything that view cannot see
    illumination: str = "diodes"
    photons: float = 2000.0  # of the brightest measurement at its brightest instant
    seed: int = 0
    samples: int = 2  # rays on a side of each pixel

    def __post_init__(self) -> None:
        require_known("illumination", self.illumination, ILLUMINATIONS)
        if self.side_px < 24:
            raise InputError(f"a picture of {self.side_px} pixels shows nothing; take 24 or more")
        if not (np.isfinite(self.photons) and self.photons > 0):
            raise InputError(f"the number of photons must be positive, got {self.photons}")


def make_rig(
    region: InactiveRegion,
    side_px: int,
    focal_length_px: float,
    focus: float,
    samples: int,
    setup: CameraSetup,
) -> Rig:
    """Return a row of views as long as the baseline, in focus at a distance, m, a lamp beside each."""
    array = CameraArray(
        (side_px, side_px),
        VIEW_COUNT,
        focal_length_px,
        region.baseline / (VIEW_COUNT - 1),
        focus=focus,
        samples=samples,
        view_rows=1,
    )
    return Rig(array, np.stack([array.position((v, u)) for v, u in array.views]), setup)


@dataclass(frozen=True)
class Experiment:
    """A scene, as it is measured."""

    scene: OcclusionScene
    settings: ExperimentSettings

    @cached_property
    def rig(self) -> Rig:
        """Views, lamps and measurements."""
        region, known = self.scene.region, self.settings
        setup = CameraSetup(known.encoder, known.sampling_ratio, known.seed)
        focal_length_px = known.side_px / FIELD_OF_VIEW_RAD
        focus = 2 / (1 / region.distance + 1 / self.scene.distance)
        rig = make_rig(region, known.side_px, focal_length_px, focus, known.samples, setup)
        lamps = {"oblique": np.array([OBLIQUE_LAMP_M]), "co-located": np.zeros((1, 3))}
        return replace(rig, lamps=lamps.get(known.illumination, rig.lamps))

    @cached_property
    def time_axis(self) -> TimeAxis:
        """Instants from before the occluder's return to after the target's."""
        near = self.scene.region.distance - RANGE_MARGIN_M
        far = self.scene.distance + RANGE_MARGIN_M
        lamp = float(np.linalg.norm(self.rig.lamps, axis=1).max())
        return TimeAxis.for_ranges(near, float(np.hypot(far, lamp)), BIN_WIDTH_S, PULSE_FWHM_S)

    @property
    def expected_visible(self) -> bool:
        """Whether the formula promises the target's middle, and a lamp gets there as views do."""
        return (
            self.scene.behind > self.scene.region.length
            and self.settings.illumination != "co-located"
        )

    @cached_property
    def pictures(self) -> AnyArray:
        """What every view sees at every instant, without noise, (views, rows, columns, bins)."""
        return render_flash(
            PulsedScene((*self.scene.target, *self.scene.occluder), self.rig.lamps),
            self.rig.array,
            self.time_axis,
        )

    @cached_property
    def truth(self) -> AnyArray:
        """What the middle view would see of the target, were there no occluder, (rows, columns)."""
        return self._see_target(self.rig.array)

    def _see_target(self, array: CameraArray) -> AnyArray:
        return self._render_middle_view(self.scene.target, array).sum(axis=-1)

    def _render_middle_view(self, bodies: Bodies, array: CameraArray) -> Any:
        scene = PulsedScene(bodies, self.rig.lamps)
        return render_flash_view(scene, array, self.time_axis, MIDDLE_VIEW)

    @cached_property
    def measurements(self) -> TimedMeasurements:
        """What the nonlocal views read, with photon noise."""
        clean = measure_views(self.pictures, self.rig, self.time_axis)
        return replace(clean, values=self._add_noise(clean.values, 1))

    def _add_noise(self, light: AnyArray, stream: int) -> AnyArray:
        """Light with photon noise, from a stream of random numbers of its own."""
        random = np.random.default_rng([self.settings.seed, stream])
        return add_poisson_noise(light, self.settings.photons / float(light.max()), random)

    @cached_property
    def separated(self) -> SeparatedImages:
        return separate_occluder(self.measurements)

    @cached_property
    def single_view(self) -> AnyArray:
        """The target by the middle view, of as many pixels as measurements, gated."""
        seen = self._render_middle_view(
            (*self.scene.target, *self.scene.occluder), self._single_array
        )
        noisy = self._add_noise(seen, 2)
        gates = [one.bins for one in self.measurements.find_returns()]
        picture: AnyArray = (
            noisy[..., gates[1]].sum(axis=-1) if len(gates) > 1 else 0 * noisy[..., 0]
        )
        return picture

    @cached_property
    def single_view_truth(self) -> AnyArray:
        """What the single view would see of the target, were there no occluder."""
        return self._see_target(self._single_array)

    @property
    def _single_array(self) -> CameraArray:
        """A view with as many pixels as the rig has measurements."""
        side = max(round(np.sqrt(self.rig.camera.measurements)), 1)
        focal_length_px = self.rig.array.focal_length_px * side / self.settings.side_px
        return replace(self.rig.array, image_shape=(side, side), focal_length_px=focal_length_px)

    @cached_property
    def conventional(self) -> AnyArray:
        """All pixels of all views without time of flight, refocused on the target."""
        noisy = self._add_noise(self.pictures.sum(axis=-1), 3)
        shear = float(self.rig.array.shear(self.scene.distance))
        return LightField(noisy, self.rig.array.views).refocus(shear)


BASELINE_M = 15e-3
OCCLUDER_DISTANCE_M = 50e-3
TARGET_DEPTH_M = 70e-3
TARGET_Z_M = OCCLUDER_DISTANCE_M + TARGET_DEPTH_M
OCCLUDER_REFLECTANCE = 0.6  # of all but the tree

LEAF_COUNT, BUSH_RADIUS_M = 60, 8.5e-3
# half width and half height of a slot in which nothing hangs but the middle leaf, so that the
# formula holds there
LEAF_CLEARANCE_M = 3.7e-3, 0.5e-3


@dataclass(frozen=True)
class OcclusionScene:
    """What stands where."""

    name: str
    title: str
    occluder: Bodies
    target: Bodies
    region: InactiveRegion  # of the occluder's solid part on the axis
    behind: float = TARGET_DEPTH_M  # from the occluder to the target, m

    @property
    def distance(self) -> float:
        """From the views to the target, m."""
        return self.region.distance + self.behind

    def move_target(self, across: float) -> OcclusionScene:
        """Return the scene with its target moved to the right, m."""
        return replace(self, target=tuple(body.shift(across, 0.0) for body in self.target))

    def widen_occluder(self, width: float) -> OcclusionScene:
        """Return the scene with its occluder scaled about the axis until its solid part is as wide, m."""
        factor, plates = width / self.region.width, []
        for body in self.occluder:
            assert isinstance(body.shape, Rectangle)  # as all occluders are
            shape = Rectangle(factor * body.shape.width, factor * body.shape.height)
            plates.append(replace(body, shape=shape, centre=body.centre * (factor, factor, 1.0)))
        return replace(self, occluder=tuple(plates), region=replace(self.region, width=width))


def make_walking_scene(name: str) -> OcclusionScene:
    """Return a scene of `SCENES` with a person behind its occluder, instead of what stands there."""
    scene, (_, occluder) = make_occlusion_scene(name), SCENES[name]
    return replace(scene, title=f"a person behind a {occluder}", target=_make_figure())


def make_occlusion_scene(name: str) -> OcclusionScene:
    """Return a scene of `SCENES`."""
    require_known("scene", name, SCENES)
    target, occluder = SCENES[name]
    make_occluder, solid_width = OCCLUDERS[occluder]
    region = InactiveRegion(BASELINE_M, solid_width, OCCLUDER_DISTANCE_M)
    title = f"a {target} behind a {occluder}"
    return OcclusionScene(name, title, make_occluder(), TARGETS[target](), region)


def make_upright_bar(width: float, distance: float = OCCLUDER_DISTANCE_M) -> Body:
    """Return a bar on the axis, so long that no view sees its ends; width and distance in m."""
    return _make_plate(width, 40 * width, z=distance)


def _make_plate(
    width: float,
    height: float,
    pattern: AnyArray | None = None,
    x: float = 0.0,
    y: float = 0.0,
    z: float = OCCLUDER_DISTANCE_M,
) -> Body:
    plain = make_plain_pattern(OCCLUDER_REFLECTANCE) if pattern is None else pattern
    return Body(Rectangle(width, height), Lambertian(plain), np.array([x, y, z]))


def _make_figure() -> Bodies:
    """A mannequin, 36 mm tall."""
    skin = make_mottled_pattern(0.6, 0.95, 8, seed=3)
    parts = (  # trunk, arms, legs: width, height and place
        (9e-3, 15e-3, 0.0, -1e-3),
        (26e-3, 3.4e-3, 0.0, -6e-3),
        (3.4e-3, 12e-3, -2.8e-3, 12e-3),
        (3.4e-3, 12e-3, 2.8e-3, 12e-3),
    )
    head = Body(Sphere(4e-3), Lambertian(skin), np.array([0.0, -13e-3, TARGET_Z_M]))
    return (head, *(_make_plate(w, h, skin, x, y, TARGET_Z_M) for w, h, x, y in parts))


V_SIDE_M, V_HEIGHT_M = 13e-3, 16e-3


def _make_v_letter() -> Bodies:
    """Supplementary Figure 14c: the axis meets the V below 0.6, where its strokes have joined."""
    pattern = make_letter("V", OCCLUDER_REFLECTANCE)
    return (_make_plate(V_SIDE_M, V_HEIGHT_M, pattern, y=-0.25 * V_HEIGHT_M),)


def _make_tree() -> Bodies:
    """A trunk with branches and rough bark."""
    bark = make_mottled_pattern(0.25, 0.85, 14, seed=5)
    branches = (  # side, height and tilt
        (1, -4.6e-3, 0.5),
        (-1, -3.9e-3, 0.6),
        (1, 4.4e-3, 0.4),
        (-1, 6e-3, 0.5),
    )
    behind = OCCLUDER_DISTANCE_M + 1e-3
    return (
        _make_plate(4.5e-3, 40e-3, bark),
        *(
            _make_plate(11e-3, 1.3e-3, bark, side * 6e-3, y, behind).rotate(-side * tilt)
            for side, y, tilt in branches
        ),
    )


SLAT_M = 1.6e-3


def _make_trellis() -> Bodies:
    """Slats at right angles with holes, standing on a corner: one of them crosses the axis."""
    pitch, side = 4e-3, 13.6e-3
    across = np.linspace(-side / 2, side / 2, 340)
    on_slat = abs((across + pitch / 2) % pitch - pitch / 2) < SLAT_M / 2
    off_slat = abs(across % pitch - pitch / 2) < SLAT_M / 2
    frame = abs(across) > side / 2 - SLAT_M / 2
    slats = (on_slat | frame) | (off_slat | frame)[:, np.newaxis]
    lattice = np.where(slats, OCCLUDER_REFLECTANCE, np.nan)
    return (_make_plate(side, side, lattice).rotate(np.pi / 4),)


def _make_bush() -> Bodies:
    """Leaves at random between 48 and 52 mm, every one turned its own way; one hangs on the axis."""
    random = np.random.default_rng(7)
    down = np.linspace(0, np.pi, 40)
    edge = 0.5 * np.sin(down)  # a leaf fills its rectangle from tip to tip, widest at its middle
    outline = np.stack(
        [0.5 + np.concatenate([edge, -edge[::-1]]), np.concatenate([down, down[::-1]]) / np.pi],
        axis=-1,
    )
    leaf = cut_pattern([outline], make_plain_pattern(OCCLUDER_REFLECTANCE))
    hung = [_make_plate(4e-3, 6e-3, leaf)]
    while len(hung) < LEAF_COUNT:
        place = random.uniform(
            (-9e-3, -9e-3, OCCLUDER_DISTANCE_M - 2e-3), (9e-3, 9e-3, OCCLUDER_DISTANCE_M + 2e-3)
        )
        length = random.uniform(3e-3, 4.5e-3)
        body = _make_plate(0.55 * length, length, leaf, *place)
        body = body.tilt(random.uniform(-0.6, 0.6)).rotate(random.uniform(0, 2 * np.pi))
        inside = np.hypot(*place[:2]) < BUSH_RADIUS_M
        if inside and np.any(abs(place[:2]) > np.array(LEAF_CLEARANCE_M) + length / 2):
            hung.append(body)
    return tuple(hung)


MakeBodies = Callable[[], Bodies]
TARGETS: dict[str, MakeBodies] = {
    "word": lambda: (_make_plate(40e-3, 18e-3, make_text_pattern("CLIP", 0.9), z=TARGET_Z_M),),
    "disc": lambda: (_make_plate(24e-3, 24e-3, make_rings(3, 0.15, 0.95), z=TARGET_Z_M),),
    "figure": _make_figure,
}
OCCLUDERS: dict[str, tuple[MakeBodies, float]] = {
    "letter V": (_make_v_letter, 0.46 * V_SIDE_M),
    "plate": (lambda: (_make_plate(6e-3, 20e-3),), 6e-3),
    "tree": (_make_tree, 4.5e-3),
    "bush": (_make_bush, 4e-3),
    "trellis": (_make_trellis, SLAT_M * np.sqrt(2)),
    # wider than the views are apart: the formula promises nothing
    "board": (lambda: (_make_plate(21e-3, 60e-3),), 21e-3),
}
"""By what they are, with the width of their solid part on the axis, m."""
SCENES = {
    "v-letter": ("disc", "letter V"),
    "plate": ("word", "plate"),
    "person": ("figure", "plate"),
    "tree": ("figure", "tree"),
    "bush": ("word", "bush"),
    "trellis": ("disc", "trellis"),
    "board": ("disc", "board"),
}
"""Target and occluder."""


DISTANCE_FACTORS = (0.8, 1.2, 2.0)  # behind the occluder, in lengths of the inactive region
TARGET_WIDTH_FRACTION = 0.15  # of the occluder's; the umbra is 0.2 of it wide at 0.8 of its length
MIN_CORRELATION = 0.8  # with the unoccluded truth: from there on a target counts as recovered

PICTURE_PX = 48
TARGET_PX = 20
PROBE_PULSE_FWHM_S = 10e-12  # the nearest target of all trials answers 25 ps after its occluder
MAX_GATE_S = 80e-12
PEAK_PHOTONS = 2000.0  # of the brightest measurement, were there no occluder
BACKGROUND_PHOTONS = 20.0  # photons of every measurement that come at any time
SIGNIFICANCE_SIGMAS = 5.0  # standard deviations of the background
MIN_VIEW_FRACTION = 0.5  # a view with less light than this share of the brightest view's is blocked

FIXED_PICTURE_PX = 128
FIXED_FOCUS_M = 0.1  # where pictures of all views agree; no target stands just there
FIXED_BACKGROUND_PHOTONS = BACKGROUND_PHOTONS * BIN_WIDTH_S / MAX_GATE_S  # in every bin
BOARD_ROWS = 32  # of cells, four pixels each


@dataclass(frozen=True)
class ProbeResult:
    """One target and what became of it."""

    distance: float  # from the views, m
    factor: float  # distance from the occluder in lengths of the inactive region
    # of the recovered picture with what the reference view would see without an occluder
    correlation: float
    views: int  # how many views got light from it
    picture: AnyArray  # (rows, columns)
    truth: AnyArray  # (rows, columns)

    @property
    def expected_visible(self) -> bool:
        """Whether the formula promises it."""
        return self.factor > 1

    @property
    def is_recovered(self) -> bool:
        return self.correlation >= MIN_CORRELATION


def probe_target(
    occluder: Bodies, region: InactiveRegion, factor: float, seed: int = 0
) -> ProbeResult:
    """Try to recover a target at `factor` lengths of a region that has an end."""
    distance = region.distance + factor * region.length
    width = TARGET_WIDTH_FRACTION * region.width
    focal_length_px = distance * TARGET_PX / width
    setup = CameraSetup("line", 1.0, seed)
    rig = make_rig(region, PICTURE_PX, focal_length_px, distance, 2, setup)
    letter = make_letter("L", 0.9)
    target = _make_plate(width, width, letter, z=distance)
    # one bin about the target's return that opens halfway from the occluder's
    near, far = rig.compute_flight_time(np.array([region.distance, distance]))
    gate = TimeAxis(float(far), float(min(far - near, MAX_GATE_S)), 1, PROBE_PULSE_FWHM_S)
    hidden, free = (
        render_flash(PulsedScene(bodies, rig.lamps), rig.array, gate)
        for bodies in ((target, *occluder), (target,))
    )
    light, unoccluded = (measure_views(one, rig, gate).values for one in (hidden, free))
    picture, views = _recover_target(rig, light, unoccluded.max(), seed)
    truth = free[VIEW_COUNT // 2, :, :, 0]
    correlation = correlation_coefficient(picture, truth)
    return ProbeResult(distance, factor, correlation, views, picture, truth)


def probe_with_fixed_camera(
    occluder: Bodies, region: InactiveRegion, factor: float, seeds: int
) -> list[ProbeResult]:
    """Put a board behind an upright occluder, and look at its middle with a camera that knows neither,
    once for each seed: one focal length, focus and pulse for all boards, the exposure of the brightest
    measurement. Such a camera gets too little light from a speck, so that the board fills the picture;
    what is judged is a strip of it, as wide as the target of `probe_target`.
    """
    distance = region.distance + factor * region.length
    width = TARGET_WIDTH_FRACTION * region.width
    focal_length_px = FIXED_PICTURE_PX / FIELD_OF_VIEW_RAD
    rigs = [
        make_rig(region, FIXED_PICTURE_PX, focal_length_px, FIXED_FOCUS_M, 1, setup)
        for setup in (CameraSetup("line", 1.0, seed) for seed in range(seeds))
    ]
    array, lamps = rigs[0].array, rigs[0].lamps
    sweep = TimeAxis.for_ranges(
        region.distance - RANGE_MARGIN_M,
        distance + RANGE_MARGIN_M,
        BIN_WIDTH_S,
        PULSE_FWHM_S,
    )
    # random bright and dark cells, a column of them on the axis
    side = FIELD_OF_VIEW_RAD * distance
    columns = 2 * round(side / width / 2) + 1
    cells = np.where(np.random.default_rng(0).random((BOARD_ROWS, columns)) < 0.5, 0.9, 0.1)
    board = _make_plate(columns * width, side, cells, z=distance)
    # Light does not depend on what the seeds draw: it is cast once.
    pictures = render_flash(PulsedScene((board, *occluder), lamps), array, sweep)
    free = render_flash_view(PulsedScene((board,), lamps), array, sweep, (0.0, 0.0)).sum(axis=-1)
    half, axis = int(focal_length_px * width / distance / 2), FIXED_PICTURE_PX // 2
    strip = slice(axis - half, axis + half + 1)
    truth, results = free[:, strip], []
    for seed, rig in enumerate(rigs):
        clean = measure_views(pictures, rig, sweep)
        per_unit = PEAK_PHOTONS / float(clean.values.max())
        noisy = _count_photons(clean.values, FIXED_BACKGROUND_PHOTONS, per_unit, [seed, 4])
        picture = separate_occluder(replace(clean, values=noisy)).target[:, strip]
        correlation = correlation_coefficient(picture, truth)
        results.append(ProbeResult(distance, factor, correlation, VIEW_COUNT, picture, truth))
    return results


def _count_photons(
    light: AnyArray, background: float, per_unit: float, seed: list[int]
) -> AnyArray:
    """Light as it is counted among background photons, which are taken off again."""
    dark = np.float32(background / per_unit)
    return add_poisson_noise(light + dark, per_unit, np.random.default_rng(seed)) - dark


def _recover_target(rig: Rig, light: AnyArray, brightest: float, seed: int) -> tuple[AnyArray, int]:
    """Recover, blocked views left out; nothing where no view got significant light."""
    camera, per_unit = rig.camera, PEAK_PHOTONS / brightest
    measurements = _count_photons(light, BACKGROUND_PHOTONS, per_unit, [seed, 3])
    sizes = [encoder.shape_out[0] for encoder in camera.encoders]
    parts = np.split(measurements[:, 0], np.cumsum(sizes)[:-1])
    lights = np.array([part.mean() for part in parts])
    doubt = np.sqrt(BACKGROUND_PHOTONS / np.array(sizes)) / per_unit
    seeing = (lights > SIGNIFICANCE_SIGMAS * doubt) & (lights > MIN_VIEW_FRACTION * lights.max())
    if not seeing.any():
        return np.zeros(rig.array.image_shape, np.float32), 0
    valid = np.repeat(seeing, sizes)[:, np.newaxis]
    method = TotalVariation(TV_WEIGHT, MAX_ITERATIONS, OBJECTIVE_TOLERANCE)
    return method.recover(camera.model(0.0), measurements, valid).frames[0], int(seeing.sum())
