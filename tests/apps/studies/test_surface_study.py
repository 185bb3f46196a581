"""Surfaces beside frames, on the study's scenes."""

from __future__ import annotations

import pytest

from apps.studies.surfaces import SCENES, make_scene_instrument, score_methods


@pytest.mark.nightly
@pytest.mark.parametrize("name", SCENES)
def test_surfaces_are_never_worse_than_frames_in_good_light(name: str) -> None:
    found = score_methods(SCENES[name](), make_scene_instrument(name, 2000), 0, fit=False)
    ours = found["surfaces"].figures
    others = [found[method].figures for method in ("l1", "tv")]
    # on seed 0: 0.57 on slanted plates, 0.64 and 0.70 of l1 on wires and gauze
    assert ours["image_nmse"] < 0.9 * min(one["image_nmse"] for one in others)
    right = "share_within_one_bin"
    assert ours[right] >= max(one[right] for one in others)
