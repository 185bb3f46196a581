"""A streak image is checked once, at construction."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tofclip.errors import InputError, MissingTimeAxisError, ShapeError
from tofclip.shots import Streak

COUNTS = np.arange(12.0).reshape(3, 4)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=15)
shapes = hnp.array_shapes(min_dims=2, max_dims=2, max_side=6)


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(shape=shapes, metadata=st.dictionaries(texts, texts, max_size=4), data=st.data())
def test_a_streak_survives_its_file(
    shape: tuple[int, int], metadata: dict[str, str], data: st.DataObject, tmp_path: Path
) -> None:
    counts = data.draw(
        hnp.arrays(np.float32, shape, elements=st.floats(-1000, 70000, width=32)).filter(np.any)
    )
    steps = data.draw(st.none() | hnp.arrays(np.float64, shape[0], elements=st.floats(1e-12, 1e-9)))
    saturated = data.draw(st.none() | hnp.arrays(bool, shape))
    expected = Streak(counts, None if steps is None else np.cumsum(steps), saturated, metadata)
    expected.save(tmp_path / "a.h5")
    got = Streak.load(tmp_path / "a.h5")
    np.testing.assert_array_equal(got.counts, expected.counts)
    for name in ("row_times", "saturated"):
        assert (getattr(got, name) is None) == (getattr(expected, name) is None)
        if getattr(expected, name) is not None:
            np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    assert got.metadata == metadata
    assert got.source == str(tmp_path / "a.h5")


@pytest.mark.parametrize(
    ("changes", "fault", "problem"),
    [
        ({"counts": np.ones(5)}, ShapeError, r"\(rows, columns\), got \(5,\)"),
        ({"counts": np.ones((0, 5))}, ShapeError, r"got \(0, 5\)"),
        ({"counts": np.zeros((3, 4))}, InputError, "every pixel is zero"),
        ({"counts": np.full((3, 4), np.nan)}, InputError, "12 pixels are NaN or infinite"),
        ({"counts": np.full((3, 4), 1e300)}, InputError, "12 pixels are NaN or infinite"),
        ({"saturated": np.zeros((4, 3), bool)}, ShapeError, r"saturated must have shape \(3, 4\)"),
        (
            {"row_times": np.arange(4.0)},
            ShapeError,
            r"time axis must have shape \(3,\), got \(4,\)",
        ),
        ({"row_times": np.array([0.0, 2.0, 2.0])}, InputError, "must be finite and increase"),
        ({"row_times": np.array([0.0, np.nan, 2.0])}, InputError, "must be finite and increase"),
    ],
)
def test_unusable_streaks_are_refused(
    changes: dict[str, Any], fault: type[InputError], problem: str
) -> None:
    with pytest.raises(fault, match=problem):
        Streak(**({"counts": COUNTS} | changes))


def test_negative_readings_are_kept() -> None:
    """A background taken off leaves noise on both sides of zero; clipping it would bias the
    picture.
    """
    np.testing.assert_array_equal(Streak(COUNTS - 5).counts, COUNTS - 5)


def test_the_time_axis_is_asked_for_by_name() -> None:
    streak = Streak(COUNTS, source="shot.tif")
    with pytest.raises(
        MissingTimeAxisError, match=r"shot\.tif has no time axis: give .*`bin_width`"
    ):
        _ = streak.times
    np.testing.assert_allclose(streak.with_bin_width(2e-12).times, [0, 2e-12, 4e-12], rtol=1e-15)
