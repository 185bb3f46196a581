"""The README and the guides: their commands do what they say, walked as they stand on the files of a
small instrument, and their drawings agree with what is computed.
"""

import os
import re
import shlex
import shutil
from pathlib import Path

import camera_geometry
import matplotlib.image
import nlos_geometry
import numpy as np
import pytest
from guides import (
    find_hardware_commands,
    find_pictures,
    find_written,
    make_pictures,
    read_steps,
    run_guide,
)
from PIL import Image

import tofclip
from apps.cli import walk_verbs
from apps.figures.style import store_picture
from devices import aravis
from nlos import backprojection
from nlos.phasor import arrays, to_depths
from tofclip.simulate import make_default_camera
from tofclip.solvers import methods

ROOT = Path(tofclip.__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
GUIDES = [DOCS / f"{name}.md" for name in ("tutorial", "own_camera", "own_wall", "own_light_field")]
RECORDED = {
    "LinePattern.tif": "line.tif",
    "LinePattern_bkg.tif": "line_background.tif",
    "DotPattern.tif": "dot.tif",
    "DotPattern_bkg.tif": "dot_background.tif",
    "scene5.tif": "streak.h5",  # files are known by content
}
OWN = {name: name for name in RECORDED.values() if name.endswith("tif")}


@pytest.mark.parametrize(
    ("page", "provided", "made"),
    [
        ("tutorial", RECORDED, "camera.h5 frames.h5 look.h5 scene.ply"),
        pytest.param(
            "own_camera",
            OWN | {"my_picture.tif": "streak.tif"},
            "shot.h5 frames.h5 scene.ply fitted.h5 photons.ply",
            marks=pytest.mark.nightly,
        ),
        pytest.param("own_wall", {}, "capture.h5 volume.h5", marks=pytest.mark.nightly),
        pytest.param("own_light_field", {}, "field.h5 corrupted.png", marks=pytest.mark.nightly),
        ("gpu", {"shot.h5": "streak.h5"}, "frames.h5 scene.ply"),
    ],
)
def test_the_guide(files, tmp_path, monkeypatch, page, provided, made):
    for name, source in provided.items():
        shutil.copy(files / source, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    for step, status in run_guide(DOCS / f"{page}.md"):
        assert status == 0, step
    pictures = set() if page in ("own_camera", "gpu") else set(find_pictures(DOCS / f"{page}.md"))
    assert {*made.split(), *pictures} <= {*os.listdir()}


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_what_a_guide_shows_and_cannot_run(guide, tmp_path, monkeypatch):
    """Pictures are there and small; what needs hardware is a command of this program."""
    named = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", guide.read_text(encoding="utf-8"))
    assert named
    assert all((DOCS / name).stat().st_size < 300_000 for name in named)
    shell_lines = [text for language, text in read_steps(guide) if language == "sh"]
    assert all(text.startswith("tofclip ") for text in shell_lines)
    monkeypatch.chdir(tmp_path)
    for command in find_hardware_commands(guide):
        read_command(command)


def read_command(command):
    """Whether a command is one of this program; what it names is made, as it has to be there."""
    known, words = walk_verbs(), shlex.split(command)[1:]
    for word in words:
        if not word.startswith("-") and "/" not in word:
            Path(word).touch()
        elif word.endswith("/"):
            Path(word).mkdir(exist_ok=True)
    name = " ".join(words[:2]) if " ".join(words[:2]) in known else words[0]
    with known[name].make_context(name, words[len(name.split()) :]) as context:
        assert context.params


class TestPictures:
    @pytest.fixture
    def inputs(self, tmp_path):
        (tmp_path / "inputs").mkdir()
        return tmp_path / "inputs"

    def test_pictures_of_a_guide_are_kept_beside_it_large_ones_in_few_colours(
        self, tmp_path, inputs
    ):
        guide = tmp_path / "small.md"
        (inputs / "numbers.txt").write_text("1 2 3 4")
        guide.write_text(
            "```python\nimport numpy as np\nfrom matplotlib.image import imsave\n"
            "imsave('square.png', np.loadtxt('numbers.txt').reshape(2, 2))\n"
            "imsave('noise.png', np.random.default_rng(0).random((320, 320, 3)))\n```\n\n"
            "![A square](pictures/small/square.png) ![Noise](pictures/small/noise.png)\n"
            "![Another's](pictures/other.png)\n"
        )
        make_pictures(guide, inputs)
        assert {*os.listdir(tmp_path / "pictures" / "small")} == {"square.png", "noise.png"}
        assert not (tmp_path / "pictures" / "other.png").exists()
        with Image.open(tmp_path / "pictures" / "small" / "noise.png") as image:
            assert (image.mode, image.size) == ("P", (320, 320))

    def test_a_gallerys_pictures_are_found_in_the_folders_of_its_commands(
        self, tmp_path, monkeypatch
    ):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "made").mkdir()
        (tmp_path / "made" / "film.gif").write_bytes(b"GIF89a" + bytes(200_000))
        store_picture(find_written("film.gif"), tmp_path / "stored.gif")
        assert (tmp_path / "stored.gif").stat().st_size == 200_006  # films keep their colours
        with pytest.raises(FileNotFoundError, match=r"absent\.png"):
            find_written("absent.png")

    @pytest.mark.nightly
    def test_the_gallery(self, tmp_path, monkeypatch):
        """Every picture of its own is made by its commands, and shows something."""
        pytest.importorskip("playwright", reason="photographs of the page: pip install playwright")
        monkeypatch.chdir(tmp_path)
        for step, status in run_guide(DOCS / "gallery.md"):
            assert status == 0, step
        own = find_pictures(DOCS / "gallery.md")
        assert len(own) == 6
        for name, place in own.items():
            with Image.open(find_written(name)) as made, Image.open(place) as shown:
                shapes = [one.width / one.height for one in (made, shown)]  # shown smaller
                assert shapes[0] == pytest.approx(shapes[1], rel=0.01)
                assert np.asarray(made.convert("L")).std() > 10

    def test_the_readmes_picture_is_there_and_small(self):
        content = (DOCS / "pictures" / "gallery" / "preview.png").read_bytes()
        assert content.startswith(b"\x89PNG\r\n\x1a\n")
        assert len(content) < 300_000


class TestDrawings:
    def test_the_drawn_dots_are_where_the_camera_sees_the_point(self, tmp_path):
        camera, point = make_default_camera(), camera_geometry.OFF_AXIS_POINT_PX
        row, column = camera.optical_axis_px
        scene = np.zeros(camera.image_shape, np.float32)
        scene[row + int(point[1]), column + int(point[0])] = 1
        seen = camera.operator()(scene).reshape(-1)
        for place in camera_geometry.project_to_slit(point):
            around = np.arange(round(place) - 3, round(place) + 4)
            # The light of a pixel falls on the two nearest columns, whose mean is the place itself.
            assert abs(np.average(around, weights=seen[around]) - place) < 0.1
        camera_geometry.draw_geometry(tmp_path / "geometry.png")
        assert matplotlib.image.imread(tmp_path / "geometry.png").shape[1] > 1000

    def test_the_drawn_signal_arrives_after_the_drawn_path(self, tmp_path):
        path, signal = nlos_geometry._make_geometry_figure().axes[1].lines[0].get_data()
        hidden = np.array(nlos_geometry.HIDDEN_POINT_M)
        ends = nlos_geometry.LASER_SPOT_M, nlos_geometry.WALL_POINT_M
        expected = sum(np.linalg.norm(hidden - end) for end in ends)
        # A bin is 1 cm of path.
        assert abs(path[np.argmax(signal)] - expected) < 0.01
        nlos_geometry.draw_geometry(tmp_path / "geometry.png")
        assert matplotlib.image.imread(tmp_path / "geometry.png").shape[1] > 1000


# Memory that a page does not measure but promises never to exceed: what the code has for it.
LIMITS = {
    "docs/gpu.md": {"2 GiB": methods.WORKING_BYTES},
    "docs/nlos.md": {
        "32 MiB": backprojection.TABLE_BYTES,
        "8 MiB": arrays.CPU_CHUNK_BYTES,
        "256 MiB": arrays.GPU_CHUNK_BYTES,
        "1 GiB": to_depths.MAX_CACHE_BYTES,
    },
    "docs/instruments/aravis.md": {"64 MiB": aravis.HELD_BYTES},
}
BYTES = {"MiB": 1 << 20, "GiB": 1 << 30}


def test_memory_limits_are_those_of_the_code():
    for name, limits in LIMITS.items():
        prose = re.sub(r"```.*?```", "", (ROOT / name).read_text("utf-8"), flags=re.DOTALL)
        found = re.findall(r"(?<![\d.])(\d[\d.,]*)\s+([KMG]i?B)\b(?!/s)", prose)
        # a limit that is not stated any more leaves the table
        assert set(limits) <= {f"{number} {unit}" for number, unit in found}
        for claim, limit in limits.items():
            number, unit = claim.split()
            assert int(number) * BYTES[unit] == limit, (name, claim)


class TestReadme:
    def commands(self, start):
        """Lines of the README's shell blocks that begin with `start`."""
        blocks = re.findall(r"```sh\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
        return [line for block in blocks for line in block.splitlines() if line.startswith(start)]

    def test_its_commands_are_those_of_the_program(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        for command in self.commands("tofclip "):
            read_command(command)

    @pytest.mark.nightly
    def test_the_walk_through(self, shell, files, tmp_path):
        # A shot whose file has a time axis, under the README's names: files are known by content,
        # not by suffix.
        for name, source in {**OWN, "shot.tif": "streak.h5", "wall.npz": "wall.h5"}.items():
            shutil.copy(files / source, tmp_path / name)
        # A bright card on a dark ground, without parallax, in 8 x 8 views.
        card = np.zeros((48, 48), np.uint16)
        card[14:34, 16:30] = 60000
        views, steps = np.tile(card, (8, 8, 1, 1)), np.arange(-4, 4)
        np.savez("light_field.npz", lf=views, scale=1 / 65535, v=steps, u=steps)
        # A wall at bin 60, 5 signal photons a pixel.
        noise = np.random.default_rng(0)
        cube = noise.poisson(0.05, (24, 32, 150))
        cube[..., 57:64] += noise.poisson(0.7, (24, 32, 7))
        np.save("cube.npy", cube.astype(np.uint8))
        walk = self.commands("tofclip ")
        assert len(walk) == 20
        for command in walk:
            words = shlex.split(command)[1:]
            # This demonstration is run for its figures: here its words are read.
            if words[:2] == ["nlos", "demo"]:
                with walk_verbs()["nlos demo"].make_context("demo", words[2:]):
                    continue
            # Smaller pictures than a reader's: it is the words that count.
            small = {"sim+remoteex://?seed=1": "sim+remoteex://?seed=1&scene=small"}
            words = [small.get(word, word) for word in words]
            words += ["--side-px", "24"] if words[:2] == ["occlusion", "demo"] else []
            outcome = shell(shlex.join(words))
            assert outcome.status == 0, command
            # The small wall hides nothing, and the program says so.
            for line in outcome.err.splitlines():
                assert "nlos recon" in command, line
                assert "brightest voxel lies on the wall" in line or "noise or a glow" in line
        expected = (
            "camera.h5 camera.png frames.h5 frames.png mip.png scene.ply volume.h5 wall.h5"
            " wall_frames.h5 scene.png clouds occlusion-output measurements.h5"
            " picture.png run.h5 photons.h5 photons.ply range.npz"
        )
        assert set(expected.split()) <= {*os.listdir()}

    def test_the_python_example(self, files, tmp_path, monkeypatch):
        shutil.copy(files / "camera.h5", tmp_path)
        shutil.copy(files / "streak.h5", tmp_path / "shot.tif")
        monkeypatch.chdir(tmp_path)
        wall = tofclip.recover(tofclip.read_streak(files / "wall.h5"), method="linear")
        wall.save("wall_frames.h5")
        code = re.search(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)[1]
        (recover,) = self.commands("tofclip recover shot.tif")
        zero = shlex.split(recover)[-1]
        assert f"time_zero={zero}e-9" in code  # the same ranges as by the commands
        names = {}
        exec(code, names)
        assert names["frames"].camera.time_zero == pytest.approx(float(zero) * 1e-9)
        assert Path("scene.ply").stat().st_size > 0
        assert names["volume"].values.ndim == 3
        plate = names["plate"].range
        # the pulse's middle is at frame 100: 15 ns of flight
        assert np.median(plate) == pytest.approx(299792458 * 15e-9 / 2, abs=1e-3)
        assert np.count_nonzero(np.abs(plate - np.median(plate)) < 0.01) == pytest.approx(
            1200, abs=60
        )

    def test_continuous_integration_runs_its_test_command(self):
        (line,) = [line for line in self.commands("python3 -m venv") if "pytest" in line]
        promised = line.split(" && ")
        script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
        assert promised[0] in script
        assert script.rstrip().endswith(promised[-1])  # last, so that its summary is the last line
