"""Progress of methods that work in several steps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scene_shapes import shaped_capture

from nlos import Grid, Hybrid
from nlos.method import SubProgress
from nlos.phasor import wall_to_plane
from nlos.phasor.to_depths_compiled import CompiledDiffraction

GRID = Grid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 7), [0.7, 0.9, 1.0])
pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")


@given(pieces=st.lists(st.integers(0, 1000), min_size=1), portion=st.integers(0, 10**6))
def test_pieces_of_a_portion_make_up_the_portion(pieces: list[int], portion: int) -> None:
    pieces = [*pieces, 1]
    reported: list[int] = []
    report = SubProgress(reported.append, sum(pieces), portion)
    for piece in pieces:
        report(piece)
    assert sum(reported) == portion
    assert min(reported) >= 0


@pytest.mark.parametrize(
    ("propagation", "quicker", "share"),
    [("spectral", False, 0.4), ("spectral", True, 0.4), ("time", False, 0.95)],
)
def test_the_way_to_the_plane_has_its_share(
    propagation: str, quicker: bool, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether by direct sums, Fourier transforms or in time; all steps together count every voxel
    once.
    """
    done: list[int] = []
    before: list[tuple[int, int]] = []
    add = CompiledDiffraction.add

    def noticed(diffraction: CompiledDiffraction, values: np.ndarray, *rest: object) -> None:
        before.append((len(done), sum(done)))
        add(diffraction, values, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(CompiledDiffraction, "add", noticed)
    monkeypatch.setattr(wall_to_plane, "is_faster_than_direct", lambda *_: quicker)
    Hybrid(0.25, 4.24, propagation).reconstruct(shaped_capture("wavy", 17), GRID, done.append)
    ((reports, voxels),) = before
    assert reports > 1
    assert voxels == int(share * GRID.size)
    assert sum(done) == GRID.size


def test_an_interruption_comes_through_on_the_way_to_the_plane(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(CompiledDiffraction, "add", None)  # is not reached

    def stop(_: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Hybrid(0.25, 4.24).reconstruct(shaped_capture("wavy", 17), GRID, stop)
