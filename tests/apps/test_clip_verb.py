"""`tofclip clip`, from light field to scored picture."""

import h5py
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from small_instrument import two_cards, write_views

from tofclip.storage import Record

LETTERS = "{shared_data}/lightfields/render_letters.npz"
SCORES = {"nmse", "nmse_whole_frame", "nmse_energy"}


def simulate(shell, encoder, ratio):
    words = f"--encoder {encoder} --sampling-ratio {ratio} --out meas.h5"
    return shell.figures(f"clip simulate {LETTERS} {words}")["readings"]


@pytest.mark.parametrize(
    ("encoder", "worst"),
    [("line", 0.085), pytest.param("single-pixel", 0.043, marks=pytest.mark.nightly)],
)
def test_letters_are_recovered(shell, shared_data, encoder, worst):
    """The bounds are the project's acceptance at half as many measurements as pixels."""
    assert simulate(shell, encoder, 0.5) == 8192
    words = f"--shear -0.3 --out image.exr --truth {LETTERS}"
    assert shell.figures(f"clip recover meas.h5 {words}")["nmse"] < worst
    pixels = np.asarray(OpenEXR.File("image.exr").channels()["Y"].pixels)
    assert pixels.shape == (128, 128)
    assert pixels.min() >= 0


@pytest.mark.nightly
def test_choices_are_made_by_name(shell, shared_data):
    simulate(shell, "line", 0.25)
    choices = "--prior collaborative --preset quality --weight 0.03 --data-term huber"
    figures = shell.figures(f"clip recover meas.h5 --shear -0.3 --out image.h5 {choices}")
    assert figures["weight"] == 0.03
    assert figures["stopped_because"] == "10 calls of the denoiser done"


def test_surfaces_are_recovered_with_depths_that_are_known_or_found(shell, tmp_path):
    two_cards(tmp_path)
    line = "clip recover meas.h5 --shear -1 --weight 3e-4 --truth field.h5"
    known = "--preset surfaces --depth-map map.npy --all-in-focus sharp.h5 --out near.h5"
    figures = shell.figures(f"{line} {known}")
    assert max(figures["nmse"], figures["nmse_all_in_focus"]) < 0.1
    # its own file serves as a map again
    again = "--preset surfaces --depth-map sharp.h5 --all-in-focus sharp.png --out again.h5"
    # near things grow by a pixel once more, as in every map that is given
    assert shell.figures(f"{line} {again}")["nmse"] < 0.1
    # without a map, beside the plain picture
    found = "--all-in-focus found.h5 --shear-range -1.5 1.5 --out plain.h5"
    assert {"nmse_all_in_focus", "seconds_weight"} | SCORES <= set(shell.figures(f"{line} {found}"))
    shears = Record.load(tmp_path / "found.h5", "picture").array("shears", np.float64, 2, "px")
    assert np.median(shears[18:30, 18:30]) == pytest.approx(-1.0, abs=0.31)  # a step and its half


def test_every_format_holds_the_same_picture(shell, tmp_path):
    """Opened by libraries that know nothing of this program: a slope, bright at the upper left, so
    that no turn or mirror goes unseen.
    """
    row, column = np.indices((24, 32))
    slope = 0.2 + 0.5 * (1 - row / 24) + 0.3 * (1 - column / 32)
    views = [(v, u) for v in (-1, 0, 1) for u in (-1, 0, 1)]
    write_views(tmp_path / "field.h5", views, lambda v, u: slope)
    words = "--encoder line --sampling-ratio 1 --out readings.h5"
    assert shell(f"clip simulate field.h5 {words}").status == 0
    for suffix in ("h5", "exr", "png"):
        words = f"--shear 0 --weight 0.001 --out picture.{suffix}"
        assert shell(f"clip recover readings.h5 {words}").status == 0
    found = []
    with h5py.File("picture.h5") as file:
        file.visititems(
            lambda _, node: (
                found.append(node[...])
                if isinstance(node, h5py.Dataset) and node.shape == slope.shape
                else None
            )
        )
    picture = found[0]
    assert picture.dtype == np.float32
    assert picture[:8, :8].mean() > picture[:8, -8:].mean() > picture[-8:, -8:].mean()
    exr = OpenEXR.File("picture.exr").channels()["Y"].pixels
    np.testing.assert_array_equal(exr, picture)
    with Image.open("picture.png") as image:
        grey = np.asarray(image, float)[..., 0]
    # Brightness becomes one of 256 steps, and that step a whole number of 255: each may lose one.
    np.testing.assert_allclose(grey / 255, picture / picture.max(), atol=2 / 255)
