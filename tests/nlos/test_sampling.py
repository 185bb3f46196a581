from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from refusals import find_refusal
from relay_walls import planar_wall

from nlos import Backprojection, Capture, Grid
from nlos.band import Band
from nlos.illumination import AliasingWarning, warn_of_aliasing
from tofclip.errors import InputError

METHOD = Backprojection(0.2, 5)


def capture_of(wall: np.ndarray, laser: object = (0.1, 0.0, 0.0)) -> Capture:
    return Capture(np.ones((300, *wall.shape[:-1])), wall, laser, 16e-12)


def test_the_spacing_is_that_of_neighbours_however_they_are_listed() -> None:
    wall = planar_wall(11, 13)  # 10 cm by 10 cm
    assert capture_of(wall).spacing == pytest.approx(0.1)
    assert capture_of(wall.reshape(-1, 3)[::-1]).spacing == pytest.approx(0.1)
    lasers = np.array([[0.0, 0, 0], [0.2, 0, 0]])
    signal = np.ones((20, 2, 11, 13))
    assert Capture.exhaustive(signal, wall, lasers, 16e-12).spacing == pytest.approx(0.1)
    assert capture_of(wall[:1, 0]).spacing == np.inf


def test_a_coarse_wall_is_warned_of_and_a_fine_one_is_not() -> None:
    grid = Grid([0.0], [0.0], [0.5])
    shortest = 2 * np.pi / Band(METHOD.pulse, capture_of(planar_wall()).axis).wavenumbers[-1]
    for share, confocal, warned in (
        (0.45, False, False),
        (0.55, False, True),
        (0.3, True, True),
        (0.2, True, False),
    ):
        wall = planar_wall() * (share * shortest / 0.06)
        wall[..., 1] *= 0.96  # rows are 6.25 cm apart, columns 6 cm
        capture = capture_of(wall, wall if confocal else [0.0, 0, 0])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            METHOD.reconstruct(capture, grid)
        assert [w.category for w in caught] == [AliasingWarning] * warned
    with pytest.warns(AliasingWarning, match="too coarse for waves of"):
        METHOD.reconstruct(capture_of(planar_wall() * 10), grid)


def test_an_exhaustive_capture_pairs_every_laser_with_every_point() -> None:
    wall, lasers = planar_wall(3, 4), np.arange(6.0).reshape(2, 3) / 10
    signal = np.random.default_rng(1).normal(size=(5, 2, 3, 4))
    capture = Capture.exhaustive(signal, wall, lasers, 16e-12, 0.3, {"shot": 7})
    assert capture.signal.shape == (5, 2, 3, 4)
    assert np.array_equal(capture.wall[1], wall)
    assert np.array_equal(capture.laser[1, 2, 3], lasers[1])
    assert (capture.start, capture.provenance) == (0.3, {"shot": 7})
    masked = wall.copy()
    masked[0, 0] = np.nan
    assert len(Capture.exhaustive(signal, masked, lasers, 16e-12).points) == 2 * 11
    for wrong in ((wall[..., :2], lasers), (wall, lasers[:, :2])):
        with pytest.raises(InputError, match="shape"):
            Capture.exhaustive(signal, *wrong, 16e-12)
    with pytest.raises(InputError, match="signal"):
        Capture.exhaustive(signal[:, :1], wall, lasers, 16e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bin_width": 16.0}, "check the unit of `bin_width`"),
        ({"bin_width": 1e-16}, "check the unit of `bin_width`"),
        ({"wall": planar_wall() * 1e4}, "give its points in metres"),
        ({"laser": [0, 0, -1.0]}, "behind the hindmost wall point"),
        ({"laser": planar_wall() - [0, 0, 1.0]}, "behind the hindmost wall point"),
    ],
)
def test_what_cannot_be_metres_seconds_or_a_spot_on_the_wall_is_refused(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        replace(capture_of(planar_wall()), **changes)


def test_a_laser_a_little_behind_a_curved_wall_is_no_fault() -> None:
    assert replace(capture_of(planar_wall()), laser=[0, 0, -0.3]).lasers[0, 2] == -0.3


def test_a_single_wall_point_may_be_stored_but_not_imaged() -> None:
    lone = capture_of(planar_wall()[:1, 0])
    warn_of_aliasing(lone, Band(METHOD.pulse, lone.axis))
    assert "one wall point" in find_refusal(METHOD, lone, Grid([0.0], [0.0], [0.5]))
