"""What the studies of the paper compute: coded lines, costs of an iteration, the recorded hand, and
a dictionary of light-field patches.
"""

import numpy as np
import pytest

from apps.studies.cameras import (
    LINES,
    MAX_ANGLE_RAD,
    DiffuserRecording,
    build_diffuser_model,
    halve_pictures,
    make_coded_line_sensors,
    measure_iteration_costs,
    measure_lines,
    read_diffuser_recording,
    recover_diffuser_scene,
    recover_from_lines,
    select_views,
)
from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.io.light_fields import read_light_field
from tofclip.light_field import LightField


class TestCodedLine:
    def two_views(self, difference):
        """Two views whose sum is the same whatever their difference: so is what shift-and-add makes
        of them at s = 0.
        """
        common, other = np.random.default_rng(3).random((2, 16, 16)).astype(np.float32)
        pictures = np.stack([common + sign * difference * other for sign in (1, -1)])
        return LightField(pictures, np.array([[0.0, -1.0], [0.0, 1.0]]))

    @pytest.mark.nightly
    def test_rotation_gains_four_decibels_on_the_letters(self, shared_data):
        """Acceptance at N_p = 1, M = 10: the mean of five seeds, of pictures halved as the study's are."""
        whole = read_light_field(shared_data / "lightfields" / "render_letters.npz")
        light_field = halve_pictures(select_views(whole, LINES))
        upright, rotated = (
            measure_lines(light_field, -0.15, 5, (1, angle))[0] for angle in (0.0, MAX_ANGLE_RAD)
        )
        gain_db = np.subtract(rotated, upright)
        assert gain_db.shape == (5,)
        assert gain_db.mean() >= 4.0
        assert gain_db.min() > 2.0

    def test_every_line_measures_its_own_view_and_not_the_picture_that_is_sought(self):
        """Measurements computed from the truth, A x, would be the same for both light fields."""
        sensors = make_coded_line_sensors((16, 16), 2, 1, MAX_ANGLE_RAD, 0)
        even, uneven = self.two_views(0.0), self.two_views(0.5)
        np.testing.assert_allclose(even.refocus(0.0), uneven.refocus(0.0), atol=1e-6)
        first, second = (recover_from_lines(one, 0.0, sensors, 1e-3)[0] for one in (even, uneven))
        assert np.abs(first - second).max() > 0.1 * first.max()

    def test_the_weight_is_chosen_without_the_truth(self, monkeypatch):
        """Shift-and-add of the true views is the truth of this study: nobody may ask for it here."""
        monkeypatch.setattr(LightField, "refocus", lambda *_: pytest.fail("looked at the truth"))
        monkeypatch.setattr("apps.studies.cameras.SEARCH_ITERATIONS", 10)
        monkeypatch.setattr("apps.studies.cameras.ITERATIONS", 20)
        sensors = make_coded_line_sensors((16, 16), 2, 1, MAX_ANGLE_RAD, 0)
        _, weight = recover_from_lines(self.two_views(0.1), 0.0, sensors)
        assert weight > 0


def test_every_method_is_counted_as_in_the_paper_and_timed():
    """r N^2, N^2 and m measurements; n_a^2 N^2 unknowns of a light field, N^2 of a picture."""
    views = np.array([(v, u) for v in range(-2, 2) for u in range(-2, 2)], np.float64)
    pictures = np.random.default_rng(0).random((16, 64, 64)).astype(np.float32)
    costs = measure_iteration_costs(LightField(pictures, views), -0.3, 4, 0.5)
    assert [cost.method for cost in costs[:4]] == ["Ashok", "Babacan", "Marwah", "Cai, Antipa"]
    assert [cost.recovers for cost in costs] == ["light field"] * 6 + ["refocused picture"] * 2
    assert [cost.measurements for cost in costs] == [4 * 4096] * 2 + [4096] * 2 + [2048] * 4
    assert [cost.unknowns for cost in costs] == [16 * 4096] * 6 + [4096] * 2
    assert all(0 < cost.seconds < 1 for cost in costs)


class TestDiffuser:
    """The recorded hand, from a dense and from sparse sensors."""

    @pytest.fixture(scope="class")
    @classmethod
    def hand(cls, shared_data):
        return read_diffuser_recording(shared_data / "diffusercam" / "psf_hand_300x400.npz")

    @pytest.mark.nightly
    def test_the_hand_explains_the_readings_and_lies_where_it_is(self, hand):
        """Acceptance: a relative residual below 1 % from the full and from two and three times fewer
        pixels an axis, which show the same.
        """
        recoveries = [recover_diffuser_scene(hand, pitch) for pitch in (1, 2, 3)]
        assert all(residual < 0.01 for _, residual in recoveries)
        full = recoveries[0][0]
        rows, columns = np.nonzero(full > 0.2 * full.max())
        # Seen by eye: the hand spans rows 220 to 365 and columns 360 to 550, and the rest is dark.
        assert 220 <= rows.min() < rows.max() <= 365
        assert 360 <= columns.min() < columns.max() <= 550
        assert full[220:365, 360:550].sum() > 0.6 * full.sum()
        for sparse, _ in recoveries[1:]:
            assert np.corrcoef(full.ravel(), sparse.ravel())[0, 1] > 0.99

    def test_a_mirrored_point_spread_explains_it_much_worse(self, hand):
        """The residual can tell a wrong model: this is the control for the figure above."""
        mirrored = DiffuserRecording(hand.point_spread[:, ::-1], hand.measurements)
        right, wrong = (recover_diffuser_scene(one, 3, 100)[1] for one in (hand, mirrored))
        assert wrong > 3 * right

    @pytest.mark.parametrize("pitch", [1, 2])
    def test_a_known_scene_comes_back(self, pitch):
        """Two points seen through a random PSF, one of them from beside the sensor."""
        spread = np.random.default_rng(0).random((20, 24)) ** 8
        scene = np.zeros((40, 48))
        scene[20, 24], scene[14, 9] = 1.0, 0.6
        model = build_diffuser_model(DiffuserRecording(spread, np.ones((20, 24))), 1)
        measurements = model(scene).reshape(20, 24).astype(np.float64)
        recording = DiffuserRecording(spread, measurements)
        found, residual = recover_diffuser_scene(recording, pitch, 1000)
        brightest = np.argsort(found, axis=None)[-2:]
        np.testing.assert_array_equal(np.sort(brightest), np.flatnonzero(scene))
        assert residual < 0.02

    def test_recordings_that_cannot_be_used_are_refused(self, tmp_path):
        with pytest.raises(ShapeError, match="like the PSF"):
            DiffuserRecording(np.ones((3, 4)), np.ones((4, 3)))
        with pytest.raises(InputError, match="show something"):
            DiffuserRecording(np.ones((3, 4)), np.zeros((3, 4)))
        np.savez(tmp_path / "no_background.npz", psf=np.ones((3, 4)), raw=np.ones((3, 4)))
        with pytest.raises(FileFormatError, match="'background'"):
            read_diffuser_recording(tmp_path / "no_background.npz")
