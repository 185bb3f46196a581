"""The description of a CLIP instrument, what it makes of light, and scenes in its field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from tofclip.arrays import Float32Array
from tofclip.camera import Camera, SkewSweep
from tofclip.errors import InputError, require, require_known
from tofclip.files import atomic_path, read_toml, suggest_name
from tofclip.operators import LinearOperator
from tofclip.operators.cameras import CAMERAS, LightFieldCamera
from tofclip.recovery.shot import DepthLockedFocus, FixedFocus, FrameSegment
from tofclip.shots import Frames
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate
from tofclip.simulate.patterns import (
    Pattern,
    make_checkerboard,
    make_letter,
    make_mottled_pattern,
    make_plain_pattern,
    make_rings,
    make_stripes,
)
from tofclip.solvers import LinearInverse, PreparedInverse
from tofclip.units import MILLIMETRE, PICOSECOND, SPEED_OF_LIGHT

ENCODERS = {"2d": "diffuser", "0d": "single-pixel"}
"""Cameras of `tofclip.operators.cameras` by their sensors; "slit" and "1d" are a `Camera`."""
SENSORS = ("slit", "1d", *ENCODERS)
MARGIN_PULSES = 4.0  # of the sweep before the nearest light and after the farthest


@dataclass(frozen=True)
class Design:
    """The description of an instrument; keys of a TOML file, with their units."""

    #: "slit" of a streak camera or "1d" line of counting pixels, on which all lenslets lie beside each
    #: other; "2d", one sparse area sensor behind a diffuser; "0d", a single pixel with codes behind
    #: each lenslet
    sensor: str = "slit"
    views: int = 7  #: lenslets, in a row
    pitch_mm: float = 2.3  #: between lenslets
    focus_distance_m: float = 2.3  #: where their pictures coincide; `inf` is far away
    focal_length_px: float = 560.0
    #: of the lines from the vertical; evenly from -45 to 45 by default. Slit and 1d only
    angles_deg: tuple[float, ...] = ()
    rows_px: int = 128  #: of the picture
    columns_px: int = 128
    sensor_px: int = 0  #: of the slit or line; 0 gives each view as many as its lines cross
    centres_px: tuple[float, ...] = ()  #: of the views on it; evenly by default
    sampling_ratio: float = 0.25  #: of 2d and 0d: readings over pixels of the picture
    bins: int = 576
    bin_width_ps: float = 20.0
    pulse_ps: float = 60.0  #: full width at half maximum of the response
    photons: float = 2000.0  #: expected of the brightest reading in a bin
    background_photons: float = 2.0  #: of every one
    near_m: float = 1.7  #: where the scene begins, and where it ends
    far_m: float = 3.2
    shots_per_second: float = 30.0
    occluder_mm: float = 0.0  #: width of a solid occluder on the axis; 0: none
    occluder_distance_m: float = 0.0
    damping: float = 1e-2  #: mu over the largest eigenvalue of A A'
    max_angle_deg: float = 60.0  #: the steepest line that better angles may have

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if item.name == "sensor":
                good, wanted = value in SENSORS, f"one of {', '.join(SENSORS)}"
            elif item.name in ("angles_deg", "centres_px"):
                good = isinstance(value, list | tuple) and len(value) in (0, self.views)
                wanted = f"a list of {self.views} numbers, one for each of the views"
            elif isinstance(item.default, int):
                good = isinstance(value, int) and number and value >= (item.name != "sensor_px")
                wanted = "a whole number, 1 or more"
            else:
                least = 0 if item.default == 0 or item.name == "background_photons" else 1e-300
                good, wanted = number and value >= least, "a positive number"
                good = good and (np.isfinite(value) or item.name == "focus_distance_m")
            require(good, f"{item.name} must be {wanted}, got {value!r}")
            if isinstance(value, list):
                object.__setattr__(self, item.name, tuple(map(float, value)))
        require(
            self.near_m < self.far_m,
            f"far_m must be more than near_m, {self.near_m:g}; got {self.far_m:g}",
        )
        # at the picture's corner a range is so much longer than the depth
        secant = np.hypot(1, np.hypot(self.rows_px, self.columns_px) / 2 / self.focal_length_px)
        span = 2 * (self.far_m - self.near_m) * secant / SPEED_OF_LIGHT
        needed = int(np.ceil((span + 2 * self._margin) / (self.bin_width_ps * PICOSECOND)))
        require(
            self.bins >= needed,
            f"{self.bins} bins of {self.bin_width_ps:g} ps do not cover {self.near_m:g} to {self.far_m:g} m: "
            f"set bins to {needed} or more",
        )

    @classmethod
    def load(cls, path: str | Path) -> Design:
        """Read a TOML file, `path`; `FileFormatError` or `InputError` where it is none, has an unknown
        key, or a value that no instrument has.
        """
        found = read_toml(path, "a design")
        try:
            return cls.of(found)
        except InputError as fault:
            raise InputError(f"{path}: {fault}") from fault

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> Design:
        """Return the design of a mapping with the keys of a TOML file."""
        known = [item.name for item in fields(cls)]
        for key in settings:
            if key not in known:
                raise InputError(f"a design has no key '{key}'; {suggest_name(key, known)}")
        return cls(**settings)

    def save(self, path: str | Path) -> None:
        """Write a TOML file, whole or not at all."""
        with atomic_path(Path(path)) as temporary:
            temporary.write_text(tomli_w.dumps(asdict(self)), encoding="utf-8")

    @property
    def _margin(self) -> float:
        return MARGIN_PULSES * max(self.pulse_ps, self.bin_width_ps) * PICOSECOND

    @cached_property
    def camera(self) -> Camera:
        """The camera; of 2d and 0d its picture and its time axis only."""
        even = np.linspace(-45, 45, self.views) if self.views > 1 else np.zeros(1)
        angles = np.radians(self.angles_deg or even)
        width = self.sensor_px
        if width == 0:
            # a view's lines from the picture's corners lie so far apart
            reach = self.columns_px + self.rows_px * np.abs(np.tan(angles)).mean() / 2
            width = int(np.ceil(self.views * reach))
        centres = np.array(self.centres_px or (np.arange(self.views) + 0.5) * width / self.views)
        still = np.zeros(self.views)
        return Camera(
            centres,
            angles,
            (self.rows_px, self.columns_px),
            width,
            sweep=SkewSweep(centres, still, still),
            time_zero=self._margin - 2 * self.near_m / SPEED_OF_LIGHT,
            pulse_fwhm=self.pulse_ps * PICOSECOND,
            focal_length_px=self.focal_length_px,
            lenslet_pitch=self.pitch_mm * MILLIMETRE,
            focus_distance=self.focus_distance_m,
        )

    @cached_property
    def instrument(self) -> Instrument:
        """The camera with its detector, for simulations."""
        width = self.bin_width_ps * PICOSECOND
        counts = self.photons, self.background_photons
        return Instrument(self.camera, StreakDetector(self.bins, width, *counts))

    @cached_property
    def encoder(self) -> LightFieldCamera | None:
        """Which readings each view of a 2d or 0d camera gets; None of slit and line."""
        if self.sensor not in ENCODERS:
            return None
        views = [(0.0, float(u)) for u in self.camera.view_positions]
        kind = CAMERAS[ENCODERS[self.sensor]]
        return kind(self.camera.image_shape, views, self.sampling_ratio, 0)

    @cached_property
    def weights(self) -> Float32Array:
        """W that readings and operator get in the recovery, (readings, readings)."""
        if self.encoder is None:
            return np.eye(self.camera.slit_width_px, dtype=np.float32)
        return _make_dense(self.encoder.weighting())

    def matrix(self, shear: float) -> Any:
        """Return A, (readings, pixels), sparse for slit and line; shear in pixels per view step."""
        if self.encoder is None:
            return self.camera.operator(shear).matrix
        return _make_dense(self.encoder.model(shear))

    def plan_segments(self, frames: Frames) -> list[FrameSegment]:
        """Cut the frames where another shear is needed."""
        focus = DepthLockedFocus() if self.views > 1 else FixedFocus()
        return focus.plan_segments(self.camera, frames.times)

    def prepare(self, shear: float) -> PreparedInverse:
        """Return the linear inverse; its Gram matrix is that of W A."""
        if self.encoder is None:
            return LinearInverse(self.damping).prepare(self.camera.operator(shear))
        operator = self.encoder.weighting() @ self.encoder.model(shear)
        weighted = (self.weights @ self.matrix(shear)).astype(np.float64)
        gram = weighted @ weighted.T
        gram[np.diag_indices_from(gram)] += self.damping * operator.squared_norm
        return PreparedInverse(operator, np.linalg.inv(gram).astype(np.float32))


def _make_dense(operator: LinearOperator) -> Float32Array:
    rows = operator.adjoint(np.eye(operator.shape_out[0], dtype=np.float32))
    return np.ascontiguousarray(rows.reshape(-1, operator.shape_out[0]).T)


# pattern, middle and sides as parts of half the picture and of the picture, depth as a part of the
# scene's, yaw in rad
Plate = tuple[Pattern, tuple[float, float], tuple[float, float], float, float]


SCENES: dict[str, tuple[Plate, ...]] = {
    "letters": (
        (make_letter("C", 0.8), (-0.45, -0.42), (0.34, 0.34), 0.05, 0.0),
        (make_letter("L", 0.8), (0.42, -0.45), (0.32, 0.32), 0.3, 0.1),
        (make_letter("U", 0.8), (-0.4, 0.42), (0.32, 0.32), 0.55, 0.0),
        (make_letter("A", 0.8), (0.42, 0.4), (0.36, 0.36), 0.8, -0.1),
    ),
    "plates": (
        (make_checkerboard(4, 0.3, 0.9), (-0.4, -0.35), (0.36, 0.36), 0.1, -0.3),
        (make_rings(3, 0.3, 0.9), (0.4, 0.35), (0.4, 0.4), 0.4, 0.0),
        (make_stripes(4, 0.3, 0.9), (0.05, 0.0), (0.7, 0.7), 0.9, 0.0),
    ),
    "poles": (
        (make_plain_pattern(0.6), (-0.55, 0.0), (0.08, 0.8), 0.1, 0.0),
        (make_plain_pattern(0.8), (0.2, -0.1), (0.12, 0.6), 0.35, 0.0),
        (make_plain_pattern(0.5), (0.0, 0.6), (0.8, 0.1), 0.6, 0.0),
        (make_mottled_pattern(0.2, 0.9, 5, 0), (0.35, -0.2), (0.4, 0.4), 0.9, 0.2),
    ),
}


def make_scene(name: str, design: Design) -> Scene:
    """Return one of `SCENES` in an instrument's field, from its near to its far end."""
    require_known("scene", name, SCENES)
    bodies = []
    for pattern, (x, y), sides, part, yaw in SCENES[name]:
        z = design.near_m + (0.05 + 0.85 * part) * (design.far_m - design.near_m)
        rows, columns = (z / design.focal_length_px * n for n in design.camera.image_shape)
        size = (sides[0] * columns, sides[1] * rows)
        bodies.append(make_plate((x * columns / 2, y * rows / 2, z), size, pattern, yaw))
    return Scene(tuple(bodies))
