"""`tofclip clip` on the rendered letters, from light field to scored picture."""

from __future__ import annotations

import json

import numpy as np
import pytest

from apps.cli import main


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


def test_another_file_than_a_measurement_is_refused(tmp_path, capsys):
    (tmp_path / "m.h5").write_bytes(b"nothing")
    out = str(tmp_path / "p.png")
    assert main(["clip", "recover", str(tmp_path / "m.h5"), "--shear", "0", "--out", out]) == 2
    assert "m.h5" in capsys.readouterr().err
    assert not (tmp_path / "p.png").exists()


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
