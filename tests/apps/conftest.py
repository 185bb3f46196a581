"""Run the program in this process, on the files of a small instrument."""

import numpy as np
import pytest
import tifffile
from small_instrument import (
    HIDDEN_SCENE,
    Shell,
    draw_squares,
    focus_pictures,
    make_camera,
    take_shot,
    wall_shot,
)

from apps.verbs import nlos_imaging


@pytest.fixture
def shell(request, tmp_path, monkeypatch):
    """Run the program in this process, in the test's own folder."""
    monkeypatch.chdir(tmp_path)
    return Shell(request)


@pytest.fixture(scope="session")
def camera():
    """Camera without skew, whose numbers made the small streak image."""
    return make_camera()


@pytest.fixture(scope="session")
def streak(camera):
    """The shot of two squares, with Poisson noise."""
    return take_shot(camera, draw_squares())


@pytest.fixture(scope="session")
def files(tmp_path_factory, camera, streak):
    """Folder with what a user would have: streak images, a camera file and four focus pictures."""
    folder = tmp_path_factory.mktemp("instrument")
    streak.save(folder / "streak.h5")
    camera.save(folder / "camera.h5")
    tifffile.imwrite(folder / "streak.tif", streak.counts.astype(np.uint16))
    wall_shot(streak).save(folder / "wall.h5")
    for name, picture in focus_pictures().items():
        tifffile.imwrite(folder / f"{name}.tif", picture)
    return folder


@pytest.fixture(scope="session")
def curved(request, tmp_path_factory):
    """A hidden point before a curved wall of 24 x 24 points."""
    out = tmp_path_factory.mktemp("curved") / "capture.h5"
    Shell(request).figures(f"nlos simulate {HIDDEN_SCENE} --wall-points 24 --out {out}")
    return out


@pytest.fixture(scope="session")
def confocal(request, tmp_path_factory):
    """The same point before a planar wall of 32 x 32 points, scanned confocally."""
    out = tmp_path_factory.mktemp("confocal") / "capture.h5"
    scan = f"{HIDDEN_SCENE} --wall planar --scan confocal --wall-points 32"
    Shell(request).figures(f"nlos simulate {scan} --out {out}")
    return out


@pytest.fixture(scope="session")
def demo_folder(tmp_path_factory):
    """Where the demonstration puts its files."""
    return tmp_path_factory.mktemp("demo") / "new" / "demo"


@pytest.fixture(scope="session")
def demonstration(request, demo_folder):
    """Figures of `tofclip demo`; who asks for it is in the group ``golden``."""
    return Shell(request).figures("demo --out {demo_folder} --seed 1")


@pytest.fixture(scope="session")
def letters_folder(tmp_path_factory):
    """Where the demonstration around the corner puts its files."""
    return tmp_path_factory.mktemp("letters") / "demo"


@pytest.fixture(scope="session")
def hidden_letters(request, letters_folder):
    """Figures of `tofclip nlos demo` on a coarser wall and with fewer voxels; who asks for it is in
    the group ``golden``.
    """
    small = {"WALL_POINTS": 24, "FACET_M": 0.06, "WAVELENGTH_M": 0.34, "VOXEL_M": 0.06}
    with pytest.MonkeyPatch.context() as coarser:
        for name, value in small.items():
            coarser.setattr(nlos_imaging, name, value)
        return Shell(request).figures("nlos demo --out {letters_folder} --seed 1")
