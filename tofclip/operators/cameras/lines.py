"""Cameras of line sensors: which view gets which lines, CLIP-1D with its line projections, and lines
behind randomly coded line-shaped point-spread functions (supplement Notes 4 and 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.operators.base import LinearOperator
from tofclip.operators.cameras.base import LightFieldCamera
from tofclip.operators.coded_lines import SliceConvolution, make_coded_line
from tofclip.operators.point_spreads import shear_point_spreads
from tofclip.operators.radon import RadonProjection
from tofclip.operators.shear import View

CORRELATION_LENGTH_PX = 12
"""Neighbours on a line detector whose errors are alike: what is out of focus is some ten pixels
wide.

A weight chosen by leaving out this number together comes nearer to the best one than by leaving out
single pixels, which their neighbours betray, or whole lines, which nothing else measures (letters
at SR 1 and 0.5: 1.6 and 3.0 % NMSE with angles assigned evenly, against 4.0 and 4.0 % from whole
lines).
"""

AngleAssignment = tuple[tuple[int, ...], list[NDArray[np.float64]]]
"""Numbers of the views that get any directions, and each one's own."""


def count_lines(image_shape: tuple[int, int], detector_px: int, sampling_ratio: float) -> int:
    """Return how many line detectors make up the sampling ratio.

    `image_shape`: rows and columns of a view's picture; `detector_px`: pixels of one line detector;
    `sampling_ratio`: measurements over pixels of one picture. Returns at least 1.
    """
    count = round(sampling_ratio * image_shape[0] * image_shape[1] / detector_px)
    if count < 1:
        raise InputError(
            f"a sampling ratio of {sampling_ratio} gives no view a projection; take a larger one"
        )
    return count


def assign_randomly(
    directions: NDArray[np.float64], views: int, random: np.random.Generator
) -> AngleAssignment:
    """Permute the directions and deal them one by one to the views in random order (supplement Note
    6).

    `directions` (lines,); `views`: if there are fewer directions than views, some views get none.
    """
    shuffled = random.permutation(directions)
    return _group_by_view(shuffled, np.resize(random.permutation(views), directions.size))


def assign_evenly(
    directions: NDArray[np.float64], views: Sequence[View], cycle: int, random: np.random.Generator
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

    `directions` (lines,): ascending, rad; `views`: (v, u) of every view; `cycle`: neighbouring
    directions that together stand for the aperture, a power of two from 2 on; `random`: of where
    the cycle starts and of the order of views with the same t.
    """
    from scipy.optimize import linear_sum_assignment

    v, u = np.asarray(views, dtype=np.float64).T[:, :, np.newaxis]
    across = u * np.cos(directions) + v * np.sin(directions)
    # views on one line across a direction are ranked by chance, not by their order
    tie_break = 1e-6 * random.random(across.shape)
    # rank of every view along every direction, from 0 to 1
    place = (np.argsort(np.argsort(across + tie_break, axis=0), axis=0) + 0.5) / len(views)
    wanted = np.resize(
        np.roll(_antithetic_positions(cycle), random.integers(cycle)), directions.size
    )
    # each view may own several lines, but none more than its share
    copies = -(-directions.size // len(views))
    # the assignment with the least sum of squared distances from the places wanted
    taken, direction = linear_sum_assignment(np.repeat((place - wanted) ** 2, copies, axis=0))
    owners = np.empty(directions.size, np.intp)
    owners[direction] = taken // copies
    return _group_by_view(directions, owners)


def _antithetic_positions(count: int) -> NDArray[np.float64]:
    """Places spread evenly from 0 to 1, each followed by its mirror image, such as 1/8, 7/8, 3/8,
    5/8.
    """
    nearer = np.zeros(1)
    while 2 * nearer.size < count:  # van der Corput's sequence from 0 to 1/2
        nearer = np.concatenate([nearer, nearer + 0.25 / nearer.size])
    nearer += 0.5 / count
    # each place is followed by its mirror image, so that every pair is balanced
    return np.stack([nearer, 1 - nearer], axis=1).ravel()


def _group_by_view(directions: NDArray[np.float64], owners: NDArray[np.intp]) -> AngleAssignment:
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
        self.measurements, self.correlation_length = (
            count * self.detector_px,
            min(CORRELATION_LENGTH_PX, self.detector_px),
        )
        # half a turn is all: a line turned by 180 degrees measures the same, mirrored
        used, self.angles = self._assign_angles(np.arange(count) * np.pi / count)
        return used

    def _assign_angles(self, angles: NDArray[np.float64]) -> AngleAssignment:
        """Give angles to views."""
        return assign_randomly(angles, len(self.views), np.random.default_rng(self.seed))

    def _build_encoders(self) -> tuple[LinearOperator, ...]:
        return tuple(self._make_projection(own, np.zeros(own.size)) for own in self.angles)

    def _make_projection(
        self, angles: NDArray[np.float64], offsets_px: NDArray[np.float64]
    ) -> RadonProjection:
        return RadonProjection(self.image_shape, self.detector_px, angles, offsets_px)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d) as one sparse matrix: a sheared view is one whose detector is offset.

        `shear`: pixels per view step; `reference`: view (v, u) from which the picture is seen, in
        view steps. Returns (rows, columns) pictures to (measurements,) vectors.
        """
        offsets = []
        for view, angles in zip(self.used_views, self.angles, strict=True):
            down, right = (
                shear * (a - b) for a, b in zip(self.views[view], reference, strict=True)
            )
            if not max(abs(down), abs(right)) < self.detector_px:
                raise InputError(
                    f"shear {shear} moves view {self.views[view]} out of the field; take a smaller one"
                )
            # the shift's component along the line's direction (cos, sin); the other one moves along
            # the integral
            offsets.append(right * np.cos(angles) + down * np.sin(angles))
        return self._make_projection(np.concatenate(self.angles), np.concatenate(offsets))


class EvenAngleLineCamera(LineCamera):
    """CLIP-1D with angles assigned so that neighbouring ones look from places spread evenly over the
    aperture.

    What is out of focus is then blurred rather than torn into streaks, and which seed was drawn
    hardly matters (`apps.studies.refocused_pictures` shows how much better it is than dealing at
    random).
    """

    name: ClassVar[str] = "line-even"

    def _assign_angles(self, angles: NDArray[np.float64]) -> AngleAssignment:
        """Deal evenly; directions that differ by 6 px at the picture's border stand for the
        aperture together.
        """
        neighbours = 4 * angles.size / max(self.image_shape)
        cycle = max(2, 1 << max(round(np.log2(neighbours)), 0))
        return assign_evenly(angles, self.views, cycle, np.random.default_rng(self.seed))


MAX_LINE_ANGLE_RAD = np.pi / 4


class CodedLineCamera(LightFieldCamera):
    """Coded lines one pixel wide, their angles evenly from -45 to 45 degrees, assigned to the views at
    random.

    Each line has a code and a 1D sensor of its own, as long as the picture is wide.
    """

    name: ClassVar[str] = "coded-line"
    width_px: ClassVar[int] = 1

    def _assign_measurements(self) -> tuple[int, ...]:
        count = count_lines(self.image_shape, self.image_shape[1], self.sampling_ratio)
        self.measurements, self.correlation_length = (
            count * self.image_shape[1],
            min(CORRELATION_LENGTH_PX, self.image_shape[1]),
        )
        random = np.random.default_rng(self.seed)
        angles = MAX_LINE_ANGLE_RAD * (2 * np.arange(count) + 1 - count) / count
        used, dealt = assign_randomly(angles, len(self.views), random)
        self._spreads = [
            np.stack(
                [make_coded_line(self.image_shape, self.width_px, angle, random) for angle in own]
            )
            for own in dealt
        ]
        return used

    def _build_encoders(self) -> tuple[LinearOperator, ...]:
        return tuple(SliceConvolution(self.image_shape, spreads) for spreads in self._spreads)

    def model(self, shear: float, reference: View = (0.0, 0.0)) -> LinearOperator:
        """Return F(d): the lines of each view moved as its picture would be.

        `shear`: pixels per view step; `reference`: view (v, u) from which the picture is seen, in
        view steps.
        """
        moved: list[NDArray[np.float64]] = []
        for view, spreads in zip(self.used_views, self._spreads, strict=True):
            moved.append(
                shear_point_spreads(spreads, [self.views[view]] * len(spreads), shear, reference)
            )
        return SliceConvolution(self.image_shape, np.concatenate(moved))
