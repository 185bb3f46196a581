"""How points look and which one is meant: colours that say a quantity, a click's point, and flat pictures
beside the scene.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from apps.figures.style import tone_map
from apps.viewer.source import Limits, Picture, View
from tofclip.arrays import AnyArray, Float32Array, FloatArray
from tofclip.errors import InputError
from tofclip.lidar import PointCloud
from tofclip.units import NANOSECOND

Image = NDArray[np.uint8]  # (rows, columns, 3)

PALETTE_SIZE = 256  # colours of a palette, and entries of a scale
# percentiles between which colours are spread unless limits are set: a glint does not darken the
# rest
LIMIT_PERCENTILES = (1.0, 99.0)
FULL_LIGHT_PERCENTILE = 85.0  # of the intensity, from which points are drawn in full light
MIN_SHADE, GAMMA = 0.15, 0.8
# m; lengths below the one are in mm, below the other in um
SMALLEST_IN_METRES, SMALLEST_IN_MILLIMETRES = 0.1, 1e-4
# points from which an equalised scale is made; more would cost time and change nothing to be seen
MAX_RANKED_POINTS = 100_000
# all but turbo are perceptually uniform
PALETTES = ("viridis", "cividis", "inferno", "magma", "plasma", "turbo", "grey")
# turbo's darkest blue and red are left out: shaded, the nearest and the farthest would be black
TURBO_ENDS = 0.09, 0.93


# what points are coloured and filtered by: its unit, and how it is taken from a view, (n,); heights
# count upwards from the camera, though y points down
QUANTITIES: Mapping[str, tuple[str, Callable[[View], AnyArray]]] = {
    "range": ("m", lambda view: view.cloud.range),
    "height": ("m", lambda view: -view.cloud.xyz[:, 1]),
    "intensity": ("counts", lambda view: view.cloud.intensity),
    "brightness": ("", lambda view: view.cloud.intensity),  # of hidden scenes: no photons
    "standard deviation": ("m", lambda view: view.cloud.range_sigma),
    "return number": ("", lambda view: view.cloud.return_number),
    "time": ("ns", lambda view: view.cloud.time / np.float32(NANOSECOND)),
    "false alarm": ("", lambda view: view.cloud.false_alarm),
    "layer": ("", lambda view: view.layers),
    "x": ("m", lambda view: view.cloud.xyz[:, 0]),
    "y": ("m", lambda view: view.cloud.xyz[:, 1]),
    "z": ("m", lambda view: view.cloud.xyz[:, 2]),
}


def list_quantities(view: View, first: str = "range") -> tuple[str, ...]:
    """Return what the points of a view have; `first`: what says most about them."""
    missing = {"intensity" if first == "brightness" else "brightness"}
    missing |= set() if np.isfinite(view.cloud.false_alarm).any() else {"false alarm"}
    missing |= set() if view.layers.size else {"layer"}
    return tuple(name for name in QUANTITIES if name not in missing)


@dataclass(frozen=True)
class Colouring:
    """How points are coloured."""

    quantity: str = "range"  # one of `QUANTITIES`
    palette: str = "viridis"  # one of `PALETTES`
    # values of the first and the last colour, in the quantity's unit; `LIMIT_PERCENTILES`
    # percentiles by default
    limits: Limits | None = None
    # whether every colour is given to equally many points, instead of to an equal span of values
    equalised: bool = False
    # whether dim points are drawn darker, so that what is written on a surface can be read in
    # colours of range
    shaded: bool = False

    def __post_init__(self) -> None:
        low, high = self.limits or (0.0, 1.0)
        if not -np.inf < low < high < np.inf:
            raise InputError(f"the limits of the colours must rise, got {low} and {high}")


@functools.cache
def load_palette(name: str) -> NDArray[np.uint8]:
    """Return the colours of a palette, (256, 3)."""
    from matplotlib import colormaps

    ends = TURBO_ENDS if name == "turbo" else (0.0, 1.0)
    table = colormaps["gray" if name == "grey" else name](np.linspace(*ends, PALETTE_SIZE))
    return np.ascontiguousarray(np.rint(255 * table[:, :3]), dtype=np.uint8)


@dataclass(frozen=True)
class Scale:
    """What the colours mean."""

    quantity: str
    unit: str
    palette: str
    values: FloatArray  # (256,), value of each colour, rising
    full_light: float = 0.0  # intensity from which on points are not shaded; 0 where none are

    @property
    def limits(self) -> Limits:
        return self.values[0], self.values[-1]

    @property
    def factor(self) -> float:
        """What its values are multiplied with where they are written: 1000 where they are in mm."""
        is_small = self.unit == "m" and max(map(abs, self.limits)) < SMALLEST_IN_METRES
        return 1e3 if is_small else 1.0

    @property
    def title(self) -> str:
        unit = "mm" if self.factor > 1 else self.unit
        return f"{self.quantity} ({unit})" if unit else self.quantity

    def colours(self, values: AnyArray) -> NDArray[np.uint8]:
        """Return red, green and blue, (n, 3); values beyond the limits get the outermost colours."""
        low, high = self.limits
        steps = PALETTE_SIZE - 1
        # An even scale needs no search: the number of the colour is a product.
        if np.allclose(np.diff(self.values), (high - low) / steps, rtol=1e-6, atol=0):
            even = np.clip(values, low, high) - np.float32(low)
            number = np.rint(even * np.float32(steps / (high - low))).astype(np.intp)
        else:
            number = np.clip(np.searchsorted(self.values, values, side="right") - 1, 0, steps)
        return load_palette(self.palette)[number]


def make_scale(view: View, colouring: Colouring) -> Scale:
    """Return the scale of a view's colours."""
    unit, extract = QUANTITIES[colouring.quantity]
    values, cloud = extract(view), view.cloud
    low, high = colouring.limits or _find_limits(values)
    scale = np.linspace(low, high, PALETTE_SIZE)
    inside = values[(values >= low) & (values <= high)]
    if colouring.equalised and inside.size:
        thinned = inside[:: max(1, inside.size // MAX_RANKED_POINTS)].astype(np.float64)
        scale = np.quantile(thinned, np.linspace(0, 1, PALETTE_SIZE))
        scale[0], scale[-1] = low, high
    full_light = 0.0
    # Intensity is in the colour already.
    is_plain = not colouring.shaded or extract is QUANTITIES["intensity"][1] or len(cloud) == 0
    if not is_plain and np.ptp(cloud.intensity) > 0:
        full_light = float(np.percentile(cloud.intensity, FULL_LIGHT_PERCENTILE))
    return Scale(colouring.quantity, unit, colouring.palette, scale, full_light)


def _find_limits(values: AnyArray) -> Limits:
    """Limits of colours that show nearly all values, never equal."""
    if values.size == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(values, LIMIT_PERCENTILES))
    if high - low > 1e-6 * max(abs(low), abs(high)):
        return low, high
    return low - 0.5, low + 0.5  # all values alike, to rounding: any width will do but zero


def colour_points(view: View, scale: Scale) -> NDArray[np.uint8]:
    """Return each point's red, green and blue, (n, 3)."""
    colours = scale.colours(QUANTITIES[scale.quantity][1](view))
    if scale.full_light <= 0:
        return colours
    light = np.clip(view.cloud.intensity / np.float32(scale.full_light), 0, 1) ** np.float32(GAMMA)
    shade = MIN_SHADE + (1 - MIN_SHADE) * light
    return np.asarray(colours * shade[:, np.newaxis], np.uint8)


def format_length(length: float) -> str:
    """Return a length in m as a person writes it: ``0.42 mm``, ``31 mm``, ``1.85 m``."""
    if 0 < abs(length) < SMALLEST_IN_MILLIMETRES:
        return f"{1e6 * length:.3g} um"
    if abs(length) < SMALLEST_IN_METRES:
        return f"{1e3 * length:.3g} mm"
    return f"{length:.3g} m"


def choose_ticks(scale: Scale, count: int = 6) -> tuple[list[tuple[float, str]], str]:
    """Return about `count` round values of a scale, where each lies from 0 to 1, and its title."""
    (low, high), factor = scale.limits, scale.factor
    values = choose_round_values(low * factor, high * factor, count)
    step = values[1] - values[0] if len(values) > 1 else (high - low) * factor
    places = np.interp(values / factor, scale.values, np.linspace(0, 1, PALETTE_SIZE))
    digits = max(0, -int(np.floor(np.log10(step))))
    labels = [
        f"{value:.1e}".replace("e+0", "e") if abs(value) >= 1e4 else f"{value:.{digits}f}"
        for value in values + 0.0  # no -0
    ]
    return list(zip(places.tolist(), labels, strict=True)), scale.title


def choose_round_values(low: float, high: float, count: int) -> FloatArray:
    """Return at most about `count` round values, evenly apart, between two limits."""
    if not high > low:
        return np.array([low])
    ticks = MaxNLocator(count, steps=(1, 2, 5, 10), min_n_ticks=1).tick_values(low, high)
    values = np.asarray(ticks, np.float64)
    return values[(values >= low) & (values <= high)]


# rad; a click that misses every point by more, 10 pixels on a usual screen, means none of them
MAX_MISS_RAD = 0.012
CLOSE_MISS_RAD = 0.004  # rad; of all points missed by less, the nearest one is in front


@dataclass(frozen=True)
class Pick:
    """A point that was chosen."""

    point: PointCloud  # of this one
    pixel: tuple[int, int] | None = None  # row and column that saw it
    waveform: FloatArray | None = None  # (2, n), times of flight, s, and counts of that pixel
    # (k,), time of flight of every return that was found in that pixel and is shown, s
    return_times: AnyArray | None = None

    @property
    def position(self) -> Float32Array:
        return self.point.xyz[0]

    @property
    def description(self) -> str:
        """One line for each thing that is known."""
        (x, y, z), point = self.position, self.point
        return_text = f"intensity {point.intensity[0]:,.0f}, return {point.return_number[0]}"
        lines = [
            f"x {x:.4f}, y {y:.4f}, z {z:.4f} m",
            # give or take one standard deviation
            f"range {point.range[0]:.4f} m ± {format_length(point.range_sigma[0])}",
            f"{point.time[0] / NANOSECOND:.3f} ns, {return_text}",
        ]
        if self.pixel is not None:
            lines.append(f"pixel row {self.pixel[0] + 1}, column {self.pixel[1] + 1}")
        return "\n".join(lines)


def find_point_on_ray(xyz: Float32Array, origin: ArrayLike, direction: ArrayLike) -> int | None:
    """Return the number of the point (n, 3), m, that a ray from the eye hits, None where it hits
    none. Of the points that the ray misses closely the one nearest to the eye is meant; with none
    so close, the one missed by the smallest angle.
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
        return close[np.argmin(depth[close])]
    return int(np.argmin(miss)) if miss.size and miss.min() <= MAX_MISS_RAD else None


PICTURE_GAMMA = 0.6  # far objects stay visible beside near ones
EMPTY_COLOUR = (32, 36, 44)
FRONT_SIDE_PX, MIN_SIDE_PX, MAX_SIDE_PX = 128, 200, 420


def render_pictures(pictures: Mapping[str, Picture], scale: Scale) -> dict[str, Image]:
    """Turn pictures into images of a handy size. `pictures`: ``"depth"``, or a layer's ``"2 depth"``, is
    in m, NaN where there is nothing; all others are brightness; `scale`: the scene's colours.
    """
    images = {}
    for name, picture in pictures.items():
        image = (_colour_depth if name.endswith("depth") else _colour_brightness)(picture, scale)
        # A large one is shrunk by taking every n-th pixel, a small one enlarged by repeating them.
        rows, columns = (slice(None, None, max(1, -(-n // MAX_SIDE_PX))) for n in picture.shape)
        image = image[rows, columns]
        times = max(1, MIN_SIDE_PX // max(image.shape[:2]))
        images[name] = np.ascontiguousarray(image.repeat(times, axis=0).repeat(times, axis=1))
    return images


def _colour_brightness(picture: Picture, scale: Scale) -> Image:
    """Colour a picture by its brightness, negative values as dark."""
    toned = tone_map(np.maximum(np.nan_to_num(picture), 0), PICTURE_GAMMA)
    palette = load_palette(scale.palette if scale.quantity == "intensity" else "grey")
    return palette[(255 * toned).astype(np.intp)]


def _colour_depth(picture: Picture, scale: Scale) -> Image:
    """Colour distances, m, by a scale of ranges, else by percentiles; NaN is grey."""
    image = np.full((*picture.shape, 3), EMPTY_COLOUR, np.uint8)
    there = np.isfinite(picture)
    if there.any():
        if scale.quantity != "range":
            low, high = np.percentile(picture[there], LIMIT_PERCENTILES)
            values = np.linspace(low, max(high, low + 1e-9), PALETTE_SIZE)
            scale = Scale("range", "m", Colouring.palette, values)
        image[there] = scale.colours(picture[there])
    return image


def project_front(cloud: PointCloud) -> dict[str, Picture]:
    """Return intensity and depth from the origin along z of a cloud that has no camera."""
    depth = np.full((FRONT_SIDE_PX, FRONT_SIDE_PX), np.nan, np.float32)
    light = np.zeros_like(depth)
    if len(cloud) == 0:
        return {"intensity": light, "depth": depth}
    low, high = np.percentile(cloud.xyz[:, :2], (0.5, 99.5), axis=0)
    middle, width = (low + high) / 2, max(float((high - low).max()), 1e-6)
    across = ((cloud.xyz[:, :2] - middle) / width + 0.5) * (FRONT_SIDE_PX - 1)
    place = np.rint(across).astype(np.intp)
    inside = np.flatnonzero(np.all((place >= 0) & (place < FRONT_SIDE_PX), axis=1))
    order = inside[np.argsort(-cloud.xyz[inside, 2], kind="stable")]  # the nearest is written last
    column, row = place[order].T
    depth[row, column], light[row, column] = cloud.xyz[order, 2], cloud.intensity[order]
    # Empty pixels between two seen ones of a column or a row are filled: a camera with fewer pixels
    # than the picture leaves such seams.
    for deep, bright in ((depth, light), (depth.T, light.T)):
        before, here, after = deep[:-2], deep[1:-1], deep[2:]
        seam = np.isnan(here) & np.isfinite(before) & np.isfinite(after)
        nearer = before <= after
        here[seam] = np.where(nearer, before, after)[seam]
        bright[1:-1][seam] = np.where(nearer, bright[:-2], bright[2:])[seam]
    return {"intensity": light, "depth": depth}
