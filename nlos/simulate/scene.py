"""Hidden scenes, lit and seen by way of a wall: points that scatter evenly, whose image is known
exactly; and surfaces that hide one another, small flat facets of known place, direction and
material; and photon noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.linalg import norm

from nlos.capture import Capture, TimeAxis
from nlos.simulate.kernels import add_facet_light
from nlos.simulate.walls import compute_wall_normals
from tofclip.arrays import FloatArray, require_numpy
from tofclip.errors import FileFormatError, InputError, ShapeError, require, require_positive
from tofclip.files import format_error_line, translate_read_errors
from tofclip.threads import run_blocks
from tofclip.units import SPEED_OF_LIGHT


def add_poisson_noise(
    capture: Capture, peak_counts: float, background: float = 0.0, seed: int = 0
) -> Capture:
    """Draw Poisson counts of an expected signal, which is nowhere negative.

    Parameters
    ----------
    capture : Capture
    peak_counts : float
        Expected counts in the brightest bin, without background.
    background : float
        Expected counts of background, added to every bin.
    seed : int
        Of the random numbers; recorded in the provenance.

    Raises
    ------
    InputError
        The peak is not positive, the background negative, or the signal negative or dark.
    """
    if not (0 < peak_counts < np.inf and 0 <= background < np.inf):
        raise InputError(
            f"counts need a positive peak and a background of 0 or more, got {peak_counts}, {background}"
        )
    require_numpy("drawing photons", capture.signal)
    brightest = float(capture.signal.max())
    if brightest <= 0 or float(capture.signal.min()) < 0:
        raise InputError(
            "photons can only be drawn from a signal that is nowhere negative and not all dark"
        )
    expected = capture.signal * (peak_counts / brightest) + background
    signal = np.random.default_rng(seed).poisson(expected).astype(np.float32)
    noise = {"peak_counts": peak_counts, "background": background, "seed": seed}
    return replace(capture, signal=signal, provenance={**capture.provenance, "noise": noise})


@dataclass(frozen=True, eq=False)
class PointScene:
    """Hidden points that scatter evenly in all directions, see each other not, and hide nothing.

    A point of albedo a, at distance d_L from the laser spot and d_p from wall point p, returns ``a
    / (d_L * d_p)^2`` after a path of ``d_L + d_p``. No grid of voxels takes part, so the simulation
    shares nothing with a method that images it.

    Parameters
    ----------
    positions : (n, 3) array
        m.
    albedo : (n,) array, optional
        Defaults to 1.
    """

    positions: FloatArray
    albedo: FloatArray | None = None

    def __post_init__(self) -> None:
        positions = np.atleast_2d(np.asarray(self.positions, dtype=np.float64))
        albedo = np.ones(len(positions)) if self.albedo is None else self.albedo
        albedo = np.asarray(albedo, dtype=np.float64)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ShapeError("positions of hidden points", "(n, 3)", positions.shape)
        if albedo.shape != (len(positions),):
            raise ShapeError("albedo", (len(positions),), albedo.shape)
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "albedo", albedo)

    def simulate_capture(self, wall: Any, laser: Any, axis: TimeAxis, jitter: float) -> Capture:
        """Simulate a capture without noise.

        Parameters
        ----------
        wall : (..., 3) array
            Wall points, m; where one is NaN, its signal is 0.
        laser : (3,) or (..., 3) array
            Laser spot, m, or one per wall point.
        axis : TimeAxis
        jitter : float
            Standard deviation of the instrument's Gaussian response, s, more than 0; its integral over
            every time bin is exact.
        """
        from scipy.special import ndtr

        dark = _make_dark_capture(wall, laser, axis, jitter)
        signal = np.zeros(dark.signal.shape)
        # bin i is centred on its path
        edges = axis.start + axis.spacing * (np.arange(axis.bins + 1) - 0.5)
        edges = edges.reshape(-1, *[1] * (signal.ndim - 1))
        for position, albedo in zip(self.positions, np.asarray(self.albedo), strict=True):
            outward = norm(dark.laser - position, axis=-1)
            back = norm(dark.wall - position, axis=-1)
            below = ndtr((edges - (outward + back)) / (SPEED_OF_LIGHT * jitter))
            signal += albedo / (outward * back) ** 2 * np.diff(below, axis=0)
        return replace(dark, signal=np.nan_to_num(signal))


def _make_dark_capture(wall: Any, laser: Any, axis: TimeAxis, jitter: float) -> Capture:
    require_positive("jitter", jitter, "number of seconds")
    wall = np.asarray(wall, dtype=np.float64)
    dark = np.zeros((axis.bins, *wall.shape[:-1]), np.float32)
    return Capture(dark, wall, laser, axis.bin_width, axis.start)


@dataclass(frozen=True)
class Material:
    """Reflectance ``diffuse / pi + retro * exp(-angle^2 / (2 * spread^2)) / (2 * pi * spread^2)``
    per steradian, `angle` that between the directions towards the light and towards the observer.

    Parameters
    ----------
    diffuse : float
        Fraction of light that is scattered evenly (Lambert's law), 0 to 1.
    retro : float
        Fraction that goes back to where it came from, 0 to 1.
    spread : float
        Standard deviation of the latter about the way back, rad.
    """

    diffuse: float = 1.0
    retro: float = 0.0
    spread: float = 1.0

    def __post_init__(self) -> None:
        for albedo in (self.diffuse, self.retro):
            require(0 <= albedo <= 1, f"an albedo is a share between 0 and 1, got {albedo}")
        require_positive("the spread of a retroreflector", self.spread, "angle")


class Lambert(Material):
    """Scatters evenly: paper, plaster, cloth; of the light a fraction `albedo` comes back."""

    def __init__(self, albedo: float = 1.0) -> None:
        super().__init__(albedo)


class Retroreflector(Material):
    """Sends light back to where it came from: traffic signs, safety vests; a fraction `albedo`, with a
    standard deviation `spread` about the way back, rad.
    """

    def __init__(self, albedo: float = 1.0, spread: float = 0.1) -> None:
        super().__init__(0.0, albedo, spread)


TOWARDS_WALL = (0.0, 0.0, -1.0)
# A surface is refused rather than cut into more.
MAX_FACETS = 200_000


@dataclass(frozen=True, eq=False)
class Surface:
    """Facets of one material.

    Parameters
    ----------
    positions, normals : (n, 3) array
        Centres in m, and unit normals; light is scattered on the normal's side only.
    areas : (n,) array
        m^2.
    material : Material
    triangles : (m, 3, 3) array, optional
        Corners of the triangles that hide what lies behind them, m; none by default.
    """

    positions: FloatArray
    normals: FloatArray
    areas: FloatArray
    material: Material
    triangles: FloatArray

    @classmethod
    def mesh(
        cls, vertices: Any, faces: Any, spacing: float, material: Material | None = None
    ) -> Surface:
        """Cut a triangle mesh into facets.

        Parameters
        ----------
        vertices : (v, 3) array
            m; finite.
        faces : (m, 3) int array
            Corners of each triangle, counter-clockwise as seen from the side that scatters.
        spacing : float
            Largest distance of neighbouring facets, m: a quarter of what the capture resolves is
            enough.
        material : Material, optional
            White Lambert by default.

        Raises
        ------
        ShapeError, InputError
            Arrays of other shapes, faces that name no vertex, or a spacing that is not positive.
        """
        vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
        shapes = vertices.shape, faces.shape
        if any(len(shape) != 2 or shape[1] != 3 for shape in shapes):
            raise ShapeError("vertices and faces", "(v, 3) and (m, 3)", shapes)
        known = faces.dtype.kind in "ui" and np.all((faces >= 0) & (faces < len(vertices)))
        if not (known and faces.size):
            raise InputError("faces must name vertices by their index, and there must be one")
        if not (0 < spacing < np.inf and np.all(np.isfinite(vertices))):
            raise InputError(f"a mesh needs finite vertices and a positive spacing, got {spacing}")
        triangles = vertices[faces]
        positions, crosses, areas = _subdivide_triangles(triangles, spacing)
        normals = crosses / norm(crosses, axis=1, keepdims=True)
        return cls(positions, normals, areas, material or Lambert(), triangles)

    @classmethod
    def load(cls, path: str | Path, spacing: float, material: Material | None = None) -> Surface:
        """Read a mesh in m (PLY, OBJ, STL, VTP) from ``path`` by PyVista and cut it into facets; ``spacing``
        and ``material`` as of `mesh`. `FileFormatError`: it is no triangle mesh, or holds no triangle.
        """
        import pyvista

        with translate_read_errors(path), open(path, "rb"):
            try:
                mesh = pyvista.read(path).triangulate()
                vertices, faces = np.asarray(mesh.points), np.asarray(mesh.regular_faces)
            except Exception as fault:  # whatever the decoder stumbles over, the file is not a mesh
                raise FileFormatError(
                    path, f"is not a triangle mesh ({format_error_line(fault)})"
                ) from fault
        if not len(faces):
            raise FileFormatError(path, "holds no triangles")
        return cls.mesh(vertices, faces, spacing, material)

    @classmethod
    def rectangle(
        cls,
        centre: Any,
        size: tuple[float, float],
        spacing: float,
        material: Material | None = None,
    ) -> Surface:
        """Build a rectangle that faces the wall, of a ``size`` (width, height) in m about its ``centre``
        (x, y, z); ``spacing`` and ``material`` as of `mesh`.
        """
        x, y = size[0] / 2, size[1] / 2
        # Counter-clockwise from the wall, which looks along +z with y down.
        corners = np.array([[-x, -y, 0], [-x, y, 0], [x, y, 0], [x, -y, 0]]) + centre
        return cls.mesh(corners, [[0, 1, 2], [0, 2, 3]], spacing, material)

    @classmethod
    def letters(
        cls, text: str, centre: Any, height: float, spacing: float, material: Material | None = None
    ) -> Surface:
        """Cut flat letters out of square facets that face the wall.

        Parameters
        ----------
        text : str
            Read from the wall, looking along +z.
        centre : (3,) array
            Middle of the text, m.
        height, spacing : float
            Of a capital, and the side of a facet, m.
        material : Material, optional
            White Lambert by default.

        Raises
        ------
        InputError
            The letters have no facet at this spacing, or more than `MAX_FACETS`; or the height is
            not positive.
        """
        require_positive("the height of letters", height, "number of metres")
        x, y = _rasterize_letters(text, height, spacing)
        require(x.size != 0, f"'{text}' has no ink at a spacing of {spacing} m")
        positions = np.stack([x, y, 0 * x], axis=-1) + np.asarray(centre, dtype=np.float64)
        normals = np.tile(TOWARDS_WALL, (x.size, 1))
        half = spacing / 2 * np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]])
        corners = positions[:, np.newaxis] + half
        triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
        areas = np.full(x.size, spacing**2)
        return cls(positions, normals, areas, material or Lambert(), triangles)


def _subdivide_triangles(
    triangles: FloatArray, spacing: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Halve triangles at their longest side down to `spacing`: centres, normals, areas."""
    finished: list[FloatArray] = []
    count, pending = 0, triangles
    while len(pending):
        sides = norm(np.roll(pending, -1, axis=1) - pending, axis=2)
        longest = sides.argmax(axis=1)
        small = sides.max(axis=1) <= spacing
        finished.append(pending[small])
        count += int(small.sum())
        if count + len(pending) > MAX_FACETS:
            raise InputError(
                f"the mesh needs more than {MAX_FACETS} facets at a spacing of {spacing} m; use a larger one"
            )
        # Corners are renamed in the same sense, the longest side from a to b.
        turn = (longest[~small, np.newaxis] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(pending[~small], turn[..., np.newaxis], 1).swapaxes(0, 1)
        middle = (a + b) / 2
        halves = np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)
        pending = np.concatenate(halves)
    facets = np.concatenate(finished)
    crosses = np.cross(facets[:, 1] - facets[:, 0], facets[:, 2] - facets[:, 0])
    areas = norm(crosses, axis=1) / 2
    # Facets without area, of meshes with repeated corners, have no normal.
    flat = areas > 0
    return facets[flat].mean(axis=1), crosses[flat], areas[flat]


def _rasterize_letters(text: str, height: float, spacing: float) -> tuple[FloatArray, FloatArray]:
    """Centres of the squares inside the letters' outlines, about the text's middle; y down."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.path import Path as Outline
    from matplotlib.textpath import TextPath

    font = FontProperties(family="DejaVu Sans", weight="bold")
    if not text.strip():
        return np.empty(0), np.empty(0)
    capital = TextPath((0, 0), "H", size=1, prop=font).get_extents().height
    outline: Outline = TextPath((0, 0), text, size=height / capital, prop=font)
    box = outline.get_extents()
    halves = [int(side / spacing / 2) + 1 for side in box.size]
    # Before any memory is taken: of a letter's box about a third is ink.
    if (2 * halves[0] + 1) * (2 * halves[1] + 1) > 4 * MAX_FACETS:
        raise InputError(
            f"the letters need more than {MAX_FACETS} facets at a spacing of {spacing:g} m; use a larger one"
        )
    columns, rows = (np.arange(-n, n + 1) * spacing for n in halves)
    x, y = (grid.ravel() for grid in np.meshgrid(columns, rows))
    middle = (box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2
    # Fonts have y up. Holes run the other way round, as the even-odd rule needs.
    inside = np.zeros(x.size, dtype=bool)
    for polygon in outline.to_polygons():
        inside ^= Outline(polygon).contains_points(np.stack([x + middle[0], middle[1] - y], axis=1))
    return x[inside], y[inside]


# Fine bins per time bin: light shared between two of them spreads by less than a tenth of a bin.
BIN_OVERSAMPLING = 4
POINTS_PER_BLOCK = 64
# Standard deviations at which the instrument's response is cut off.
RESPONSE_SIGMAS = 5.0


@dataclass(frozen=True, eq=False)
class HiddenScene:
    """Surfaces before a relay wall that scatters evenly (Lambert's law).

    A facet of area A and reflectance f returns, by way of laser spot r_L and to wall point r_p, ``A
    * f * cos_L * cos_in * cos_out * cos_p / (d_L * d_p)^2`` after a path of ``d_L + d_p``; the
    cosines are those of the two legs with the wall's and the facet's normals. It returns nothing
    where a triangle stands in either leg. Light that meets several surfaces is left out.

    Costs one evaluation per facet and wall point, and a test of every triangle in each; memory for
    the signals and 64 wall points on fine bins.
    """

    surfaces: Sequence[Surface]

    def __post_init__(self) -> None:
        require(self.surfaces, "a hidden scene needs a surface")

    def simulate_capture(self, wall: Any, laser: Any, axis: TimeAxis, jitter: float) -> Capture:
        """Simulate a capture without noise; ``wall``, ``laser``, ``axis`` and ``jitter`` as of
        `PointScene.simulate_capture`. Normals follow from a wall given in rows and columns; else they
        are +z. A lone laser spot gets the normal of the nearest wall point.
        """
        from scipy.ndimage import gaussian_filter1d

        dark = _make_dark_capture(wall, laser, axis, jitter)
        normals = compute_wall_normals(dark.wall)[dark.valid]
        laser_normals = normals
        if len(dark.lasers) == 1:
            # the laser spot lies on the wall: it has the normal of the wall point next to it
            nearest = int(np.argmin(norm(dark.points - dark.laser, axis=1)))
            laser_normals = normals[nearest : nearest + 1]
        sigma = SPEED_OF_LIGHT * jitter
        fine = axis.spacing / BIN_OVERSAMPLING
        # Room at both ends for light whose response reaches into the record, in whole time bins.
        margin = int(np.ceil(RESPONSE_SIGMAS * sigma / axis.spacing)) + 1
        start = axis.start - margin * axis.spacing - (BIN_OVERSAMPLING - 1) / 2 * fine
        traces = np.empty((len(dark.points), axis.bins), np.float32)
        triangles = np.concatenate([surface.triangles for surface in self.surfaces])

        def process_block(some: slice) -> None:
            bins = np.zeros((some.stop - some.start, (axis.bins + 2 * margin) * BIN_OVERSAMPLING))
            own = slice(None) if len(dark.lasers) == 1 else some
            ends = (dark.points[some], normals[some]), (dark.lasers[own], laser_normals[own])
            for surface in self.surfaces:
                stuff = surface.material
                material = np.array([stuff.diffuse, stuff.retro, stuff.spread])
                facets = surface.positions, surface.normals, surface.areas
                add_facet_light(*ends, facets, material, triangles, start, fine, bins)
            seen = gaussian_filter1d(
                bins, sigma / fine, axis=1, mode="constant", truncate=RESPONSE_SIGMAS
            )
            # fine bins, blurred by the response, are added up to the record's
            whole = seen.reshape(len(bins), -1, BIN_OVERSAMPLING).sum(axis=2)
            traces[some] = whole[:, margin : margin + axis.bins]

        run_blocks(process_block, len(traces), POINTS_PER_BLOCK)
        signal = dark.signal.copy()
        signal[:, dark.valid] = traces.T
        return replace(dark, signal=signal)
