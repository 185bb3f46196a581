"""`tofclip occlusion` on its own."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import matplotlib.image
import pytest
from small_instrument import Run

from apps.cli import main
from apps.figures import occlusion as occlusion_figures
from apps.occlusion.scenes import SCENES, make_occlusion_scene
from apps.verbs.occlusion import SCENE_NAMES


def test_the_inactive_length_of_the_papers_experiment(run: Run, tmp_path: Path) -> None:
    words = (
        "--baseline-mm",
        15,
        "--width-mm",
        6,
        "--distance-mm",
        50,
        "--out",
        tmp_path / "region.png",
    )
    outcome = run("occlusion", "region", *words, "--json")
    assert outcome.status == 0
    assert json.loads(outcome.out)["inactive_length_m"] == pytest.approx(0.1 / 3)
    assert matplotlib.image.imread(tmp_path / "region.png").std() > 0.05


def test_a_wide_occluder_promises_nothing_and_says_so(run: Run) -> None:
    reported = json.loads(run("occlusion", "region", "--width-mm", 15, "--json").out)
    assert reported["inactive_length_m"] is None
    assert "nothing" in reported["promised"]


def test_alone_it_shows_its_verbs(run: Run) -> None:
    assert "region" in run("occlusion").out


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("occlusion") / "made"
    words = [
        "occlusion",
        "demo",
        "--scene",
        "plate",
        "--side-px",
        "40",
        "--sampling-ratio",
        "1",
        "--moving",
    ]
    with contextlib.redirect_stdout(io.StringIO()) as out, pytest.MonkeyPatch.context() as patch:
        patch.setattr(occlusion_figures, "WALK_STEPS", 3)
        assert main([*words, "--out", str(folder), "--json"]) == 0
    return folder, json.loads(out.getvalue())


def test_the_demonstration_agrees_with_the_formula(
    demonstrated: tuple[Path, dict[str, Any]],
) -> None:
    _, reported = demonstrated
    assert reported["inactive_length_m"] == pytest.approx(0.1 / 3)
    assert len(reported["targets"]) == 4
    for target in reported["targets"]:
        assert (target["correlation"] >= 0.8) == target["expected_visible"]
        assert target["expected_visible"] == (
            target["distance_m"] > 0.05 + reported["inactive_length_m"]
        )
    assert reported["nmse"] < 0.3
    others = ("single_view", "light_field_camera", "without_model_of_occluder")
    assert all(reported["correlation"] > reported[f"correlation_{name}"] for name in others)


def test_the_demonstration_leaves_a_picture_and_a_film(
    demonstrated: tuple[Path, dict[str, Any]],
) -> None:
    from PIL import Image

    folder, _ = demonstrated
    assert sorted(path.name for path in folder.iterdir()) == [
        "occlusion.gif",
        "occlusion.png",
        "occlusion_moving.gif",
    ]
    assert matplotlib.image.imread(folder / "occlusion.png").std() > 0.05
    # three steps to the right and one on the way back; the flash has some six bright instants at
    # each return
    for name, fewest, most in (("occlusion_moving.gif", 4, 4), ("occlusion.gif", 10, 20)):
        with Image.open(folder / name) as film:
            assert fewest <= film.n_frames <= most
            assert film.info["loop"] == 0


def test_in_the_film_the_target_moves_from_left_to_right_and_the_occluder_stays() -> None:
    scene = make_occlusion_scene("plate")
    moved = scene.move_target(0.01)
    assert moved.target[0].centre[0] == pytest.approx(scene.target[0].centre[0] + 0.01)
    assert moved.occluder is scene.occluder


def test_behind_a_board_nothing_is_promised(run: Run, tmp_path: Path) -> None:
    words = ("--scene", "board", "--side-px", 32, "--out", tmp_path)
    reported = json.loads(run("occlusion", "demo", *words, "--json").out)
    assert reported["inactive_length_m"] is None
    assert reported["targets"] == [
        {"distance_m": pytest.approx(0.12), "correlation": 0.0, "expected_visible": False}
    ]


def test_the_names_of_the_scenes_are_those_that_exist() -> None:
    assert tuple(SCENES) == SCENE_NAMES
