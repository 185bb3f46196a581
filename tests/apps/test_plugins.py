"""The registry: names of ours that stay, parts of others that are found, used, or told what is wrong
with, and settings that are given as texts.
"""

import configparser
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import devices
import tofclip
from apps.cli import main
from devices.registry import CODECS, FINDERS, SOURCES
from nlos.io.format_detection import READERS as CAPTURE_READERS
from nlos.settings import METHODS as HIDDEN_SCENE_METHODS
from nlos.settings import Settings
from tofclip.errors import FileFormatError, InputError
from tofclip.loading import outline
from tofclip.plugins import DENOISERS, METHODS, READERS, Reader, list_settings
from tofclip.recovery import make_method
from tofclip.solvers import PlugAndPlay, RegularisationByDenoising, TotalVariation

KEPT = {
    "tofclip.methods": "auto tv l1 linear adjoint surfaces wavelet pnp red",
    "tofclip.denoisers": "collaborative bm3d nlm",
    "tofclip.readers": "tiff lift hdf5 itex",
    "tofclip.codecs": "frames linospad2 timetag",
    "tofclip.finders": "timetag aravis",
    "nlos.methods": "rsd hybrid backprojection filtered-backprojection lct fk",
    "nlos.readers": "npz matlab hdf5",
    "tofclip.sources": "aravis linospad2 remoteex spad512 timetag tmf8828 vl53l8 sim+aravis"
    " sim+linospad2 sim+remoteex sim+spad512 sim+timetag sim+tmf8828 sim+vl53l8"
    " .dat .tif .phu .ptu .sdt .ttbin .h5 .hdf5",
}
EVERY = (
    METHODS,
    DENOISERS,
    READERS,
    CODECS,
    SOURCES,
    FINDERS,
    HIDDEN_SCENE_METHODS,
    CAPTURE_READERS,
)
PAGE = Path(tofclip.__file__).parents[1] / "docs" / "extending.md"
PACKAGE = """
from tofclip.plugins import Reader
from tofclip.solvers.denoising import NonlocalMeans
from tofclip import Streak
import numpy as np

class Half:
    def __init__(self, share: float = 0.5, twice: bool = False): self.share = share
    def __call__(self, noisy, pilot, deviation): return noisy * self.share

def read(path):
    "Read ``MINE`` and a number."
    return Streak(np.full((4, 5), float(path.read_text().split()[1]), np.float32))

TEXTS = Reader((b"MINE",), read)

def find():
    from devices import DiscoveredInstrument
    return [DiscoveredInstrument("mine://7", "my instrument")]
"""
ENTRIES = """
[tofclip.denoisers]
half = mine:Half
nlm = mine:Half
broken = mine.absent:Half
[tofclip.readers]
texts = mine:TEXTS
broken = mine:ABSENT
[tofclip.finders]
mine = mine:find
broken = mine:absent
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package that offers parts, installed for one test."""
    place = tmp_path / "installed"
    (place / "mine-1.0.dist-info").mkdir(parents=True)
    (place / "mine.py").write_text(PACKAGE)
    (place / "mine-1.0.dist-info" / "METADATA").write_text("Name: mine\nVersion: 1.0\n")
    (place / "mine-1.0.dist-info" / "entry_points.txt").write_text(ENTRIES)
    monkeypatch.syspath_prepend(place)
    forget()
    yield place
    monkeypatch.undo()
    sys.modules.pop("mine", None)
    forget()


def forget():
    for parts in EVERY:
        for name in ("_points", "offered"):
            vars(parts).pop(name, None)


@pytest.mark.parametrize("parts", EVERY, ids=lambda parts: parts.group)
def test_a_name_stays_and_what_it_names_is_there(parts):
    named = KEPT[parts.group].split()
    for name in named:
        assert name in parts.own, (
            f"the {parts.kind} '{name}' is gone from {parts.group}: commands, files and other "
            "packages name it; keep the name, or say in the changelog what takes its place"
        )
    assert {*parts.own} == {*named}, "a new name is noted in KEPT: from now on it stays"
    for name in parts.own:
        assert callable(parts[name]) or isinstance(parts[name], Reader)


def install(guide, place):
    """Write the files that a page shows, each named by its first line, as pip would install them."""
    blocks = re.findall(r"^```(?:python|toml)\n# (\S+)\n(.*?)^```", guide.read_text(), re.M | re.S)
    for name, text in blocks:
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)
    project = tomllib.loads((place / "pyproject.toml").read_text())["project"]
    known = place / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    known.mkdir()
    (known / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    tables = configparser.ConfigParser()
    tables.read_dict(project["entry-points"])
    with open(known / "entry_points.txt", "w") as file:
        tables.write(file)


# Lines, blank ones and all, that a part may take.
LENGTHS = {"denoiser": 25, "prior": 40, "method": 50, "hidden": 50, "reader": 40, "instrument": 120}


@pytest.mark.nightly
def test_the_page_makes_a_package_whose_parts_are_used(tmp_path):
    install(PAGE, tmp_path / "installed")
    found = {one.stem: len(one.read_text().splitlines()) for one in tmp_path.rglob("my_parts/*.py")}
    assert found.keys() == LENGTHS.keys()
    assert all(found[name] <= most for name, most in LENGTHS.items()), found
    code = (
        "from pathlib import Path; from guides import run_guide\n"
        f"for step, status in run_guide(Path({str(PAGE)!r})): assert status == 0, step"
    )
    paths = (tmp_path / "installed", PAGE.parents[1], PAGE.parent)
    there = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, cwd=tmp_path, env=there, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "my-parts 0.1" in done.stdout
    # of two plates 15 cm apart the light comes 8 and 9 ns after the pulse of 0.2 ns, in bins of 0.1 ns
    for name in ("denoised", "elastic", "likely"):
        frames = tofclip.load(tmp_path / f"{name}.h5")
        light = frames.values.sum(axis=(1, 2))
        lit = frames.times[light > 0.2 * light.max()]
        assert (lit.min(), lit.max()) == pytest.approx((8.0e-9, 9.0e-9), abs=0.3e-9), name
    # within two voxels of 15 mm
    found_at = tofclip.load(tmp_path / "hidden.h5").find_brightest()
    assert found_at == pytest.approx((0.1, -0.05, 0.6), abs=0.03)


def test_nothing_is_looked_for_before_it_is_needed():
    code = "import sys, tofclip.plugins as p, apps.cli; p.METHODS['tv']; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "importlib.metadata" not in done.stdout.split()


def test_parts_of_a_package_are_used(package, tmp_path, shell):
    made = make_method("pnp", denoiser="half", share="0.25", strength="0.2", iterations=7)
    assert (made.denoiser.share, made.strength, made.start.iterations) == (0.25, 0.2, 7)
    (tmp_path / "shot.txt").write_text("MINE 3")
    assert tofclip.read_streak(tmp_path / "shot.txt").counts[0, 0] == 3
    with devices.open(f"file://{tmp_path}/shot.txt") as source:
        assert next(iter(source)).records["counts"][0, 0, 0] == 3
    assert outline(tmp_path / "shot.txt").fields["counts"].values.shape == (4, 5)
    assert "values" not in shell.figures(f"info {tmp_path}/shot.txt")["fields"]["counts"]
    (tmp_path / "other.txt").write_text("OTHER")
    with pytest.raises(
        FileFormatError, match=r"is not a streak image.*texts.*; reader 'broken' of mine 1\.0 does"
    ):
        tofclip.read_streak(tmp_path / "other.txt")


def test_instruments_of_a_package_are_found(package):
    found = {one.uri: one for one in devices.discover()}
    assert found["mine://7"].instrument == "my instrument"
    broken = found["broken://"]
    assert (broken.instrument, "does not load" in broken.note) == ("mine 1.0", True)


def test_what_is_wrong_with_a_package_is_a_line(package, shell):
    listed = shell.figures("plugins")["parts"]
    assert all(one["meaning"] for one in listed if one["origin"] == "tofclip")
    own = {(one["name"], one["fault"]) for one in listed if one["origin"] == "mine 1.0"}
    names, faults = [name for name, _ in own], [fault for _, fault in own if fault]
    assert sorted(names) == ["broken"] * 3 + ["half", "mine", "nlm", "texts"]
    assert sorted(fault.partition(":")[0] for fault in faults) == [
        "denoiser 'broken' of mine 1.0 does not load",
        "finder 'broken' of mine 1.0 does not load",
        "not used",
        "reader 'broken' of mine 1.0 does not load",
    ]
    with pytest.raises(InputError, match="does not load: ModuleNotFoundError"):
        make_method("pnp", denoiser="broken")
    assert "--set share=0.5" in shell("plugins half").out
    assert main(["plugins", "absent"]) == 2
    assert "?zones=16" in shell("plugins vl53l8").out
    assert "Read ``MINE``" in shell("plugins texts").out


def test_a_notebook_registers_a_part(monkeypatch):
    monkeypatch.setattr(METHODS, "registered", {})
    tofclip.register_method("mine", lambda weight=1.0: TotalVariation(weight))
    assert make_method("mine", weight="0.5") == TotalVariation(0.5)
    assert METHODS.get_origin("mine") == "registered"
    with pytest.raises(InputError, match="'tv' is tofclip's own"):
        tofclip.register_method("tv", TotalVariation)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"denoiser": "absent"}, "unknown denoiser 'absent'; choose one of collaborative"),
        ({"gamma": "2"}, "'pnp' does not take gamma; its settings are start, denoiser, calls"),
        ({"denoiser": "nlm", "sigma": "3"}, "coupling, patch_px, reach_px, filtering"),
        ({"calls": "2.5"}, "calls must be a whole number, got '2.5'"),
        ({"strength": "x"}, "strength must be a number, got 'x'"),
        ({"start": "tv"}, "start can be given in Python only"),
        ({"denoiser": "nlm", "patch_px": "a"}, "'nlm': patch_px must be a whole number"),
    ],
)
def test_a_setting_that_cannot_be_is_refused(settings, said):
    with pytest.raises(InputError, match=said):
        make_method("pnp", **settings)


def test_methods_with_a_denoiser_are_named():
    assert make_method("pnp", weight=2e-3) == PlugAndPlay(TotalVariation(2e-3))
    assert make_method("red", coupling="0.2") == RegularisationByDenoising(coupling=0.2)


def test_a_hidden_scene_method_takes_what_it_names():
    for name in HIDDEN_SCENE_METHODS.own:
        assert {*list_settings(HIDDEN_SCENE_METHODS[name])} & {"wavelength", "sigma", "falloff"}
    made = Settings(wavelength=0.1, sigma=0.3).make_method("filtered-backprojection")
    assert np.isclose(made.sigma, 0.3)
    wanted = Settings(wavelength=0.1, method="hybrid", set=["plane_z=0.4"])
    assert (wanted.make_method().plane_z, wanted.make_method("rsd").cycles) == (0.4, 3.0)
    with pytest.raises(InputError, match="name it"):
        Settings(set=["plane_z=0.4"])
    with pytest.raises(InputError, match="'fk' does not take plane_z; its settings are falloff"):
        Settings(method="fk", set=["plane_z=0.4"]).make_method()
