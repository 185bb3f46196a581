"""Instruments on paper: known truths of small cameras, predictions beside simulated shots, and files."""

import numpy as np
import pytest

import tofclip
from tofclip.designs import (
    Design,
    analyse_sight,
    design,
    find_inactive_region,
    make_scene,
    optimise_angles,
    predict_accuracy,
    take_shots,
    try_out,
)
from tofclip.errors import InputError

SMALL = {
    "rows_px": 32,
    "columns_px": 32,
    "focal_length_px": 140.0,
    "bins": 300,
    "bin_width_ps": 50.0,
    "pulse_ps": 150.0,
}
CODES = {"sensor": "0d", "views": 3, "sampling_ratio": 0.3, "photons": 2e4}


def test_a_single_upright_view_determines_one_number_of_each_column():
    known = Design(**SMALL, views=1, sensor_px=40, focus_distance_m=np.inf)
    sight = analyse_sight(known)
    assert sight.undetermined == pytest.approx(1 - 1 / 32)
    assert np.ptp(sight.by_pixel) < 1e-9  # all pixels of a column look alike
    # waves across the columns are known, all others are not
    middle = np.arange(32) == 16
    assert np.allclose(sight.by_frequency[middle], 0, atol=1e-9)
    assert np.allclose(sight.by_frequency[~middle], 1, atol=1e-9)


@pytest.mark.parametrize("further", [{"views": 3}, CODES, CODES | {"sensor": "2d"}])
def test_singular_values_are_those_of_the_dense_matrix(further):
    known = Design(**SMALL | further)
    pictures = np.eye(32 * 32, dtype=np.float32).reshape(32, 32, -1)
    if known.encoder is None:
        dense = known.camera.operator(0.1)(pictures)
    else:
        dense = (known.encoder.weighting() @ known.encoder.model(0.1))(pictures)
    expected = np.linalg.svd(dense.astype(np.float64), compute_uv=False)
    found = analyse_sight(known, 0.1).singular_values[: expected.size]
    assert np.allclose(found, expected, atol=2e-3 * expected[0])


@pytest.mark.parametrize("further", [{"views": 7}, CODES], ids=["slit", "0d"])
@pytest.mark.nightly
def test_prediction_and_simulated_shots_agree(further):
    """Within 30 %; the deviation of ranges from 20 shots scatters by 5 % over seeds 0 to 4."""
    known = Design(**SMALL | further)
    scene = make_scene("plates", known)
    predicted, found = predict_accuracy(known, scene), try_out(known, scene, 20)
    for name in ("picture_error", "picture_noise", "median_deviation"):
        assert getattr(predicted, name) == pytest.approx(getattr(found, name), rel=0.3), name


def test_more_photons_bring_less_noise_and_the_same_bias():
    few, many = (Design(**SMALL, photons=n, background_photons=0.0) for n in (100.0, 400.0))
    one, other = (predict_accuracy(each, make_scene("poles", each)) for each in (few, many))
    assert other.picture_bias == pytest.approx(one.picture_bias, rel=1e-3)
    assert one.picture_noise / other.picture_noise == pytest.approx(4, rel=1e-2)
    assert one.median_deviation / other.median_deviation == pytest.approx(2, rel=1e-2)


def test_better_angles_are_better_on_a_scene_that_took_no_part():
    alike = Design(**SMALL, views=3, angles_deg=(0.0, 0.0, 1.0), max_angle_deg=40.0)
    better = optimise_angles(alike)
    assert max(np.abs(better.angles_deg)) <= 40
    errors = [
        predict_accuracy(one, make_scene("letters", one)).picture_error for one in (alike, better)
    ]
    assert errors[1] < 0.9 * errors[0]
    with pytest.raises(InputError, match="no lines"):
        optimise_angles(Design(**SMALL | CODES))


def test_the_inactive_region_is_the_papers():
    """Supplementary Note 10: a baseline of 15 mm, 6 and 10 mm at 50 and 40 mm: 33 and 80 mm."""
    for width, distance, length in ((6.0, 0.05, 0.033), (10.0, 0.04, 0.080)):
        known = Design(pitch_mm=2.5, occluder_mm=width, occluder_distance_m=distance)
        assert find_inactive_region(known).length == pytest.approx(length, abs=0.5e-3)


def test_shots_of_a_design_are_recovered_and_files_hold_it(tmp_path):
    known = Design(**SMALL, views=5)
    known.save(tmp_path / "one.toml")
    assert Design.load(tmp_path / "one.toml") == known
    exposure, shots = take_shots(known, make_scene("plates", known), 1, 0)
    frames = tofclip.recover(next(shots), method="linear")
    assert exposure > 0
    assert len(tofclip.point_cloud(tofclip.depth(frames))) > 50
    assert "undetermined" in repr(design(known))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pich_mm = 2", "no key 'pich_mm'; did you mean 'pitch_mm'"),
        ("sensor = '3d'", "one of slit, 1d, 2d, 0d"),
        ("views = 3\nangles_deg = [1, 2]", "a list of 3 numbers"),
        ("bins = 20", "set bins to"),
        ("far_m = 1.0", "far_m must be more than near_m"),
        ("photons = 'many'", "photons must be a positive number"),
        ("views = [", "is not a TOML file"),
    ],
)
def test_a_description_of_no_instrument_is_refused(tmp_path, text, message):
    (tmp_path / "camera.toml").write_text(text)
    with pytest.raises(tofclip.TofclipError, match=rf"camera\.toml.*{message}"):
        Design.load(tmp_path / "camera.toml")
