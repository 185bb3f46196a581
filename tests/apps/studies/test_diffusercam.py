"""The recorded hand, from a dense and from sparse sensors."""

from __future__ import annotations

import numpy as np
import pytest

from apps.studies.diffuser import (
    DiffuserRecording,
    build_diffuser_model,
    read_diffuser_recording,
    recover_diffuser_scene,
)
from tofclip.errors import FileFormatError, InputError, ShapeError


@pytest.fixture(scope="module")
def hand(shared_data) -> DiffuserRecording:
    return read_diffuser_recording(shared_data / "diffusercam" / "psf_hand_300x400.npz")


@pytest.fixture(scope="module")
def recoveries(hand) -> list:
    return [recover_diffuser_scene(hand, pitch) for pitch in (1, 2, 3)]


@pytest.mark.nightly
def test_the_hand_explains_the_readings(recoveries):
    """Acceptance: a relative residual below 1 % from the full and from two and three times fewer
    pixels an axis.
    """
    assert [recovery.relative_residual < 0.01 for recovery in recoveries] == [True] * 3


@pytest.mark.nightly
def test_the_hand_lies_where_it_is_and_is_the_same_from_fewer_pixels(recoveries):
    full = recoveries[0].scene
    rows, columns = np.nonzero(full > 0.2 * full.max())
    # Seen by eye: the hand spans rows 220 to 365 and columns 360 to 550, and the rest is dark.
    assert 220 <= rows.min() < rows.max() <= 365
    assert 360 <= columns.min() < columns.max() <= 550
    assert full[220:365, 360:550].sum() > 0.6 * full.sum()
    for sparse in recoveries[1:]:
        assert np.corrcoef(full.ravel(), sparse.scene.ravel())[0, 1] > 0.99


def test_a_mirrored_point_spread_explains_it_much_worse(hand):
    """The residual can tell a wrong model: this is the control for the figure above."""
    mirrored = DiffuserRecording(hand.point_spread[:, ::-1], hand.measurements)
    right, wrong = (
        recover_diffuser_scene(one, 3, 100).relative_residual for one in (hand, mirrored)
    )
    assert wrong > 3 * right


@pytest.mark.parametrize("pitch", [1, 2])
def test_a_known_scene_comes_back(pitch):
    """Two points seen through a random PSF, one of them from beside the sensor."""
    spread = np.random.default_rng(0).random((20, 24)) ** 8
    blank = DiffuserRecording(spread, np.ones((20, 24)))
    scene = np.zeros((40, 48))
    scene[20, 24], scene[14, 9] = 1.0, 0.6
    measurements = build_diffuser_model(blank, 1)(scene).reshape(20, 24).astype(np.float64)
    recovery = recover_diffuser_scene(DiffuserRecording(spread, measurements), pitch, 1000)
    brightest = np.argsort(recovery.scene, axis=None)[-2:]
    assert {tuple(int(n) for n in np.unravel_index(k, scene.shape)) for k in brightest} == {
        (20, 24),
        (14, 9),
    }
    assert recovery.relative_residual < 0.02


def test_recordings_that_cannot_be_used_are_refused(tmp_path):
    with pytest.raises(ShapeError, match="like the PSF"):
        DiffuserRecording(np.ones((3, 4)), np.ones((4, 3)))
    with pytest.raises(InputError, match="show something"):
        DiffuserRecording(np.ones((3, 4)), np.zeros((3, 4)))
    np.savez(tmp_path / "no_background.npz", psf=np.ones((3, 4)), raw=np.ones((3, 4)))
    with pytest.raises(FileFormatError, match="'background'"):
        read_diffuser_recording(tmp_path / "no_background.npz")
