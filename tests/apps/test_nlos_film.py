"""`tofclip nlos film`: the flash passing through the hidden scene."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from hidden_point import POINT, object_of
from PIL import Image
from small_instrument import Run

from apps.mp4 import open_film
from nlos import Capture, TransientVideo
from tofclip.errors import StorageError
from tofclip.units import SPEED_OF_LIGHT

QUICK = ["--voxel-mm", 40, "--instants", 5]


def test_the_point_lights_up_when_the_flash_reaches_it(
    run: Run, curved: Path, tmp_path: Path
) -> None:
    words = [
        "film",
        curved,
        "--every-depth",
        "--voxel-mm",
        20,
        "--instants",
        41,
        "--out",
        tmp_path / "film.h5",
    ]
    found = object_of(run, *words)
    video = TransientVideo.load(tmp_path / "film.h5")
    assert video.values.shape == (41, *found["voxels"])
    arrival = np.linalg.norm(Capture.load(curved).laser - POINT) / SPEED_OF_LIGHT
    lit = video.times[video.values[:, *video.grid.find_nearest(POINT)].argmax()]
    # A tenth of a nanosecond is the distance to the voxel's middle and half the step of time.
    assert lit == pytest.approx(arrival, abs=0.1e-9)
    # By default it begins before the flash arrives, and ends after it left.
    assert found["first_ns"] < arrival / 1e-9 < found["last_ns"]
    assert video.provenance["settings"]["verb"] == "nlos film"


def test_films_and_numbers_of_front_views(run: Run, curved: Path, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    for suffix in (".gif", ".mp4", ".h5"):
        object_of(
            run,
            "film",
            curved,
            *QUICK,
            "--first-ns",
            1,
            "--last-ns",
            3,
            "--out",
            tmp_path / f"film{suffix}",
        )
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 5
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"
    video = TransientVideo.load(tmp_path / "film.h5")
    assert video.values.ndim == 3
    np.testing.assert_allclose(video.times, 1e-9 * np.linspace(1, 3, 5), rtol=1e-12)


def test_its_settings_give_the_same_film(run: Run, curved: Path, tmp_path: Path) -> None:
    object_of(run, "film", curved, *QUICK, "--out", tmp_path / "one.h5")
    object_of(
        run, "film", curved, "--settings", tmp_path / "one.toml", "--out", tmp_path / "two.h5"
    )
    one, two = (TransientVideo.load(tmp_path / f"{name}.h5") for name in ("one", "two"))
    np.testing.assert_array_equal(one.values, two.values)
    np.testing.assert_array_equal(one.times, two.times)


def test_without_opencv_there_is_no_mp4(
    run: Run, curved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    refused = run("nlos", "film", curved, "--out", tmp_path / "film.mp4")
    assert refused.status == 2
    assert "tofclip[film]" in refused.err
    assert refused.err.count("\n") == 1


@pytest.mark.parametrize("part", [0, 0.3, 0.999])
def test_a_film_that_the_disk_cut_short_is_no_result(tmp_path: Path, part: float) -> None:
    pytest.importorskip("cv2")
    pictures = np.random.default_rng(1).integers(0, 255, (8, 48, 64, 3), dtype=np.uint8)

    def write(name: str, share: float) -> None:
        with open_film(tmp_path / name, 10.0) as film:
            for picture in pictures:
                film.add(picture)
            film.close()
            whole = film.path.stat().st_size
            os.truncate(film.path, int(share * whole))

    write("whole.mp4", 1)
    with pytest.raises(StorageError, match=r"cut\.mp4: cannot be written: the disk is full"):
        write("cut.mp4", part)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.mp4"]
