"""HPD-TA's text and its time axis."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofclip.errors import FileFormatError, MissingTimeAxisError
from tofclip.io import read_streak
from tofclip.io.hamamatsu import is_hpdta, parse_full_scale, parse_text, read_row_times

# Times in ns of a sweep that slows down, as real ones do; exact in float32.
SWEEP_NS = np.arange(24) * 0.5 + np.arange(24) ** 2 / 64

section_names = st.from_regex(r"[A-Z][A-Za-z0-9 ]{0,10}[a-z]", fullmatch=True)
keys = st.from_regex(r"[A-Z][A-Za-z0-9_. ]{0,10}[a-z]", fullmatch=True)
quoted = st.text(st.characters(exclude_characters='"', exclude_categories=["Cs"])).map(
    lambda v: (f'"{v}"', v)
)
bare = st.from_regex(r"([a-zA-Z0-9.:/-]( ?[a-zA-Z0-9.:/-]){0,8})?", fullmatch=True).map(
    lambda v: (v, v)
)
section_bodies = st.dictionaries(keys, st.one_of(quoted, bare), max_size=5)


@given(
    st.dictionaries(section_names, section_bodies, max_size=5), st.sampled_from(["", "\r\n", "\n"])
)
def test_every_value_is_found_under_its_section(
    sections: dict[str, dict[str, tuple[str, str]]], separator: str
) -> None:
    """Quoted values may hold commas, brackets and line breaks; a section may start without a line
    break.
    """
    text = separator.join(
        f"[{name}]" + "".join(f",{key}={written}" for key, (written, _) in body.items())
        for name, body in sections.items()
    )
    expected = {
        f"{name}/{key}": value
        for name, body in sections.items()
        for key, (_, value) in body.items()
    }
    assert parse_text(text) == expected


@given(st.text())
def test_any_text_is_parsed_without_fault(text: str) -> None:
    parse_text(text)


def test_a_section_without_a_line_break() -> None:
    found = parse_text(
        '[Grabber],Type=5,SubType=0[DisplayLUT],EntrySize=7\r\n[Streak camera],Trig. level="0.3"'
    )
    assert found == {
        "Grabber/Type": "5",
        "Grabber/SubType": "0",
        "DisplayLUT/EntrySize": "7",
        "Streak camera/Trig. level": "0.3",
    }


def test_only_its_own_text_is_taken_for_hpdta() -> None:
    assert is_hpdta('[Application],Software="HPD-TA"')
    assert not is_hpdta('{"shape": [20, 30]}')
    assert not is_hpdta("")


def test_the_time_axis_lies_behind_the_pixels(write_hpdta: Any) -> None:
    streak = read_streak(write_hpdta(SWEEP_NS[:20]))
    np.testing.assert_allclose(streak.times, SWEEP_NS[:20] * 1e-9, rtol=1e-15)


def test_a_part_of_the_sensor_begins_later_in_the_sweep(write_hpdta: Any) -> None:
    streak = read_streak(write_hpdta(SWEEP_NS, top=3))
    np.testing.assert_allclose(streak.times, SWEEP_NS[3:23] * 1e-9, rtol=1e-15)


@pytest.mark.parametrize(("unit", "seconds"), [("ps", 1e-12), ("us", 1e-6), ("ms", 1e-3)])
def test_the_unit_is_the_files_own(write_hpdta: Any, unit: str, seconds: float) -> None:
    streak = read_streak(write_hpdta(SWEEP_NS[:20], unit=unit))
    np.testing.assert_allclose(streak.times, SWEEP_NS[:20] * seconds, rtol=1e-15)


def test_a_linear_axis(write_hpdta: Any) -> None:
    streak = read_streak(write_hpdta(place="Other", kind=1, scale=0.25))
    np.testing.assert_allclose(streak.times, np.arange(20) * 0.25e-9, rtol=1e-15)


@pytest.mark.parametrize(
    ("place", "unit"), [("Focus mode", ""), ("Focus mode", "ns"), ("Other", ""), ("Other", "nm")]
)
def test_no_time_axis_is_an_error_only_when_times_are_asked_for(
    write_hpdta: Any, place: str, unit: str
) -> None:
    streak = read_streak(write_hpdta(place=place, unit=unit, kind=1))
    assert streak.row_times is None
    with pytest.raises(MissingTimeAxisError, match=r"shot\.tif has no time axis.*`bin_width`"):
        _ = streak.times


def test_a_given_bin_width_overrides_the_files_axis(write_hpdta: Any) -> None:
    streak = read_streak(write_hpdta(SWEEP_NS), bin_width=20e-12)
    np.testing.assert_allclose(streak.times, np.arange(20) * 20e-12, rtol=1e-15)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"table": SWEEP_NS[:20][::-1]}, "does not increase"),
        ({"table": np.full(20, np.nan)}, "does not increase"),
        ({"table": SWEEP_NS[:19]}, "has 19 entries, rows 0..19 need more"),
        ({"table": SWEEP_NS, "top": 5}, "has 24 entries, rows 5..24 need more"),
        ({"place": "#999999,0020"}, "is truncated: its time axis of 20 entries at byte 999999"),
        (
            {"place": "Other", "kind": 1, "scale": -1},
            "ScalingYScale must be a positive number, found '-1'",
        ),
        (
            {"place": "Other", "kind": 1, "scale": "x"},
            "ScalingYScale must be a positive number, found 'x'",
        ),
    ],
)
def test_an_impossible_time_axis_is_refused(
    write_hpdta: Any, arguments: dict[str, Any], problem: str
) -> None:
    with pytest.raises(FileFormatError, match=f"shot.tif.*{problem}"):
        read_streak(write_hpdta(**arguments))


def test_a_file_cut_off_in_its_time_axis_is_refused(write_hpdta: Any) -> None:
    path = write_hpdta(SWEEP_NS[:20])
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(FileFormatError, match="is truncated: its time axis"):
        read_streak(path)


@pytest.mark.parametrize(
    ("bits", "exposures", "expected"),
    [("16", "1", 65535), ("12", "1", 4095), ("12", "8", np.inf), ("0", "1", np.inf)],
)
def test_the_cameras_own_limit(bits: str, exposures: str, expected: float) -> None:
    """A sum of exposures may exceed what the converter gives for one."""
    assert (
        parse_full_scale({"Camera/Prop_BitPerChannel": bits, "Acquisition/NrExposure": exposures})
        == expected
    )
    assert parse_full_scale({}) == np.inf


def test_recorded_text_of_another_camera(shared_data: Path) -> None:
    """A 20 us sweep of a C5680 whose axis is known to run from 0 to 16.009 us in steps of 31.08 to
    31.44 ns.
    """
    path = shared_data / "devices" / "streak" / "operate_mode.img"
    data = path.read_bytes()
    metadata = parse_text(data[64 : 64 + struct.unpack("<h", data[2:4])[0]].decode())
    assert metadata["Acquisition/NrExposure"] == "60"
    assert metadata["Camera/CameraName"] == "Orca R2"
    times = read_row_times(metadata, path, 512)
    assert times is not None
    steps = np.diff(times)
    # The known figures are rounded to their last digit.
    np.testing.assert_allclose([times[0], times[-1]], [0, 16.009e-6], atol=0.5e-9)
    np.testing.assert_allclose([steps.min(), steps.max()], [31.08e-9, 31.44e-9], atol=5e-12)
