"""`tofclip clip` on the rendered letters, from light field to scored picture."""

from __future__ import annotations

import json

import numpy as np
import pytest

from apps.cli import main


@pytest.mark.parametrize(("encoder", "worst"), [("line", 0.085), ("single-pixel", 0.043)])
def test_letters_are_recovered(encoder, worst, shared_data, tmp_path, capsys):
    """The bounds are the project's acceptance at half as many readings as pixels."""
    scene = str(shared_data / "lightfields" / "render_letters.npz")
    readings, picture = str(tmp_path / "meas.h5"), str(tmp_path / "image.exr")
    simulate = ["clip", "simulate", scene, "--encoder", encoder, "--sampling-ratio", "0.5", "--out", readings, "--json"]
    assert main(simulate) == 0
    assert json.loads(capsys.readouterr().out)["readings"] == 8192
    recover = ["clip", "recover", readings, "--shear", "-0.3", "--out", picture, "--truth", scene, "--json"]
    assert main(recover) == 0
    figures = json.loads(capsys.readouterr().out)
    wanted = {"nmse", "nmse_whole_frame", "nmse_energy", "weight", "iterations", "seconds", "seconds_setup"}
    assert set(figures) == wanted | {"stopped_because"}
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
