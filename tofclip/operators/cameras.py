"""The cameras of compact light-field photography by name: which nonlocal measurements each view of a
light field gets, and the models that follow.

Lines: CLIP-1D with its line projections, and coded line-shaped point-spread functions (supplement
Notes 4 and 6). Masks and the single pixel (Note 5). A mask or a phase plate in the aperture before one
area sensor (Note 3). Views are (v, u); shears are pixels from one view to the next, and stand for a
depth.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import ClassVar

import numpy as np

from tofclip.arrays import FloatArray, IndexArray
from tofclip.errors import require, require_positive
from tofclip.operators.base import (
    BlockDiagonal,
    DenseSensor,
    Diagonal,
    HadamardCodes,
    Identity,
    Integration,
    LinearOperator,
    LinearShear,
    MeanWeighting,
    PitchedSensor,
    Stack,
    View,
    WeightedViews,
    make_sheared_mask,
)
from tofclip.operators.convolution import (
    ApertureElement,
    CodedAperture,
    CubicPhasePlate,
    Diffuser,
    MeasuredPointSpreads,
    PointSpreadConvolution,
    SliceConvolution,
    make_coded_line,
    shear_point_spreads,
    trace_view_point_spreads,
)
from tofclip.operators.sparse import RadonProjection

__all__ = [
    *("CAMERAS", "COMPRESSIVE_CAMERAS", "AshokCamera", "BabacanCamera", "CodedApertureCamera"),
    *("CodedLineCamera", "CompressiveCamera", "CubicPhaseCamera", "DiffuserCamera"),
    *("EvenAngleLineCamera", "LightFieldCamera", "LineCamera", "MarwahCamera", "MeasuredCamera"),
    *("PointSpreadCamera", "SinglePixelCamera"),
]


class LightFieldCamera(ABC):
    """An encoder A_k for each view, and the two models that follow from them. `image_shape` is that
    of every view's picture, `views` (v, u) of each, `sampling_ratio` measurements over pixels of
    one picture, `seed` that of everything random. `used_views` get measurements, in their order.
    """

    name: ClassVar[str]
    joined: ClassVar[type[BlockDiagonal | Integration]] = BlockDiagonal  # apart, or on one sensor
    measurements: int
    # consecutive measurements on a detector whose errors are alike; 1 where each stands for itself
    correlation_length: int = 1

    def __init__(
        self, image_shape: tuple[int, int], views: Sequence[View], sampling_ratio: float, seed: int
    ) -> None:
        require_positive("the sampling ratio", sampling_ratio)
        self.image_shape, self.views = image_shape, tuple(views)
        self.sampling_ratio, self.seed = sampling_ratio, seed
        self.used_views = self._assign_measurements()

    @abstractmethod
    def _assign_measurements(self) -> tuple[int, ...]:
        """Set `measurements`; return the numbers of the views that get any."""

    @cached_property
    @abstractmethod
    def encoders(self) -> tuple[LinearOperator, ...]:
        """A_k of the used views."""

    @abstractmethod
    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d), from the (rows, columns) picture that is refocused at `shear` and seen from the
        view `reference`, (v, u), to (measurements,) vectors (Eq. 21).
        """

    def weighting(self) -> LinearOperator:
        """Return the weights W that measurements and model get in a recovery, by default all alike."""
        return Identity((self.measurements,))

    def light_field_model(self) -> LinearOperator:
        """Return the map from the used views' pictures to the measurements (Eq. 20)."""
        return self.joined(self.encoders)


# Neighbours on a line detector whose errors are alike: what is out of focus is some ten pixels wide. A
# weight chosen by leaving out this number together comes nearer to the best one than by leaving out
# single pixels, which their neighbours betray, or whole lines, which nothing else measures (letters at
# SR 1 and 0.5: 1.6 and 3.0 % NMSE with angles assigned evenly, against 4.0 and 4.0 % from whole lines).
CORRELATION_LENGTH_PX = 12

AngleAssignment = tuple[tuple[int, ...], list[FloatArray]]
"""Numbers of the views that get any directions, and each one's own."""


def count_lines(image_shape: tuple[int, int], detector_px: int, sampling_ratio: float) -> int:
    """Return how many line detectors of `detector_px` make up the sampling ratio, at least 1."""
    count = round(sampling_ratio * image_shape[0] * image_shape[1] / detector_px)
    require(
        count >= 1,
        f"a sampling ratio of {sampling_ratio} gives no view a projection; take a larger one",
    )
    return count


def assign_randomly(
    directions: FloatArray, views: int, random: np.random.Generator
) -> AngleAssignment:
    """Permute the directions and deal them one by one to the views in random order (supplement Note
    6); of few directions some views get none.
    """
    shuffled = random.permutation(directions)
    return _group_by_view(shuffled, np.resize(random.permutation(views), directions.size))


def assign_evenly(
    directions: FloatArray, views: Sequence[View], cycle: int, random: np.random.Generator
) -> AngleAssignment:
    """Deal so that neighbouring directions look from places spread evenly over the aperture.

    A surface out of focus moves along a detector of direction a by its own fraction of ``t = u
    cos(a) + v sin(a)``. In the picture that refocusing makes it is blurred over all t; a detector
    sees it at one. Where neighbouring directions, which measure much the same, have values of t
    that together stand for all of them, the surface is blurred as it should be instead of being
    torn into streaks. So the views are ranked by t for each direction, and each direction gets the
    one nearest to its place in a cycle of places spread evenly, alternately on either side of the
    middle; no view gets two directions more than another. Which views that are is an assignment
    problem.

    `directions` (lines,) ascend, rad; a `cycle` of them, a power of two from 2 on, stands for the
    aperture together.
    """
    from scipy.optimize import linear_sum_assignment

    v, u = np.asarray(views, dtype=np.float64).T[:, :, np.newaxis]
    across = u * np.cos(directions) + v * np.sin(directions)
    # views on one line across a direction are ranked by chance, not by their order
    tie_break = 1e-6 * random.random(across.shape)
    # rank of every view along every direction, from 0 to 1
    place = (np.argsort(np.argsort(across + tie_break, axis=0), axis=0) + 0.5) / len(views)
    nearer = np.zeros(1)
    while 2 * nearer.size < cycle:  # van der Corput's sequence from 0 to 1/2
        nearer = np.concatenate([nearer, nearer + 0.25 / nearer.size])
    nearer += 0.5 / cycle
    # each place is followed by its mirror image, such as 1/8, 7/8, 3/8, 5/8: every pair is balanced
    places = np.stack([nearer, 1 - nearer], axis=1).ravel()
    wanted = np.resize(np.roll(places, random.integers(cycle)), directions.size)
    # each view may own several lines, but none more than its share
    copies = -(-directions.size // len(views))
    taken, direction = linear_sum_assignment(np.repeat((place - wanted) ** 2, copies, axis=0))
    owners = np.empty(directions.size, np.intp)
    owners[direction] = taken // copies
    return _group_by_view(directions, owners)


def _group_by_view(directions: FloatArray, owners: IndexArray) -> AngleAssignment:
    used = tuple(int(view) for view in np.unique(owners))
    return used, [directions[owners == view] for view in used]


class LineCamera(LightFieldCamera):
    """CLIP-1D: line projections, their angles assigned to the views at random (supplement Note 6).
    ``sampling_ratio * rows * columns / detector`` angles, evenly in [0, pi). A detector has as many
    pixels as the picture's longer side.
    """

    name: ClassVar[str] = "line"

    def _assign_measurements(self) -> tuple[int, ...]:
        self.detector_px = max(self.image_shape)
        count = count_lines(self.image_shape, self.detector_px, self.sampling_ratio)
        self.measurements = count * self.detector_px
        self.correlation_length = min(CORRELATION_LENGTH_PX, self.detector_px)
        # half a turn is all: a line turned by 180 degrees measures the same, mirrored
        used, self.angles = self._assign_angles(np.arange(count) * np.pi / count)
        return used

    def _assign_angles(self, angles: FloatArray) -> AngleAssignment:
        return assign_randomly(angles, len(self.views), np.random.default_rng(self.seed))

    @cached_property
    def encoders(self) -> tuple[LinearOperator, ...]:
        sizes = self.image_shape, self.detector_px
        return tuple(RadonProjection(*sizes, own, np.zeros(own.size)) for own in self.angles)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d) as one sparse matrix: a sheared view is one whose detector is offset."""
        offsets = []
        for view, angles in zip(self.used_views, self.angles, strict=True):
            (v, u), (v_ref, u_ref) = self.views[view], reference
            down, right = shear * (v - v_ref), shear * (u - u_ref)
            require(
                max(abs(down), abs(right)) < self.detector_px,
                f"shear {shear} moves view {self.views[view]} out of the field; take a smaller one",
            )
            # the shift's component along the line's direction (cos, sin); the other one moves along
            # the integral
            offsets.append(right * np.cos(angles) + down * np.sin(angles))
        lines = np.concatenate(self.angles), np.concatenate(offsets)
        return RadonProjection(self.image_shape, self.detector_px, *lines)


class EvenAngleLineCamera(LineCamera):
    """CLIP-1D with angles assigned so that neighbouring ones look from places spread evenly over
    the aperture. What is out of focus is then blurred rather than torn into streaks, and which seed
    was drawn hardly matters (`apps.studies.pictures` shows how much better it is than dealing at
    random).
    """

    name: ClassVar[str] = "line-even"

    def _assign_angles(self, angles: FloatArray) -> AngleAssignment:
        """Directions that differ by 6 px at the border stand for the aperture together."""
        neighbours = 4 * angles.size / max(self.image_shape)
        cycle = max(2, 1 << max(round(np.log2(neighbours)), 0))
        return assign_evenly(angles, self.views, cycle, np.random.default_rng(self.seed))


class CodedLineCamera(LightFieldCamera):
    """Coded lines one pixel wide, their angles evenly from -45 to 45 degrees, assigned to the views
    at random. Each line has a code and a 1D sensor of its own, as long as the picture is wide.
    """

    name: ClassVar[str] = "coded-line"

    def _assign_measurements(self) -> tuple[int, ...]:
        detector_px = self.image_shape[1]
        count = count_lines(self.image_shape, detector_px, self.sampling_ratio)
        self.measurements = count * detector_px
        self.correlation_length = min(CORRELATION_LENGTH_PX, detector_px)
        random = np.random.default_rng(self.seed)
        angles = np.pi / 4 * (2 * np.arange(count) + 1 - count) / count
        used, dealt = assign_randomly(angles, len(self.views), random)
        self._spreads = [
            np.stack([make_coded_line(self.image_shape, 1, angle, random) for angle in own])
            for own in dealt
        ]
        return used

    @cached_property
    def encoders(self) -> tuple[LinearOperator, ...]:
        return tuple(SliceConvolution(self.image_shape, spreads) for spreads in self._spreads)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): the lines of each view moved as its picture would be."""
        moved = [
            shear_point_spreads(spreads, [self.views[view]] * len(spreads), shear, reference)
            for view, spreads in zip(self.used_views, self._spreads, strict=True)
        ]
        return SliceConvolution(self.image_shape, np.concatenate(moved))


# Pixels from view to view by which Marwah's mask appears moved: no two views see a pixel through the
# same cell.
MASK_SHEAR_PX = 1.0


class CompressiveCamera(LightFieldCamera):
    """Masks that weigh the views' pixels before they add up on a dense area sensor. The sampling
    ratio is the number of exposures, a whole number.
    """

    joined = Integration

    def _assign_measurements(self) -> tuple[int, ...]:
        self.exposures = round(self.sampling_ratio)
        require(
            self.exposures >= 1 and self.exposures == self.sampling_ratio,
            "every exposure of this camera reads all pixels: its sampling ratio is their number, a whole one, "
            f"not {self.sampling_ratio}",
        )
        self.measurements = self.exposures * self.image_shape[0] * self.image_shape[1]
        return tuple(range(len(self.views)))

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): the light field's model after the shears."""
        shears = (LinearShear(self.image_shape, shear, view, reference) for view in self.views)
        return self.light_field_model() @ Integration([one.H for one in shears]).H


class ApertureMaskCamera(CompressiveCamera):
    """A mask in the aperture, another one for each exposure (Eq. 17)."""

    @abstractmethod
    def weights(self) -> FloatArray:
        """Return the fraction of each view's light that each mask lets pass, (exposures, views)."""

    @cached_property
    def encoders(self) -> tuple[LinearOperator, ...]:
        sensor, even = DenseSensor(self.image_shape), np.ones(self.image_shape)
        return tuple(
            Stack([sensor @ Diagonal(share * even) for share in own]) for own in self.weights().T
        )

    def light_field_model(self) -> LinearOperator:
        return WeightedViews(self.image_shape, self.weights())


class AshokCamera(ApertureMaskCamera):
    """Masks of open and closed cells from a Hadamard matrix (A. Ashok, M. A. Neifeld, Proc. SPIE
    7690, 76900Q (2010)). The first exposure is an ordinary photograph, all cells open; the others
    are drawn from the matrix.
    """

    name: ClassVar[str] = "ashok"

    def _assign_measurements(self) -> tuple[int, ...]:
        used = super()._assign_measurements()
        self._order = 1 << (len(self.views) - 1).bit_length()
        require(
            self.exposures <= self._order,
            f"{len(used)} views have at most {self._order} different masks, not {self.exposures}",
        )
        return used

    def weights(self) -> FloatArray:
        from scipy.linalg import hadamard

        others = 1 + np.random.default_rng(self.seed).permutation(self._order - 1)
        # row 0 of the Hadamard matrix opens all cells; +-1 become open and closed
        rows = np.append(0, others[: self.exposures - 1])
        return (1 + hadamard(self._order)[rows, : len(self.views)]) / 2


class BabacanCamera(ApertureMaskCamera):
    """Random grey cells (S. D. Babacan et al., IEEE Trans. Image Process. 21, 4746, 2012)."""

    name: ClassVar[str] = "babacan"

    def weights(self) -> FloatArray:
        """Return the masks, their transmissions evenly from 0 to 1."""
        return np.random.default_rng(self.seed).random((self.exposures, len(self.views)))


class MarwahCamera(CompressiveCamera):
    """One exposure through a random mask just in front of the sensor. Each view sees the mask moved
    by `MASK_SHEAR_PX` pixels against its neighbour (Eq. 18; K. Marwah et al., ACM Trans. Graph. 32,
    46 (2013)).
    """

    name: ClassVar[str] = "marwah"

    def _assign_measurements(self) -> tuple[int, ...]:
        used = super()._assign_measurements()
        require(
            self.exposures == 1,
            f"this camera takes one exposure, not {self.exposures}; set the sampling ratio to 1",
        )
        return used

    def codes(self) -> FloatArray:
        """Return the mask as each view sees it, (views, rows, columns)."""
        random = np.random.default_rng(self.seed)
        return make_sheared_mask(self.image_shape, self.views, MASK_SHEAR_PX, random)

    @cached_property
    def encoders(self) -> tuple[LinearOperator, ...]:
        sensor = DenseSensor(self.image_shape)
        return tuple(sensor @ Diagonal(code) for code in self.codes())


class SinglePixelCamera(LightFieldCamera):
    """CLIP-0D: as many random 0/1 codes for each view (supplement Note 6)."""

    name: ClassVar[str] = "single-pixel"

    def _assign_measurements(self) -> tuple[int, ...]:
        rows, columns = self.image_shape
        self.codes = round(self.sampling_ratio * rows * columns / len(self.views))
        require(
            self.codes >= 1,
            f"a sampling ratio of {self.sampling_ratio} gives {len(self.views)} views less than one code each; "
            "take a larger one",
        )
        self.measurements = self.codes * len(self.views)
        return tuple(range(len(self.views)))

    @cached_property
    def encoders(self) -> tuple[LinearOperator, ...]:
        # independent codes for every view from one seed
        seeds = np.random.SeedSequence(self.seed).generate_state(len(self.views))
        return tuple(HadamardCodes(self.image_shape, self.codes, int(seed)) for seed in seeds)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): every view's codes after its shear, stacked."""
        shears = (LinearShear(self.image_shape, shear, view, reference) for view in self.views)
        return Stack([codes @ one for codes, one in zip(self.encoders, shears, strict=True)])

    def weighting(self) -> LinearOperator:
        """Return the weights that keep the mean of each view's codes from swamping the rest."""
        return MeanWeighting([self.codes] * len(self.used_views))


class PointSpreadCamera(LightFieldCamera):
    """Every view goes through its own part of the aperture; their light adds up on one sparse
    sensor (Eq. 4, 5). The sensor's pixels are spread evenly over the picture, as many as the
    sampling ratio asks for.
    """

    joined = Integration

    @abstractmethod
    def make_element(self) -> ApertureElement:
        """Return what stands in the aperture."""

    def _assign_measurements(self) -> tuple[int, ...]:
        self.sensor = make_sparse_sensor(self.image_shape, self.sampling_ratio)
        (self.measurements,) = self.sensor.shape_out
        spreads = trace_view_point_spreads(self.make_element(), self.views, self.image_shape)
        # Views behind closed cells are seen by no measurement; they are left out of the model.
        used = np.flatnonzero(spreads.any(axis=(1, 2)))
        require(used.size != 0, "the aperture lets no light through; take another seed")
        self._spreads = spreads[used]
        return tuple(int(view) for view in used)

    @cached_property
    def encoders(self) -> tuple[LinearOperator, ...]:
        convolutions = (PointSpreadConvolution(self.image_shape, one) for one in self._spreads)
        return tuple(self.sensor @ one for one in convolutions)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): one convolution with the depth's PSF, read by the sensor."""
        views = [self.views[view] for view in self.used_views]
        # views are moved by the shear and add up on the sensor: one convolution (Eq. 5)
        spread = shear_point_spreads(self._spreads, views, shear, reference).sum(axis=0)
        return self.sensor @ PointSpreadConvolution(self.image_shape, spread)


class CodedApertureCamera(PointSpreadCamera):
    """A random mask of open and closed cells, one for each view. In focus nothing is encoded."""

    name: ClassVar[str] = "coded-aperture"

    def make_element(self) -> CodedAperture:
        random = np.random.default_rng(self.seed)
        cells = tuple(len({view[axis] for view in self.views}) for axis in (0, 1))
        code = random.integers(0, 2, cells)
        # At least one open cell, or a small aperture might let no light through.
        code.flat[random.integers(code.size)] = 1
        return CodedAperture(code)


class CubicPhaseCamera(PointSpreadCamera):
    """A cubic phase plate, whose PSF spans a fifth of the picture at every depth."""

    name: ClassVar[str] = "cubic-phase"

    def make_element(self) -> CubicPhasePlate:
        return CubicPhasePlate(min(self.image_shape) / 5)


class DiffuserCamera(PointSpreadCamera):
    """A diffuser, whose caustics cover about half of the picture at every depth."""

    name: ClassVar[str] = "diffuser"

    def make_element(self) -> Diffuser:
        return Diffuser(min(self.image_shape) / 9, 0.25, self.seed)


class MeasuredCamera:
    """A camera known by its PSFs only, measured with a point source at several depths (supplement
    Note 4). `sensor`: from the light on the sensor's plane to the measurements, any of
    `tofclip.operators.base`; its plane may be smaller than the picture.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        point_spreads: MeasuredPointSpreads,
        sensor: LinearOperator | None = None,
    ) -> None:
        self.image_shape, self.point_spreads = image_shape, point_spreads
        self.sensor = DenseSensor(image_shape) if sensor is None else sensor

    def model(self, shear: float) -> LinearOperator:
        """Return F(d): from the picture at `shear` to the measurements."""
        spread, sensor = self.point_spreads.interpolate(shear), self.sensor
        plane = sensor.shape_in[0], sensor.shape_in[1]
        return sensor @ PointSpreadConvolution(self.image_shape, spread, plane, sensor.dtype)


def make_sparse_sensor(image_shape: tuple[int, int], sampling_ratio: float) -> PitchedSensor:
    """Spread as many pixels evenly over the picture as the sampling ratio, up to 1, asks for."""
    rows, columns = image_shape
    require(
        0 < sampling_ratio <= 1,
        f"one area sensor gives sampling ratios above 0 up to 1, not {sampling_ratio}",
    )
    # the same pitch on both axes, as far as whole numbers of pixels allow
    kept_rows = min(max(round(rows * np.sqrt(sampling_ratio)), 1), rows)
    kept_columns = min(round(sampling_ratio * rows * columns / kept_rows), columns)
    require(
        kept_columns >= 1,
        f"a sampling ratio of {sampling_ratio} gives no sensor pixel; take a larger one",
    )
    return PitchedSensor(image_shape, (rows / kept_rows, columns / kept_columns))


CAMERAS: dict[str, type[LightFieldCamera]] = {
    kind.name: kind
    for kind in (
        LineCamera,
        EvenAngleLineCamera,
        SinglePixelCamera,
        CodedLineCamera,
        CodedApertureCamera,
        CubicPhaseCamera,
        DiffuserCamera,
    )
}

COMPRESSIVE_CAMERAS: dict[str, type[CompressiveCamera]] = {
    kind.name: kind for kind in (AshokCamera, BabacanCamera, MarwahCamera)
}
"""Cameras that are made to recover whole light fields from dense sensors, for comparison
(supplement Note 5).
"""
