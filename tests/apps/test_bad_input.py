"""What cannot be used is refused in one line with exit status 2, and no file appears."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from small_instrument import SLIT_WIDTH_PX, Outcome, Run

from tofclip import Camera, Streak

Maker = Callable[[Path, Path], Path]


def picture(folder: Path, counts: np.ndarray) -> Path:
    tifffile.imwrite(folder / "bad.tif", counts)
    return folder / "bad.tif"


def cut_short(original: Path, copy: Path) -> Path:
    copy.write_bytes(original.read_bytes()[: original.stat().st_size // 2])
    return copy


def of_bytes(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


STREAKS: dict[str, tuple[Maker, str]] = {
    "absent": (lambda files, new: new / "absent.tif", "no such file"),
    "an empty folder": (lambda files, new: new, "there is no file"),
    "truncated TIFF": (
        lambda files, new: cut_short(files / "streak.tif", new / "bad.tif"),
        "truncated",
    ),
    "truncated HDF5": (
        lambda files, new: cut_short(files / "streak.h5", new / "bad.h5"),
        "damaged or incomplete",
    ),
    "empty": (lambda files, new: of_bytes(new / "bad.tif", b""), "is empty"),
    "another format": (
        lambda files, new: of_bytes(new / "bad.tif", b"a letter to a friend"),
        "is not a TIFF",
    ),
    "another record": (lambda files, new: files / "camera.h5", "holds a camera record"),
    "all zero": (
        lambda files, new: picture(new, np.zeros((96, SLIT_WIDTH_PX), np.uint16)),
        "every pixel is zero",
    ),
    "saturated": (
        lambda files, new: picture(new, np.full((96, SLIT_WIDTH_PX), 65535, np.uint16)),
        "saturated",
    ),
    "NaN": (
        lambda files, new: picture(new, np.full((96, SLIT_WIDTH_PX), np.nan, np.float32)),
        "NaN",
    ),
    "negative": (
        lambda files, new: picture(new, np.full((96, SLIT_WIDTH_PX), -3, np.int16)),
        "negative",
    ),
    "wrong width": (
        lambda files, new: picture(new, np.arange(96 * 200, dtype=np.uint16).reshape(96, 200)),
        "columns",
    ),
    "no light": (
        lambda files, new: picture(new, np.full((96, SLIT_WIDTH_PX), 7, np.uint16)),
        "was there any light",
    ),
}


def assert_refused(outcome: Outcome, reason: str) -> None:
    assert outcome.status == 2
    assert outcome.out == ""
    assert outcome.err.startswith("tofclip: error: ")
    assert outcome.err.count("\n") == 1
    assert reason in outcome.err


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Empty folder for results."""
    (tmp_path / "results").mkdir()
    return tmp_path / "results"


@pytest.mark.parametrize("case", STREAKS)
def test_streaks(run: Run, files: Path, tmp_path: Path, folder: Path, case: str) -> None:
    make, reason = STREAKS[case]
    bad = make(files, tmp_path)
    words = [
        "recover",
        bad,
        "--camera",
        files / "camera.h5",
        "--out",
        folder / "frames.h5",
        "--bin-width-ps",
        20,
    ]
    assert_refused(run(*words), reason)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (["--method", "best"], "unknown method 'best'; choose one of tv, l1"),
        (["--method", "linear", "--iterations", "4"], "does not take iterations"),
        (["--iterations", "0"], "at least one iteration"),
        (["--bin-width-ps", "-20"], "positive number of seconds"),
        (["--bin-width-ps", "nan"], "positive number of seconds"),
        (["--time-zero-ns", "inf"], "time zero must be finite"),
        (["--iterations", "many"], "(see --help)"),
        (["--out", "frames.txt"], "must end in .h5"),
        (["--preview", "frames.doc"], "must end in .png"),
        (["--preview", "absent/frames.png"], "the folder does not exist"),
        (["--out", "absent/frames.h5"], "the folder does not exist"),
        (["--out", __file__ + "/frames.h5"], "its folder is a file"),
        (["--out", "."], "it is a folder; name a file"),
        (["--out", ""], "an argument is empty"),
        (["--out", 300 * "x" + ".h5"], "name too long"),
    ],
)
def test_flags(
    run: Run,
    files: Path,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    flags: list[str],
    reason: str,
) -> None:
    monkeypatch.chdir(folder)
    assert_refused(run("recover", files / "streak.h5", "--out", "frames.h5", *flags), reason)
    assert list(folder.iterdir()) == []


def test_missing_time_axis_names_the_flag(run: Run, files: Path, folder: Path) -> None:
    words = [
        "recover",
        files / "streak.tif",
        "--camera",
        files / "camera.h5",
        "--out",
        folder / "frames.h5",
    ]
    assert_refused(run(*words), "--bin-width-ps")


def test_missing_camera(run: Run, files: Path, folder: Path) -> None:
    words = ["recover", files / "streak.tif", "--bin-width-ps", 20, "--out", folder / "frames.h5"]
    assert_refused(run(*words), "--camera")


def test_camera_with_a_slit_centre_off_the_sensor(
    run: Run, files: Path, tmp_path: Path, folder: Path
) -> None:
    camera = of_bytes(tmp_path / "camera.h5", (files / "camera.h5").read_bytes())
    with h5py.File(camera, "r+") as file:
        file["centres"][6] = SLIT_WIDTH_PX + 20.0
    words = ["recover", files / "streak.h5", "--camera", camera, "--out", folder / "frames.h5"]
    assert_refused(run(*words), "slit centre 320.0 px lies off the sensor")


def test_view_that_does_not_follow_the_others(
    run: Run, streak: Streak, camera: Camera, tmp_path: Path, folder: Path
) -> None:
    """A camera of another instrument, as wide by chance: its views look where there is no light."""
    moved = camera.centres_px.copy()
    moved[6] = 299.0
    replace(streak, camera=camera.replace(centres_px=moved, sweep=None)).save(tmp_path / "shot.h5")
    assert_refused(
        run("recover", tmp_path / "shot.h5", "--out", folder / "frames.h5"),
        "check the slit centres",
    )


def test_an_input_is_never_overwritten(run: Run, files: Path) -> None:
    before = (files / "streak.h5").read_bytes()
    assert_refused(
        run("recover", files / "streak.h5", "--out", files / "streak.h5"), "is an input too"
    )
    assert (files / "streak.h5").read_bytes() == before


def test_a_result_that_exists_survives_a_failure(run: Run, files: Path, folder: Path) -> None:
    (folder / "frames.h5").write_text("last week's frames")
    words = [
        "recover",
        files / "streak.tif",
        "--camera",
        files / "camera.h5",
        "--out",
        folder / "frames.h5",
    ]
    assert_refused(run(*words), "--bin-width-ps")
    assert (folder / "frames.h5").read_text() == "last week's frames"


@pytest.mark.parametrize("dot", ["line_background", "streak"])
def test_focus_pictures_without_dots(run: Run, files: Path, folder: Path, dot: str) -> None:
    words = [
        "calibrate",
        "--line",
        files / "line.tif",
        "--line-background",
        files / "line_background.tif",
    ]
    words += ["--dot", files / f"{dot}.tif", "--dot-background", files / "dot_background.tif"]
    outcome = run(*words, "--out", folder / "camera.h5")
    assert_refused(outcome, "dots on the slit" if dot == "line_background" else "must have shape")
    assert list(folder.iterdir()) == []


def test_clouds(run: Run, files: Path, tmp_path: Path, folder: Path) -> None:
    assert_refused(
        run("cloud", files / "streak.h5", "--out", folder / "c.ply"), "holds a streak record"
    )
    assert_refused(run("cloud", files / "streak.h5", "--out", folder / "c.stl"), "must end in .ply")
    assert_refused(run("cloud", tmp_path / "absent.h5", "--out", folder / "c.ply"), "no such file")
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("verb", ["info", "cloud"])
def test_a_small_file_that_claims_a_tebibyte(
    run: Run, files: Path, tmp_path: Path, folder: Path, verb: str
) -> None:
    bad = of_bytes(tmp_path / "bad.h5", (files / "camera.h5").read_bytes())
    with h5py.File(bad, "r+", libver="latest") as file:
        huge = file.create_dataset("huge", (1 << 38,), np.float32, chunks=(1 << 20,))
        huge.attrs["units"] = huge.attrs["axes"] = ""
    flags = () if verb == "info" else ("--out", folder / "scene.ply")
    assert_refused(run(verb, bad, *flags), "'huge' claims")


@pytest.mark.parametrize(("name", "value"), [("kind", np.zeros(3)), ("provenance", "[" * 60000)])
def test_a_damaged_file_of_ours_is_not_taken_for_something_else(
    run: Run, files: Path, tmp_path: Path, name: str, value: object
) -> None:
    bad = of_bytes(tmp_path / "bad.h5", (files / "streak.h5").read_bytes())
    with h5py.File(bad, "r+") as file:
        file.attrs[name] = value
    assert_refused(run("info", bad), "bad.h5: ")


def test_frames_without_any_return(run: Run, camera: Camera, tmp_path: Path, folder: Path) -> None:
    from tofclip import Frames

    dark = np.zeros((8, *camera.image_shape), np.float32)
    Frames(dark, np.arange(8) * 20e-12, camera).save(tmp_path / "dark.h5")
    assert_refused(
        run("cloud", tmp_path / "dark.h5", "--out", folder / "c.ply"), "no return stands out"
    )


def test_around_the_corner(run: Run, files: Path, tmp_path: Path, folder: Path) -> None:
    def reconstruct(source: Path, *flags: object) -> Outcome:
        return run("nlos", "reconstruct", source, "--out", folder / "volume.h5", *flags)

    assert_refused(
        reconstruct(files / "streak.h5"), "holds a streak record, expected capture or frames"
    )
    assert_refused(reconstruct(tmp_path / "absent.h5"), "no such file")
    assert_refused(reconstruct(files / "wall.h5", "--method", "guess"), "unknown method 'guess'")
    assert_refused(reconstruct(files / "wall.h5", "--png", folder / "mip.bmp"), "must end in .png")
    assert_refused(reconstruct(files / "wall.h5", "--wavelength-mm", "-1"), "wavelength")
    assert list(folder.iterdir()) == []


def test_conversions(run: Run, files: Path, folder: Path) -> None:
    assert_refused(
        run("convert", files / "streak.tif", "--out", folder / "streak.npz"), "must end in .h5"
    )
    assert_refused(
        run("convert", files / "camera.h5", "--out", folder / "streak.h5"), "holds a camera record"
    )
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    "words", [["frobnicate"], ["recover"], ["nlos", "frobnicate"], ["info", "/", "b"], ["--frob"]]
)
def test_usage(run: Run, words: list[str]) -> None:
    assert_refused(run(*words), "(see --help)")


def test_demo_needs_a_folder_that_it_can_make(run: Run, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    assert_refused(run("demo", "--out", tmp_path / "taken"), "cannot be made")
    assert_refused(run("demo", "--out", tmp_path, "--seed", "-1"), "(see --help)")


@pytest.mark.parametrize(
    ("width", "reason"),
    [
        ("1e300", "not credible"),
        ("20000", "333 times as long as the pulse (60 ps)"),
        ("0.001", "shorter than the pulse"),
    ],
)
def test_rows_that_do_not_go_with_the_pulse(
    run: Run, files: Path, folder: Path, width: str, reason: str
) -> None:
    words = ["recover", files / "streak.h5", "--out", folder / "frames.h5"]
    outcome = run(*words, "--bin-width-ps", width)
    assert_refused(outcome, reason)
    assert "--bin-width-ps" in outcome.err
    assert list(folder.iterdir()) == []


def test_a_time_zero_of_the_wrong_sign_is_named(run: Run, files: Path, folder: Path) -> None:
    words = ["recover", files / "streak.h5", "--out", folder / "frames.h5", "--method", "linear"]
    assert run(*words, "--time-zero-ns", "5").status == 0
    outcome = run("cloud", folder / "frames.h5", "--out", folder / "cloud.ply")
    assert_refused(outcome, "returns have negative ranges (-0.6")
    highest = re.search(r" to (\S+) m\)", outcome.err)
    assert highest is not None
    assert float(highest[1]) < 0
    assert "check the sign of --time-zero-ns" in outcome.err


def test_a_shot_of_one_row_is_a_picture_without_warnings(
    run: Run, files: Path, tmp_path: Path, folder: Path, recwarn: pytest.WarningsRecorder
) -> None:
    shot = picture(tmp_path, tifffile.imread(files / "streak.tif")[:1])
    words = ["recover", shot, "--camera", files / "camera.h5", "--bin-width-ps", 20]
    outcome = run(*words, "--iterations", 2, "--out", folder / "frames.h5")
    assert (outcome.status, outcome.err, len(recwarn)) == (0, "", 0)


def test_a_camera_without_a_finite_focal_length(run: Run, files: Path, folder: Path) -> None:
    words = ["calibrate", "--out", folder / "camera.h5", "--focal-length-px", "inf"]
    for name in ("line", "line-background", "dot", "dot-background"):
        words += [f"--{name}", files / f"{name.replace('-', '_')}.tif"]
    assert_refused(run(*words), "the focal length must be a positive number, got inf")
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("source", ["sim+bogus://", "absent", "camera.h5"])
def test_what_cannot_be_streamed_leaves_no_folder(
    run: Run, files: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    monkeypatch.chdir(files)
    outcome = run("stream", source, "--out", folder / "clouds")
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    assert list(folder.iterdir()) == []


def test_photons_in_bins_of_years(run: Run, tmp_path: Path, folder: Path) -> None:
    np.save(tmp_path / "cube.npy", np.random.default_rng(1).poisson(0.5, (6, 6, 32)))
    words = ["lidar", "photons", tmp_path / "cube.npy", "--bin-width-ps", "1e30"]
    assert_refused(run(*words, "--out", folder / "r.npz"), "check the unit of --bin-width-ps")
    assert list(folder.iterdir()) == []
