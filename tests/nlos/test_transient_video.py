from dataclasses import replace

import numpy as np
import pytest
from numpy.linalg import norm
from PIL import Image
from scenes import curved_wall, planar_wall, see

from nlos import Capture, Grid, Hybrid, PlanarRSD, TransientImaging
from nlos.capture import TimeAxis
from nlos.method import MEMORY_LIMIT_BYTES
from nlos.video import DepthAverage, TransientVideo
from tofclip.errors import InputError
from tofclip.units import SPEED_OF_LIGHT

LASER = np.array([0.12, 0.05, 0.0])
POINTS = np.array([[0.15, -0.2, 0.6], [-0.2, 0.15, 0.95]])
ARRIVALS = norm(POINTS - LASER, axis=1) / SPEED_OF_LIGHT
AXIS = TimeAxis(300, 24e-12, 0.4)
GRID = Grid(np.linspace(-0.4, 0.4, 17), np.linspace(-0.4, 0.4, 17), [0.5, 0.6, 0.7, 0.8, 0.95, 1.1])
METHODS = {"rsd": PlanarRSD(0.15, 4), "hybrid": Hybrid(0.15, 4)}


def seen(method, points=POINTS):
    wall = planar_wall(19, 21) if method == "rsd" else curved_wall(19, 21)
    return see(points, wall, LASER, AXIS, 40e-12)


@pytest.mark.parametrize("method", METHODS)
def test_a_hidden_point_lights_up_when_the_flash_reaches_it(method):
    imaging, capture = TransientImaging(METHODS[method]), seen(method, POINTS[:1])
    times = ARRIVALS[0] + 100e-12 * np.arange(-16, 17)
    done = []
    video = imaging.video(capture, GRID, times, done.append)
    assert video.values.shape == (33, *GRID.shape)
    assert video.values.dtype == np.float32
    assert sum(done) == GRID.size
    # The brightest of all voxels and instants is the point when the flash passes.
    instant, *voxel = np.unravel_index(video.values.argmax(), video.values.shape)
    assert (instant, *voxel) == (16, *GRID.find_nearest(POINTS[0]))
    # The wave is a pulse: 3.5 standard deviations of its envelope earlier and later the point is
    # dark.
    there = video.values[(slice(None), *voxel)]
    away = np.abs(times - ARRIVALS[0]) * SPEED_OF_LIGHT > 3.5 * METHODS[method].pulse.sigma
    assert there[away].max() < 0.05 * there.max()
    # Its width is that of the envelope; jitter adds to it in squares.
    width = (
        np.sqrt(np.sum((times - ARRIVALS[0]) ** 2 * there**2) / np.sum(there**2)) * SPEED_OF_LIGHT
    )
    assert width == pytest.approx(METHODS[method].pulse.sigma / np.sqrt(2), rel=0.1)


@pytest.mark.parametrize("method", METHODS)
def test_every_voxel_at_its_own_time_is_the_image_of_the_method(method):
    imaging, capture = TransientImaging(METHODS[method]), seen(method)
    voxels = [(1, 4, 11), (4, 11, 4), (3, 8, 8), (0, 0, 16)]
    places = np.array([[GRID.x[x], GRID.y[y], GRID.z[z]] for z, y, x in voxels])
    times = norm(places - LASER, axis=1) / SPEED_OF_LIGHT
    values = imaging.video(capture, GRID, times).values
    image = METHODS[method].reconstruct(capture, GRID).values
    for i, voxel in enumerate(voxels):
        assert values[(i, *voxel)] == pytest.approx(image[voxel], abs=1e-2 * float(image.max()))


@pytest.mark.parametrize("method", METHODS)
def test_a_gate_shows_what_lights_up_while_it_is_open(method):
    imaging, capture = TransientImaging(METHODS[method]), seen(method)
    around = 1.5 * METHODS[method].pulse.sigma / SPEED_OF_LIGHT
    image = METHODS[method].reconstruct(capture, GRID).values
    for arrival, bright, dark in ((ARRIVALS[0], *POINTS), (ARRIVALS[1], *POINTS[::-1])):
        gated = imaging.image_gate(capture, GRID, arrival - around, arrival + around)
        peak = gated.values[GRID.find_nearest(bright)]
        # erf(1.5) = 0.966 of the flash passes, of which this is the square root.
        assert peak == pytest.approx(image[GRID.find_nearest(bright)], rel=0.05)
        assert gated.values[GRID.find_nearest(dark)] < 0.2 * image[GRID.find_nearest(dark)]
        assert gated.provenance["imaging"]["gate_opens_s"] == arrival - around


def test_long_after_the_record_nothing_echoes():
    imaging, capture = TransientImaging(METHODS["rsd"]), seen("rsd")
    late = imaging.video(capture, GRID, [ARRIVALS[0], 40e-9]).values
    # The band's edge, where the pulse's spectrum is cut at 1 %, rings that far.
    assert late[1].max() < 2e-2 * late[0].max()


def test_the_film_shows_the_point_where_it_is(tmp_path):
    values = np.zeros((3, *GRID.shape), np.float32)
    values[1, 2, 3, 12] = 1.0  # y -0.25, x 0.2
    video = TransientVideo(values, 1e-9 * np.arange(3), GRID)
    for film in (video, TransientVideo(values.max(axis=1), video.times, GRID)):
        film.save_film(tmp_path / "film.gif")
        with Image.open(tmp_path / "film.gif") as stored:
            assert stored.n_frames == 3
            stored.seek(1)
            lit = np.asarray(stored.convert("RGB")).astype(int)
            stored.seek(0)
            dark = np.asarray(stored.convert("RGB")).astype(int)
        # Only the title, in the uppermost rows, and the voxel change: nothing jumps.
        rows, columns = np.nonzero(np.abs(lit - dark).max(axis=-1)[60:] > 60)
        assert np.ptp(rows) == pytest.approx(np.ptp(columns), abs=2)  # square
        # The axes fill the left 70 % of the width and most of the height; the voxel is a quarter of
        # the way down.
        assert rows.mean() + 60 < lit.shape[0] / 3
        assert 0.4 * lit.shape[1] < columns.mean() < 0.65 * lit.shape[1]


IMAGING = TransientImaging(METHODS["rsd"])
FILM = np.zeros((3, *GRID.shape), np.float32)


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (lambda c: IMAGING.video(replace(c, laser=c.wall), GRID, ARRIVALS), "need one laser spot"),
        (
            lambda c: IMAGING.front_views(c, Grid(GRID.x, GRID.y, GRID.z - 2), ARRIVALS),
            "behind the hindmost",
        ),
        (
            lambda c: IMAGING.video(c, GRID, np.zeros(MEMORY_LIMIT_BYTES // (4 * GRID.size) + 1)),
            r"GiB allowed: ask for fewer",
        ),
        (lambda c: IMAGING.video(c, GRID, []), "instants"),
        (lambda c: IMAGING.video(c, GRID, [np.nan]), "must be finite"),
        (lambda c: IMAGING.image_gate(c, GRID, 2e-9, 1e-9), "open before it closes"),
        (
            lambda _: TransientVideo(np.zeros((2, 3, 3), np.float32), np.zeros(2), GRID),
            "transient video",
        ),
        (
            lambda _: TransientVideo(FILM, np.arange(3.0), GRID).save_film("film.mp4"),
            r"must end in \.gif",
        ),
        (lambda _: DepthAverage(GRID, 0.0, 0), "1 capture or more"),
    ],
)
def test_what_cannot_be_filmed_is_refused(attempt, message):
    with pytest.raises(InputError, match=message):
        attempt(seen("rsd"))


# --- running means over more captures the farther away: less noise there, no trail near by

FAR_AXIS, FAR, CAPTURES, LONG_WAVES = TimeAxis(320, 40e-12), (0.1, -0.1, 1.4), 9, PlanarRSD(0.3)
DEEP = Grid.box((-0.4, 0.4), (-0.4, 0.4), (0.3, 1.5), 0.1)


def see_moving(place):
    """A bright point near by that moves along x, and a faint one far away that stands still."""
    wall = planar_wall(12, 12) * [1 / 1.2, 1, 1]
    points = [place, 0.1, 0.4], FAR
    return see(points, wall, [0.0, 0.0, 0.0], FAR_AXIS, 60e-12, [1.0, 20.0])


def test_far_things_stand_out_and_near_ones_leave_no_trail():
    places = np.linspace(-0.3, 0.3, CAPTURES)
    plan = LONG_WAVES.plan(see_moving(0.0), DEEP)
    average = DepthAverage(DEEP, 0.0, CAPTURES)
    assert average.windows[[0, -1]].tolist() == [2, CAPTURES]
    assert np.all(np.diff(average.windows) >= 0)
    random, clean = np.random.default_rng(0), plan.image(see_moving(places[-1])).values
    noise = 0.02 * float(see_moving(0.0).signal.max())
    for place in places:
        capture = see_moving(place)
        noisy = capture.signal + noise * random.standard_normal(capture.signal.shape)
        field = plan.field(Capture(noisy, capture.wall, capture.laser, FAR_AXIS.bin_width))
        averaged = average.add(field).values
    single, far = np.abs(field.values), slice(9, None)
    errors = [norm(one[far] - clean[far]) for one in (averaged, single)]
    # Noise falls with the root of 7 to 9 captures; the near point's waves, which change, stay.
    assert errors[0] < 0.55 * errors[1]
    row = DEEP.find_nearest((places[-1], 0.1, 0.4))
    # Two captures at the near point's depth, which moved less than a voxel between them.
    along = averaged[row[0], row[1]]
    assert along.argmax() == single[row[0], row[1]].argmax() == row[2]
    start = DEEP.find_nearest((places[0], 0.1, 0.4))[2]
    assert along[start] < 0.5 * along.max()


def test_the_nearest_depths_show_the_newest_capture_alone():
    grid = Grid([0.0, 0.1], [0.0], [0.1, 0.5, 1.0])
    average = DepthAverage(grid, 0.0, 4)
    assert average.windows.tolist() == [1, 2, 4]
    plan = LONG_WAVES.plan(see_moving(0.0), Grid([0.0, 0.1], [0.0, 0.1], grid.z))
    field = plan.field(see_moving(0.0))
    average = DepthAverage(field.grid, 0.0, 4)
    first, second = (
        average.add(one).values
        for one in (field, replace(field, values=np.float32(3) * field.values))
    )
    assert np.allclose(first, np.abs(field.values))
    # The newest alone, then the mean of both that there are.
    assert np.allclose(second, np.abs(field.values) * np.array([3, 2, 2])[:, None, None])
