"""Surfaces that follow from shot to shot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tofclip.camera import Camera
from tofclip.sequences.following import SurfacePipeline
from tofclip.shots import Returns, Streak
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate, simulate_shot
from tofclip.simulate.patterns import make_plain_pattern


def follow(pipeline: SurfacePipeline, shot: Streak) -> Returns:
    return pipeline.search(pipeline.recover_shot(shot, pipeline.rectify(shot)))


def test_light_that_is_clipped_in_a_later_shot_alone_changes_nothing(streaks: list[Streak]):
    """Each shot says itself which of its measurements are to be trusted."""
    limit = 0.2 * streaks[1].counts.max()
    saturated = streaks[1].counts > limit
    assert 0.005 < saturated.mean() < 0.1
    clipped = replace(streaks[1], counts=np.minimum(streaks[1].counts, limit), saturated=saturated)
    found = []
    for shot in (streaks[1], clipped):
        pipeline = SurfacePipeline.for_shot(streaks[0])
        follow(pipeline, streaks[0])
        found.append(follow(pipeline, shot))
        assert pipeline.searches == 1
    (whole, range_), (light, clipped_light) = (
        [one.image(name) for one in found] for name in ("range", "intensity")
    )
    both = np.isfinite(whole) & np.isfinite(range_)
    assert both.sum() == np.isfinite(whole).sum() > 100
    # a tenth of a bin of 50 ps; taken for measurements, clipped light lacks up to a half
    np.testing.assert_allclose(range_[both], whole[both], atol=7e-4)
    np.testing.assert_allclose(clipped_light[both], light[both], rtol=0.1)


def test_a_scene_that_changes_slowly_is_searched_anew(streaks: list[Streak], camera: Camera):
    """A plate that comes up brighter from shot to shot: what the surfaces leave unexplained is
    compared with what they left when they were found, or it would never have grown by much.
    """
    pixel = 1.3 / 100.0
    plate = make_plate((0.0, 0.0, 1.3), (9 * pixel, 9 * pixel), make_plain_pattern(0.8))
    detector = StreakDetector(128, 50e-12, peak_photons=5e4)
    coming = simulate_shot(Scene((plate,)), Instrument(camera, detector), 0).streak
    pipeline = SurfacePipeline.for_shot(streaks[0])
    for brightness, searches in ((0.0, 1), (0.02, 1), (0.04, 2)):
        counts = streaks[0].counts + np.float32(brightness) * coming.counts
        follow(pipeline, replace(streaks[0], counts=counts))
        assert pipeline.searches == searches
