"""What `tofclip nlos` refuses: exit status 2, one line on standard error, and nothing written."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_instrument import Outcome, Run


def refused(outcome: Outcome, complaint: str) -> None:
    assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1)
    assert complaint in outcome.err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--method", "guess"], "unknown method 'guess'; choose from rsd, hybrid"),
        (["--method", "rsd,hybrid"], "nlos compare takes several"),
        (["--method", "rsd"], "use the hybrid method"),
        (
            ["--method", "hybrid", "--sigma-mm", "3"],
            "sigma_mm is a setting of filtered-backprojection",
        ),
        (["--point-fraction", "2"], "point_fraction is a share"),
        (["--cycles", "0"], "cycles"),
        (["--cycles", "1e8"], "is longer than the record"),
        (["--voxel-mm", "-1"], "voxel"),
        (["--bins-together", "0"], "cannot be put together by 0"),
        (["--gate-m", "-1"], "margin"),
        (["--x-m", "1", "0"], "side x of the box"),
        (["--tolerance", "7"], "tolerance"),
        (["--voxel-mm", "abc"], "(see --help)"),
    ],
)
def test_imaging_that_makes_no_sense(
    run: Run, curved: Path, tmp_path: Path, words: list[str], complaint: str
) -> None:
    refused(run("nlos", "reconstruct", curved, "--out", tmp_path / "v.h5", *words), complaint)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--letters", "A", "--points", "0,0,1"], "letters and points cannot be hidden together"),
        (["--points", "0,0"], "points are given as X,Y,Z"),
        (["--points", "0,0,x"], "points are given as X,Y,Z"),
        (["--wall", "cave"], "no wall is called 'cave'"),
        (["--scan", "spiral"], "no scan is called 'spiral'"),
        (["--material", "velvet"], "no material is called 'velvet'"),
        (["--background", "1"], "give the peak counts as well"),
        (["--bin-width-ps", "0"], "bin width must be a positive number"),
        (["--jitter-ps", "0"], "jitter must be a positive number"),
        (["--facet-mm", "0"], "facets need a positive size"),
        (["--facet-mm", "1e-6"], "the letters need more than 200000 facets"),
        (["--height-m", "nan"], "letters need a positive height"),
        (["--height-m", "-1"], "letters need a positive height"),
        (["--mesh", "absent.ply"], "no such file"),
    ],
)
def test_scenes_that_make_no_sense(
    run: Run, tmp_path: Path, words: list[str], complaint: str
) -> None:
    refused(
        run("nlos", "simulate", "--wall-points", 3, "--out", tmp_path / "c.h5", *words), complaint
    )
    assert list(tmp_path.iterdir()) == []


def test_names_that_cannot_be_written(run: Run, curved: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text("voxel_mm = 100\n")
    source = shutil.copy(curved, tmp_path / "wall.h5")
    settings = ["--settings", tmp_path / "mine.toml"]
    reconstruct, compare = ["nlos", "reconstruct", source], ["nlos", "compare", source]
    refused(run(*reconstruct, "--out", source), "is an input too")
    refused(
        run(*reconstruct, *settings, "--out", tmp_path / "mine.h5"), "mine.toml: is an input too"
    )
    refused(run(*reconstruct, "--out", tmp_path / "v.stl"), "the name must end in .h5")
    refused(run(*compare, *settings, "--out", tmp_path / "mine.png"), "mine.toml: is an input too")
    refused(run(*compare, "--out", tmp_path / "c.bmp"), "must end in .png")
    refused(
        run(*compare, "--out", tmp_path / "c.png", "--methods", "fk"),
        "fk does not suit this capture",
    )
    refused(run(*compare, "--out", tmp_path / "c.png", "--methods", "hybrid,hybrid"), "named twice")
    refused(run("nlos", "info", tmp_path / "mine.toml"), "is not a capture of a known format")
    (tmp_path / "captures").mkdir()
    folder = ["nlos", "reconstruct", tmp_path / "captures"]
    refused(run(*folder, "--out", tmp_path / "results"), "no capture is in there")
    refused(
        run(*folder, "--out", tmp_path / "results", "--suffix", ".stl"),
        "no format of volumes is called '.stl'",
    )
    (tmp_path / "captures" / "a.h5").touch()
    refused(run(*folder, "--out", tmp_path / "captures"), "is an input too; choose another folder")
    refused(run(*folder, "--out", source), "it is a file; name a folder")
    (tmp_path / "captures" / "a.npz").touch()
    refused(
        run(*folder, "--out", tmp_path / "results"), "a.h5 and a.npz would have results of one name"
    )
