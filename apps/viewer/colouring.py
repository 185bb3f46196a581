"""Colours that say a quantity: which one, in which colours, between which limits."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.lidar import PointCloud
from tofclip.units import NANOSECOND

PALETTE_SIZE = 256
"""Colours of a palette, and entries of a scale."""

LIMIT_PERCENTILES = (1.0, 99.0)
"""Percentiles between which colours are spread unless limits are set: a glint does not darken
the rest.
"""

FULL_LIGHT_PERCENTILE = 85.0
"""Percentile of the intensity from which points are drawn in full light."""

MIN_SHADE = 0.15
GAMMA = 0.8

SMALLEST_IN_METRES, SMALLEST_IN_MILLIMETRES = 0.1, 1e-4
"""m; lengths below the one are in mm, below the other in um."""

MAX_RANKED_POINTS = 100_000
"""Points from which an equalised scale is made; more would cost time and change nothing to be seen."""

PALETTES = ("viridis", "cividis", "inferno", "magma", "plasma", "turbo", "grey")
"""All but turbo are perceptually uniform; turbo separates most ranges."""

TURBO_ENDS = 0.09, 0.93
"""Turbo's darkest blue and red are left out: shaded, the nearest and the farthest would be black."""


@dataclass(frozen=True)
class Quantity:
    """Something that every point has."""

    unit: str  # of what `extract` returns
    extract: Callable[[PointCloud], NDArray[Any]]  # takes a cloud, returns (n,) numbers


QUANTITIES: Mapping[str, Quantity] = {
    "range": Quantity("m", lambda cloud: cloud.range),
    "height": Quantity("m", lambda cloud: -cloud.xyz[:, 1]),
    "intensity": Quantity("counts", lambda cloud: cloud.intensity),
    "standard deviation": Quantity("m", lambda cloud: cloud.range_sigma),
    "return number": Quantity("", lambda cloud: cloud.return_number),
    "time": Quantity("ns", lambda cloud: cloud.time / np.float32(NANOSECOND)),
}
"""Heights count upwards from the camera, though y points down."""


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
    """Return at most about `count` round values, evenly apart, between two limits.

    `low, high`: rising, or equal. Returns (n,).
    """
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
    """Return each point's red, green and blue, (n, 3).

    `brightest`: intensity that is drawn in full light, less of it darker; 0 for no shading. Returns
    (n, 3).
    """
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
