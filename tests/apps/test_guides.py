"""The guides' commands do what they say: walked as they stand, on the files of a small instrument."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path

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
from verb_pages import collect_verbs

import tofclip
from apps.figures.style import store_picture

DOCS = Path(tofclip.__file__).parents[1] / "docs"
GUIDES = [DOCS / f"{name}.md" for name in ("tutorial", "own_camera", "own_wall", "own_light_field")]
RECORDED = {
    "LinePattern.tif": "line.tif",
    "LinePattern_bkg.tif": "line_background.tif",
    "DotPattern.tif": "dot.tif",
    "DotPattern_bkg.tif": "dot_background.tif",
    "scene5.tif": "streak.h5",  # files are known by content
}
OWN = {name: name for name in RECORDED.values() if name.endswith("tif")} | {
    "my_picture.tif": "streak.tif"
}


def walked(guide: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Run a guide in a folder and return the files that are there afterwards."""
    monkeypatch.chdir(folder)
    for step, status in run_guide(DOCS / guide):
        assert status == 0, step
    return {path.name for path in folder.iterdir()}


def provide(files: Path, names: Mapping[str, str], folder: Path) -> None:
    for name, source in names.items():
        shutil.copy(files / source, folder / name)


def test_the_tutorial(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    provide(files, RECORDED, tmp_path)
    there = walked("tutorial.md", tmp_path, monkeypatch)
    assert {"camera.h5", "frames.h5", "look.h5", "scene.ply"} | set(
        find_pictures(GUIDES[0])
    ) <= there


def test_the_guide_to_ones_own_camera(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    provide(files, OWN, tmp_path)
    there = walked("own_camera.md", tmp_path, monkeypatch)
    assert {"shot.h5", "frames.h5", "scene.ply", "fitted.h5", "photons.ply"} <= there


def test_the_guide_to_ones_own_wall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = walked("own_wall.md", tmp_path, monkeypatch)
    assert {"capture.h5", "volume.h5"} | set(find_pictures(GUIDES[2])) <= there


def test_the_guide_to_ones_own_light_field(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = walked("own_light_field.md", tmp_path, monkeypatch)
    assert {"field.h5", "corrupted.png"} | set(find_pictures(GUIDES[3])) <= there


def test_the_page_on_gpus(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    provide(files, {"shot.h5": "streak.h5"}, tmp_path)
    assert {"frames.h5", "scene.ply"} <= walked("gpu.md", tmp_path, monkeypatch)


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_pictures_are_there_and_small(guide: Path) -> None:
    named = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", guide.read_text(encoding="utf-8"))
    assert named
    for name in named:
        assert (DOCS / name).stat().st_size < 300_000


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_commands_that_need_hardware_are_understood(
    guide: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = collect_verbs()
    monkeypatch.chdir(tmp_path)
    for command in find_hardware_commands(guide):
        words = shlex.split(command)[1:]
        # Files that are named have to be there.
        for word in words:
            if not word.startswith("-") and "/" not in word:
                Path(word).touch()
            elif word.endswith("/"):
                Path(word).mkdir(exist_ok=True)
        name = " ".join(words[:2]) if " ".join(words[:2]) in known else words[0]
        with known[name].make_context(name, words[len(name.split()) :]) as context:
            assert context.params


def test_every_line_of_a_shell_block_is_a_command_of_this_program() -> None:
    for guide in GUIDES:
        assert all(
            text.startswith("tofclip ") for language, text in read_steps(guide) if language == "sh"
        )


def test_pictures_of_a_guide_are_kept_beside_it(tmp_path: Path) -> None:
    guide, inputs = tmp_path / "small.md", tmp_path / "inputs"
    inputs.mkdir()
    (inputs / "numbers.txt").write_text("1 2 3 4")
    guide.write_text(
        "```python\nimport numpy as np\nfrom matplotlib.image import imsave\n"
        "imsave('square.png', np.loadtxt('numbers.txt').reshape(2, 2))\n```\n\n"
        "![A square](pictures/small/square.png) ![Another's](pictures/other.png)\n"
    )
    make_pictures(guide, inputs)
    assert [path.name for path in (tmp_path / "pictures" / "small").iterdir()] == ["square.png"]
    assert not (tmp_path / "pictures" / "other.png").exists()


def test_large_pictures_are_kept_in_few_colours(tmp_path: Path) -> None:
    guide = tmp_path / "large.md"
    guide.write_text(
        "```python\nimport numpy as np\nfrom matplotlib.image import imsave\n"
        "imsave('noise.png', np.random.default_rng(0).random((400, 400, 3)))\n```\n\n"
        "![Noise](pictures/large/noise.png)\n"
    )
    (tmp_path / "inputs").mkdir()
    make_pictures(guide, tmp_path / "inputs")
    with Image.open(tmp_path / "pictures" / "large" / "noise.png") as image:
        assert (image.mode, image.size) == ("P", (400, 400))


@pytest.mark.nightly
def test_the_gallery(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every picture of its own is made by its commands, and shows something."""
    pytest.importorskip("playwright", reason="photographs of the page: pip install playwright")
    walked("gallery.md", tmp_path, monkeypatch)
    own = find_pictures(DOCS / "gallery.md")
    assert len(own) == 6
    for name, place in own.items():
        with Image.open(find_written(name)) as made, Image.open(place) as shown:
            assert made.size == shown.size
            assert np.asarray(made.convert("L")).std() > 10


def test_a_gallerys_pictures_are_found_in_the_folders_of_its_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "film.gif").write_bytes(b"GIF89a" + bytes(200_000))
    store_picture(find_written("film.gif"), tmp_path / "stored.gif")
    assert (tmp_path / "stored.gif").stat().st_size == 200_006  # films keep their colours
    with pytest.raises(FileNotFoundError, match=r"absent\.png"):
        find_written("absent.png")


def test_a_step_that_fails_is_named(tmp_path: Path) -> None:
    guide = tmp_path / "faulty.md"
    guide.write_text("```sh\ntofclip info absent.h5\n```\n")
    (tmp_path / "inputs").mkdir()
    with pytest.raises(SystemExit, match=r"tofclip info absent\.h5: exit status 2"):
        make_pictures(guide, tmp_path / "inputs")
