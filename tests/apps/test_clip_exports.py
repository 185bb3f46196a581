"""A recovered picture in every format, opened by libraries that know nothing of this program."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from small_instrument import Run

from tofclip.io.light_fields import write_light_field
from tofclip.light_field import LightField

SHAPE = (24, 32)


@pytest.fixture
def measurements(run: Run, tmp_path: Path) -> Path:
    """Measurements of a slope without parallax: bright at the upper left, so that no turn or mirror
    goes unseen.
    """
    row, column = np.indices(SHAPE)
    slope = (0.2 + 0.5 * (1 - row / SHAPE[0]) + 0.3 * (1 - column / SHAPE[1])).astype(np.float32)
    views = np.array([(v, u) for v in (-1, 0, 1) for u in (-1, 0, 1)], float)
    write_light_field(LightField(np.stack([slope] * 9), views), tmp_path / "field.h5")
    words = ("simulate", tmp_path / "field.h5", "--encoder", "line", "--sampling-ratio", "1")
    assert run("clip", *words, "--out", tmp_path / "readings.h5").status == 0
    return tmp_path / "readings.h5"


def test_every_format_holds_the_same_picture(run: Run, measurements: Path, tmp_path: Path) -> None:
    for suffix in ("h5", "exr", "png"):
        out = tmp_path / f"picture.{suffix}"
        assert (
            run(
                "clip", "recover", measurements, "--shear", "0", "--weight", "0.001", "--out", out
            ).status
            == 0
        )
    with h5py.File(tmp_path / "picture.h5") as file:
        stored = next(node for node in _datasets(file) if node.shape == SHAPE)
        picture = stored[...]
    assert picture.dtype == np.float32
    assert picture[:8, :8].mean() > picture[:8, -8:].mean() > picture[-8:, -8:].mean()
    exr = OpenEXR.File(str(tmp_path / "picture.exr")).channels()["Y"].pixels
    np.testing.assert_array_equal(exr, picture)
    with Image.open(tmp_path / "picture.png") as image:
        grey = np.asarray(image, float)[..., 0]
    # Brightness becomes one of 256 steps, and that step a whole number of 255: each may lose one.
    np.testing.assert_allclose(grey / 255, picture / picture.max(), atol=2 / 255)


def _datasets(file: h5py.File) -> list[h5py.Dataset]:
    found: list[h5py.Dataset] = []
    file.visititems(lambda _, node: found.append(node) if isinstance(node, h5py.Dataset) else None)
    return found
