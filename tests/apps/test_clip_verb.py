"""`tofclip clip` on the rendered letters, from light field to scored picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from apps.cli import main
from tofclip.io.light_fields import write_light_field
from tofclip.light_field import LightField
from tofclip.light_field.measurement import CameraSetup, measure
from tofclip.storage import Record


@pytest.mark.parametrize(("encoder", "worst"), [("line", 0.085), ("single-pixel", 0.043)])
def test_letters_are_recovered(encoder, worst, shared_data, tmp_path, capsys):
    """The bounds are the project's acceptance at half as many measurements as pixels."""
    scene = str(shared_data / "lightfields" / "render_letters.npz")
    measurements, picture = str(tmp_path / "meas.h5"), str(tmp_path / "image.exr")
    simulate = [
        "clip",
        "simulate",
        scene,
        "--encoder",
        encoder,
        "--sampling-ratio",
        "0.5",
        "--out",
        measurements,
        "--json",
    ]
    assert main(simulate) == 0
    assert json.loads(capsys.readouterr().out)["readings"] == 8192
    recover = [
        "clip",
        "recover",
        measurements,
        "--shear",
        "-0.3",
        "--out",
        picture,
        "--truth",
        scene,
        "--json",
    ]
    assert main(recover) == 0
    figures = json.loads(capsys.readouterr().out)
    scores, seconds = (
        {"nmse", "nmse_whole_frame", "nmse_energy"},
        {"seconds", "seconds_setup", "seconds_weight"},
    )
    assert set(figures) == scores | seconds | {"weight", "iterations", "stopped_because"}
    assert figures["nmse"] < worst
    import OpenEXR

    pixels = np.asarray(OpenEXR.File(picture).channels()["Y"].pixels)
    assert pixels.shape == (128, 128)
    assert pixels.min() >= 0


def simulated(shared_data, folder) -> list[str]:
    """Write measurements of the letters; return the beginning of a command that recovers them."""
    scene, measurements = (
        str(shared_data / "lightfields" / "render_letters.npz"),
        str(folder / "meas.h5"),
    )
    assert (
        main(
            [
                "clip",
                "simulate",
                scene,
                "--encoder",
                "line",
                "--sampling-ratio",
                "0.25",
                "--out",
                measurements,
            ]
        )
        == 0
    )
    return ["clip", "recover", measurements, "--shear", "-0.3", "--out", str(folder / "image.h5")]


def test_choices_are_made_by_name(shared_data, tmp_path, capsys):
    recover = simulated(shared_data, tmp_path)
    capsys.readouterr()
    settings = [
        "--prior",
        "collaborative",
        "--preset",
        "quality",
        "--weight",
        "0.03",
        "--data-term",
        "huber",
    ]
    assert main([*recover, *settings, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["weight"] == 0.03
    assert figures["stopped_because"] == "10 calls of the denoiser done"


@pytest.mark.parametrize(
    "wrong",
    [
        ["--prior", "none"],
        ["--weight", "heavy"],
        ["--weight", "-1"],
        ["--preset", "x"],
        ["--data-term", "y"],
    ],
)
def test_choices_that_do_not_exist_end_with_a_line(wrong, shared_data, tmp_path, capsys):
    recover = simulated(shared_data, tmp_path)
    capsys.readouterr()
    assert main([*recover, *wrong]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "image.h5").exists()


@pytest.fixture
def two_cards(tmp_path) -> Path:
    """A near card before a far one, 48 pixels and 4 x 4 views, and what a camera measures."""
    y, x = np.mgrid[:48, :48].astype(float)
    views = [(v, u) for v in range(-2, 2) for u in range(-2, 2)]
    pictures = []
    for v, u in views:
        near = (abs(x + u - 24) < 8) & (abs(y + v - 24) < 8)
        far = 0.2 + 0.4 * (np.floor((x - u) / 5) % 2)
        chequers = 0.4 + 0.6 * ((np.floor((x + u) / 3) + np.floor((y + v) / 3)) % 2)
        pictures.append(np.where(near, chequers, far))
    field = LightField(np.stack(pictures).astype(np.float32), np.array(views, float))
    write_light_field(field, tmp_path / "field.h5")
    measure(field, CameraSetup("line-even", 2.0, 0)).save(tmp_path / "meas.h5")
    # a map of the near card before the far one
    np.save(tmp_path / "map.npy", np.where((abs(x - 24) < 8) & (abs(y - 24) < 8), -1.0, 1.0))
    return tmp_path


def recover_cards(folder, out: str, *options: str) -> int:
    """Recover the cards at the near one's depth; return the exit status."""
    words = ["--shear", "-1", "--out", str(folder / out), "--weight", "3e-4", "--json"]
    paths = [str(folder / word) if word[0].isalpha() and "." in word else word for word in options]
    return main(["clip", "recover", str(folder / "meas.h5"), *words, *paths])


def test_surfaces_are_recovered_with_depths_that_are_known_or_found(two_cards, capsys):
    truth = ["--truth", "field.h5", "--preset", "surfaces"]
    known = [*truth, "--depth-map", "map.npy", "--all-in-focus", "sharp.h5"]
    assert recover_cards(two_cards, "near.h5", *known) == 0
    figures = json.loads(capsys.readouterr().out)
    assert set(figures) == {
        *("nmse", "nmse_whole_frame", "nmse_energy", "nmse_all_in_focus"),
        *("weight", "iterations", "stopped_because", "seconds"),
    }
    assert max(figures["nmse"], figures["nmse_all_in_focus"]) < 0.1
    # its own file serves as a map again
    again = [*truth, "--depth-map", "sharp.h5", "--all-in-focus", "sharp.png"]
    assert recover_cards(two_cards, "again.h5", *again) == 0
    # near things grow by a pixel once more, as in every map that is given
    assert json.loads(capsys.readouterr().out)["nmse"] < 0.1
    # without a map, beside the plain picture
    found = ["--truth", "field.h5", "--all-in-focus", "found.h5", "--shear-range", "-1.5", "1.5"]
    assert recover_cards(two_cards, "plain.h5", *found) == 0
    plain = json.loads(capsys.readouterr().out)
    assert {"nmse_all_in_focus", "seconds_weight"} <= set(plain)
    shears = Record.load(two_cards / "found.h5", "picture").array("shears", np.float64, 2, "px")
    assert np.median(shears[18:30, 18:30]) == pytest.approx(-1.0, abs=0.31)  # a step and its half


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--all-in-focus", "p.h5"], "same file"),
        (["--depth-map", "map.npy"], "--preset surfaces"),
        (["--preset", "surfaces", "--depth-map", "field.h5"], "picture"),
        (["--preset", "surfaces", "--depth-map", "none.npy"], "no such file"),
        (["--preset", "surfaces", "--shear-range", "1", "-1"], "smaller"),
    ],
)
def test_surfaces_that_cannot_be_are_refused(two_cards, options, reason, capsys):
    assert recover_cards(two_cards, "p.h5", *options) == 2
    message = capsys.readouterr().err
    assert reason in message
    assert len(message.strip().splitlines()) == 1
