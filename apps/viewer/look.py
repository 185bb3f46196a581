"""How points look and which one is meant: colours that say a quantity, a click's point, and flat pictures
beside the scene.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apps.viewer.source import Waveform
from tofclip.errors import InputError
from tofclip.lidar import PointCloud
from tofclip.units import NANOSECOND

PALETTE_SIZE = 256  # colours of a palette, and entries of a scale
# percentiles between which colours are spread unless limits are set: a glint does not darken the
# rest
LIMIT_PERCENTILES = (1.0, 99.0)
# percentile of the intensity from which points are drawn in full light
FULL_LIGHT_PERCENTILE = 85.0
MIN_SHADE = 0.15
GAMMA = 0.8

# m; lengths below the one are in mm, below the other in um
SMALLEST_IN_METRES, SMALLEST_IN_MILLIMETRES = 0.1, 1e-4
# points from which an equalised scale is made; more would cost time and change nothing to be seen
MAX_RANKED_POINTS = 100_000
# all but turbo are perceptually uniform; turbo separates most ranges
PALETTES = ("viridis", "cividis", "inferno", "magma", "plasma", "turbo", "grey")
# turbo's darkest blue and red are left out: shaded, the nearest and the farthest would be black
TURBO_ENDS = 0.09, 0.93


@dataclass(frozen=True)
class Quantity:
    """Something that every point has."""

    unit: str  # of what `extract` returns
    extract: Callable[[PointCloud], NDArray[Any]]  # takes a cloud, returns (n,) numbers


# heights count upwards from the camera, though y points down
QUANTITIES: Mapping[str, Quantity] = {
    "range": Quantity("m", lambda cloud: cloud.range),
    "height": Quantity("m", lambda cloud: -cloud.xyz[:, 1]),
    "intensity": Quantity("counts", lambda cloud: cloud.intensity),
    "standard deviation": Quantity("m", lambda cloud: cloud.range_sigma),
    "return number": Quantity("", lambda cloud: cloud.return_number),
    "time": Quantity("ns", lambda cloud: cloud.time / np.float32(NANOSECOND)),
}


@dataclass(frozen=True)
class Colouring:
    """How points are coloured."""

    quantity: str = "range"  # one of `QUANTITIES`
    palette: str = "turbo"  # one of `PALETTES`
    # values of the first and the last colour, in the quantity's unit; `LIMIT_PERCENTILES`
    # percentiles by default
    limits: tuple[float, float] | None = None
    # whether every colour is given to equally many points, instead of to an equal span of values
    equalised: bool = False
    # whether dim points are drawn darker, so that what is written on a surface can be read in
    # colours of range
    shaded: bool = True

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise InputError(
                f"no colour for '{self.quantity}'; choose one of {', '.join(QUANTITIES)}"
            )
        if self.palette not in PALETTES:
            raise InputError(
                f"no palette is called '{self.palette}'; choose one of {', '.join(PALETTES)}"
            )
        if self.limits is not None and not (
            np.all(np.isfinite(self.limits)) and self.limits[0] < self.limits[1]
        ):
            raise InputError(
                f"the limits of the colours must rise, got {self.limits[0]} and {self.limits[1]}"
            )


@dataclass(frozen=True)
class Scale:
    """What the colours mean."""

    quantity: str
    unit: str
    palette: str
    values: NDArray[np.float64]  # (256,), value of each colour, rising

    @property
    def limits(self) -> tuple[float, float]:
        """Values of the first and the last colour."""
        return float(self.values[0]), float(self.values[-1])

    def colours(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """Return red, green and blue, (n, 3); values beyond the limits get the outermost colours."""
        low, high = self.limits
        # An even scale needs no search: the number of the colour is a product.
        if np.allclose(np.diff(self.values), (high - low) / (PALETTE_SIZE - 1), rtol=1e-6, atol=0):
            even = (np.clip(values, low, high) - np.float32(low)) * np.float32(
                (PALETTE_SIZE - 1) / (high - low)
            )
            number = np.rint(even).astype(np.intp)
        else:
            number = np.clip(
                np.searchsorted(self.values, values, side="right") - 1, 0, PALETTE_SIZE - 1
            )
        colours: NDArray[np.uint8] = load_palette(self.palette)[number]
        return colours


def format_length(length: float) -> str:
    """Return a length in m as a person writes it: ``0.42 mm``, ``31 mm``, ``1.85 m``."""
    if 0 < abs(length) < SMALLEST_IN_MILLIMETRES:
        return f"{1e6 * length:.3g} um"
    if abs(length) < SMALLEST_IN_METRES:
        return f"{1e3 * length:.3g} mm"
    return f"{length:.3g} m"


def choose_ticks(scale: Scale, count: int = 6) -> tuple[list[tuple[float, str]], str]:
    """Return round values of a scale and its title, in a unit in which the numbers are short.
    `count`: about how many there should be. Returns where each one lies, 0 for the first colour to
    1 for the last, and its number; then the quantity with its unit.
    """
    low, high = scale.limits
    factor, unit = 1.0, scale.unit
    if unit == "m" and max(abs(low), abs(high)) < SMALLEST_IN_METRES:
        factor, unit = 1e3, "mm"
    values = choose_round_values(low * factor, high * factor, count)
    step = values[1] - values[0] if len(values) > 1 else (high - low) * factor
    places = np.interp(values / factor, scale.values, np.linspace(0, 1, PALETTE_SIZE))
    digits = max(0, -int(np.floor(np.log10(step))))
    labels = [
        f"{value:.1e}".replace("e+0", "e") if abs(value) >= 1e4 else f"{value:.{digits}f}"
        for value in values + 0.0  # no -0
    ]
    title = f"{scale.quantity} ({unit})" if unit else scale.quantity
    return list(zip(places.tolist(), labels, strict=True)), title


def choose_round_values(low: float, high: float, count: int) -> NDArray[np.float64]:
    """Return at most about `count` round values, evenly apart, between two limits."""
    if not high > low:
        return np.array([low])
    step = 10.0 ** np.floor(np.log10((high - low) / count))
    # the smallest of 1, 2, 5 and 10 times a power of ten that gives no more than asked for
    step *= next(nice for nice in (1, 2, 5, 10) if (high - low) / (nice * step) <= count)
    return np.asarray(step * np.arange(np.ceil(low / step), np.floor(high / step) + 1))


def make_scale(cloud: PointCloud, colouring: Colouring) -> Scale:
    """Return the scale of a cloud's colours."""
    quantity = QUANTITIES[colouring.quantity]
    values = quantity.extract(cloud)
    low, high = colouring.limits or _find_limits(values)
    scale = np.linspace(low, high, PALETTE_SIZE)
    inside = values[(values >= low) & (values <= high)]
    if colouring.equalised and inside.size:
        thinned = inside[:: max(1, inside.size // MAX_RANKED_POINTS)].astype(np.float64)
        scale = np.quantile(thinned, np.linspace(0, 1, PALETTE_SIZE))
        scale[0], scale[-1] = low, high
    return Scale(colouring.quantity, quantity.unit, colouring.palette, scale)


def colour_points(cloud: PointCloud, scale: Scale, brightest: float = 0.0) -> NDArray[np.uint8]:
    """Return each point's red, green and blue, (n, 3)."""
    colours = scale.colours(QUANTITIES[scale.quantity].extract(cloud))
    # Intensity is in the colour already.
    if brightest <= 0 or scale.quantity == "intensity":
        return colours
    light = np.clip(cloud.intensity / np.float32(brightest), 0, 1) ** np.float32(GAMMA)
    shade = MIN_SHADE + (1 - MIN_SHADE) * light
    return np.asarray(colours * shade[:, np.newaxis], np.uint8)


def find_full_light(cloud: PointCloud) -> float:
    """Return the intensity that is drawn in full light; 0 where all points are alike."""
    if len(cloud) == 0 or np.ptp(cloud.intensity) == 0:
        return 0.0
    return float(np.percentile(cloud.intensity, FULL_LIGHT_PERCENTILE))


@functools.cache
def load_palette(name: str) -> NDArray[np.uint8]:
    """Return the colours of a palette, (256, 3)."""
    from matplotlib import colormaps

    ends = TURBO_ENDS if name == "turbo" else (0.0, 1.0)
    table = colormaps["gray" if name == "grey" else name](np.linspace(*ends, PALETTE_SIZE))
    return np.ascontiguousarray(np.rint(255 * table[:, :3]), dtype=np.uint8)


def _find_limits(values: NDArray[Any]) -> tuple[float, float]:
    """Limits of colours that show nearly all values, never equal."""
    if values.size == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(values, LIMIT_PERCENTILES))
    if high - low > 1e-6 * max(abs(low), abs(high)):
        return low, high
    # All values alike, to rounding: any width will do but zero.
    return low - 0.5, low + 0.5


# rad; a click that misses every point by more, 10 pixels on a usual screen, means none of them
MAX_MISS_RAD = 0.012
CLOSE_MISS_RAD = 0.004  # rad; of all points missed by less, the nearest one is in front


@dataclass(frozen=True)
class Pick:
    """A point that was chosen."""

    position: tuple[float, float, float]  # x, y, z in m
    range: float  # m; the confidence is one standard deviation of the range
    confidence: float  # m; the confidence is one standard deviation of the range
    intensity: float  # counts, referred to 1 m
    return_number: int
    time: float  # time of flight, s
    pixel: tuple[int, int] | None = None  # row and column that saw it
    waveform: Waveform | None = None  # that pixel's signal over time
    # time of flight of every return that was found in that pixel and is shown, s
    return_times: tuple[float, ...] = ()

    @property
    def description(self) -> str:
        """One line for each thing that is known."""
        x, y, z = self.position
        lines = [
            f"x {x:.4f}, y {y:.4f}, z {z:.4f} m",
            f"range {self.range:.4f} m ± {format_length(self.confidence)}",
            f"{self.time / NANOSECOND:.3f} ns, {self.intensity:.4g} counts, return {self.return_number}",
        ]
        if self.pixel is not None:
            lines.append(f"pixel row {self.pixel[0]}, column {self.pixel[1]}")
        return "\n".join(lines)


def find_point_on_ray(
    xyz: NDArray[np.float32], origin: ArrayLike, direction: ArrayLike
) -> int | None:
    """Return the number of the point that a ray from the eye hits, None where it hits none.

    Of the points that the ray misses closely the one nearest to the eye is meant; with none so
    close, the one missed by the smallest angle.

    `xyz` (n, 3): m; `origin, direction` (3,): of the ray, in the same frame.
    """
    along = np.asarray(direction, dtype=np.float64)
    away = xyz - np.asarray(origin, dtype=np.float64)
    depth = away @ (along / np.linalg.norm(along))
    square = np.einsum("ij,ij->i", away, away)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Tangent of the angle by which a point is missed; rounding may make the square negative.
        miss = np.sqrt(np.maximum(square - depth**2, 0)) / depth
    miss[~(depth > 0)] = np.inf  # behind the eye
    close = np.flatnonzero(miss < CLOSE_MISS_RAD)
    if close.size:
        return int(close[np.argmin(depth[close])])
    if miss.size == 0 or miss.min() > MAX_MISS_RAD:
        return None
    return int(np.argmin(miss))


def make_pick(cloud: PointCloud, number: int) -> Pick:
    """Return what is known about point `number` of a cloud."""
    x, y, z = (float(value) for value in cloud.xyz[number])
    return Pick(
        (x, y, z),
        float(cloud.range[number]),
        float(cloud.range_sigma[number]),
        float(cloud.intensity[number]),
        int(cloud.return_number[number]),
        float(cloud.time[number]),
    )


def measure_distance(first: Pick, second: Pick) -> float:
    """Distance of two points, m."""
    return float(np.linalg.norm(np.subtract(first.position, second.position)))


PICTURE_WHITE_PERCENTILE = 99.7  # percent: a glint does not darken the rest
PICTURE_GAMMA = 0.6  # far objects stay visible beside near ones
EMPTY_COLOUR = (32, 36, 44)
FRONT_SIDE_PX = 128
MAX_SIDE_PX = 420
MIN_SIDE_PX = 200

Picture = NDArray[np.float32]
Image = NDArray[np.uint8]


def render_pictures(pictures: Mapping[str, Picture], scale: Scale) -> dict[str, Image]:
    """Turn pictures into images of a handy size. `pictures`: ``"depth"`` is in m, NaN where there
    is nothing; all others are brightness; `scale`: the scene's colours.
    """
    return {
        name: resize_image(
            colour_depth(picture, scale)
            if name == "depth"
            else colour_brightness(
                picture, scale.palette if scale.quantity == "intensity" else "grey"
            )
        )
        for name, picture in pictures.items()
    }


def project_front(cloud: PointCloud) -> dict[str, Picture]:
    """Return intensity and depth as seen from the origin along z, 128 x 128, of a cloud that has no
    camera.
    """
    if len(cloud) == 0:
        empty = np.full((FRONT_SIDE_PX, FRONT_SIDE_PX), np.nan, np.float32)
        return {"intensity": np.zeros_like(empty), "depth": empty}
    low, high = np.percentile(cloud.xyz[:, :2], (0.5, 99.5), axis=0)
    middle, width = (low + high) / 2, max(float((high - low).max()), 1e-6)
    place = np.rint(((cloud.xyz[:, :2] - middle) / width + 0.5) * (FRONT_SIDE_PX - 1)).astype(
        np.intp
    )
    inside = np.flatnonzero(np.all((place >= 0) & (place < FRONT_SIDE_PX), axis=1))
    order = inside[np.argsort(-cloud.xyz[inside, 2], kind="stable")]  # the nearest is written last
    depth = np.full((FRONT_SIDE_PX, FRONT_SIDE_PX), np.nan, np.float32)
    light = np.zeros_like(depth)
    column, row = place[order].T
    depth[row, column], light[row, column] = cloud.xyz[order, 2], cloud.intensity[order]
    _close_seams(depth, light)
    return {"intensity": light, "depth": depth}


def _close_seams(depth: Picture, light: Picture) -> None:
    """Fill, in place, empty pixels between two seen ones of a row or a column: a camera with fewer
    pixels than the picture leaves such seams.
    """
    for deep, bright in ((depth, light), (depth.T, light.T)):
        before, here, after = deep[:-2], deep[1:-1], deep[2:]
        seam = np.isnan(here) & np.isfinite(before) & np.isfinite(after)
        nearer = before <= after
        here[seam] = np.where(nearer, before, after)[seam]
        bright[1:-1][seam] = np.where(nearer, bright[:-2], bright[2:])[seam]


def colour_brightness(picture: Picture, palette: str) -> Image:
    """Colour a picture by its brightness, negative values as dark."""
    light = np.maximum(np.nan_to_num(picture), 0)
    top = float(np.percentile(light, PICTURE_WHITE_PERCENTILE)) or float(light.max()) or 1.0
    toned = np.clip(light / np.float32(top), 0, 1) ** np.float32(PICTURE_GAMMA)
    return load_palette(palette)[(255 * toned).astype(np.intp)]


def colour_depth(picture: Picture, scale: Scale) -> Image:
    """Colour a picture of distances; NaN becomes a dark grey. `picture` (rows, columns): metres;
    `scale`: taken where it is one of ranges; else the colours run from the 1st to the 99th
    percentile. Returns (rows, columns, 3).
    """
    image = np.empty((*picture.shape, 3), np.uint8)
    image[:] = EMPTY_COLOUR
    there = np.isfinite(picture)
    if there.any():
        if scale.quantity != "range":
            low, high = np.percentile(picture[there], (1, 99))
            scale = Scale(
                "range", "m", scale.palette, np.linspace(low, max(high, low + 1e-9), PALETTE_SIZE)
            )
        image[there] = scale.colours(picture[there])
    return image


def resize_image(image: Image) -> Image:
    """Shrink a large image by taking every n-th pixel, enlarge a small one by repeating its pixels."""
    steps = [max(1, -(-side // MAX_SIDE_PX)) for side in image.shape[:2]]
    thinned = image[:: steps[0], :: steps[1]]
    times = max(1, MIN_SIDE_PX // max(thinned.shape[:2]))
    return np.ascontiguousarray(thinned.repeat(times, axis=0).repeat(times, axis=1))
