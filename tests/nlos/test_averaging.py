"""Running means over more captures the farther away: less noise there, no trail near by."""

from __future__ import annotations

import numpy as np
import pytest

from nlos import Capture, Grid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.simulate import PointScene
from nlos.video import DepthAverage
from tofclip.errors import InputError

pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")
AXIS, FAR, CAPTURES = TimeAxis(320, 40e-12), (0.1, -0.1, 1.4), 9
GRID = Grid.box((-0.4, 0.4), (-0.4, 0.4), (0.3, 1.5), 0.1)


def simulate(place: float) -> Capture:
    """A bright point near by that moves along x, and a faint one far away that stands still."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 12), np.linspace(-0.5, 0.5, 12))
    wall = np.stack([x, y, 0 * x], axis=-1)
    scene = PointScene([[place, 0.1, 0.4], FAR], [1.0, 20.0])
    return scene.simulate_capture(wall, [0.0, 0.0, 0.0], AXIS, 60e-12)


def test_far_things_stand_out_and_near_ones_leave_no_trail() -> None:
    places = np.linspace(-0.3, 0.3, CAPTURES)
    plan = PlanarRSD(0.3).plan(simulate(0.0), GRID)
    average = DepthAverage(GRID, 0.0, CAPTURES)
    assert average.windows[[0, -1]].tolist() == [2, CAPTURES]
    assert np.all(np.diff(average.windows) >= 0)
    random, clean = np.random.default_rng(0), plan.image(simulate(places[-1])).values
    noise = 0.02 * float(simulate(0.0).signal.max())
    for place in places:
        capture = simulate(place)
        noisy = capture.signal + noise * random.standard_normal(capture.signal.shape)
        field = plan.field(Capture(noisy, capture.wall, capture.laser, AXIS.bin_width))
        averaged = average.add(field).values
    single, far = np.abs(field.values), slice(9, None)
    errors = [np.linalg.norm(one[far] - clean[far]) for one in (averaged, single)]
    # Noise falls with the root of 7 to 9 captures; the near point's waves, which change, stay.
    assert errors[0] < 0.55 * errors[1]
    row = GRID.find_nearest((places[-1], 0.1, 0.4))
    # Two captures at the near point's depth, which moved less than a voxel between them.
    along = averaged[row[0], row[1]]
    assert along.argmax() == single[row[0], row[1]].argmax() == row[2]
    start = GRID.find_nearest((places[0], 0.1, 0.4))[2]
    assert along[start] < 0.5 * along.max()


def test_the_nearest_depths_show_the_newest_capture_alone() -> None:
    grid = Grid([0.0, 0.1], [0.0], [0.1, 0.5, 1.0])
    average = DepthAverage(grid, 0.0, 4)
    assert average.windows.tolist() == [1, 2, 4]
    plan = PlanarRSD(0.3).plan(simulate(0.0), Grid([0.0, 0.1], [0.0, 0.1], grid.z))
    field = plan.field(simulate(0.0))
    average = DepthAverage(field.grid, 0.0, 4)
    first, second = (average.add(one).values for one in (field, _scaled(field, 3.0)))
    assert np.allclose(first, np.abs(field.values))
    # The newest alone, then the mean of both that there are.
    assert np.allclose(second, np.abs(field.values) * np.array([3, 2, 2])[:, None, None])
    with pytest.raises(InputError, match="1 capture or more"):
        DepthAverage(grid, 0.0, 0)


def _scaled(field, factor):  # type: ignore[no-untyped-def]
    from dataclasses import replace

    return replace(field, values=field.values * np.float32(factor))
