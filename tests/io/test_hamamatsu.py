"""HPD-TA's text, its time axis and its pictures: real ones, made-up ones, and damaged ones."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from itex_files import encode_itex

from tofclip.errors import FileFormatError, MissingTimeAxisError
from tofclip.io import read_streak
from tofclip.io.hamamatsu import decode_itex, parse_text

# Times in ns of a sweep that slows down, as real ones do; exact in float32.
SWEEP_NS = np.arange(24) * 0.5 + np.arange(24) ** 2 / 64

section_names = st.from_regex(r"[A-Z][A-Za-z0-9 ]{0,10}[a-z]", fullmatch=True)
keys = st.from_regex(r"[A-Z][A-Za-z0-9_. ]{0,10}[a-z]", fullmatch=True)
characters = st.characters(exclude_characters='"', exclude_categories=["Cs"])
quoted = st.text(characters).map(lambda v: (f'"{v}"', v))
bare = st.from_regex(r"([a-zA-Z0-9.:/-]( ?[a-zA-Z0-9.:/-]){0,8})?", fullmatch=True)
values = st.one_of(quoted, bare.map(lambda v: (v, v)))
texts = st.dictionaries(section_names, st.dictionaries(keys, values, max_size=5), max_size=5)


@given(texts, st.sampled_from(["", "\r\n", "\n"]))
def test_every_value_is_found_under_its_section(sections, separator):
    """Quoted values may hold commas, brackets and line breaks; a section may start without one."""
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


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"table": SWEEP_NS[:20]}, SWEEP_NS[:20] * 1e-9),
        # A part of the sensor begins later in the sweep.
        ({"table": SWEEP_NS, "top": 3}, SWEEP_NS[3:23] * 1e-9),
        ({"table": SWEEP_NS[:20], "unit": "ps"}, SWEEP_NS[:20] * 1e-12),
        ({"table": SWEEP_NS[:20], "unit": "us"}, SWEEP_NS[:20] * 1e-6),
        ({"table": SWEEP_NS[:20], "unit": "ms"}, SWEEP_NS[:20] * 1e-3),
        ({"place": "Other", "kind": 1, "scale": 0.25}, np.arange(20) * 0.25e-9),
    ],
)
def test_the_time_axis_is_the_files_own(write_hpdta, arguments, expected):
    path = write_hpdta(**arguments)
    np.testing.assert_allclose(read_streak(path).times, expected, rtol=1e-15)
    given_instead = read_streak(path, bin_width=20e-12).times
    np.testing.assert_allclose(given_instead, np.arange(20) * 20e-12, rtol=1e-15)


@pytest.mark.parametrize(
    ("place", "unit"), [("Focus mode", ""), ("Focus mode", "ns"), ("Other", ""), ("Other", "nm")]
)
def test_no_time_axis_is_an_error_only_when_times_are_asked_for(write_hpdta, place, unit):
    streak = read_streak(write_hpdta(place=place, unit=unit, kind=1))
    assert streak.row_times is None
    with pytest.raises(MissingTimeAxisError, match=r"shot\.tif has no time axis.*`bin_width`"):
        _ = streak.times


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"table": SWEEP_NS[:20][::-1]}, "does not increase"),
        ({"table": np.full(20, np.nan)}, "does not increase"),
        ({"table": SWEEP_NS[:19]}, "has 19 entries, rows 0..19 need more"),
        ({"table": SWEEP_NS, "top": 5}, "has 24 entries, rows 5..24 need more"),
        ({"place": "#999999,0020"}, "is truncated: its time axis of 20 entries at byte 999999"),
        ({"place": "Other", "kind": 1, "scale": -1}, "must be a positive number, found '-1'"),
        ({"place": "Other", "kind": 1, "scale": "x"}, "must be a positive number, found 'x'"),
    ],
)
def test_an_impossible_time_axis_is_refused(write_hpdta, arguments, problem):
    with pytest.raises(FileFormatError, match=f"shot.tif.*{problem}"):
        read_streak(write_hpdta(**arguments))


@pytest.mark.parametrize(
    ("bits", "exposures", "limit"), [(16, 1, 65535), (12, 1, 4095), (12, 8, 65535), (0, 1, 65535)]
)
def test_pixels_at_the_cameras_own_limit_are_saturated(write_hpdta, pixels, bits, exposures, limit):
    """A 12-bit converter saturates before its 16-bit pixels do; summed exposures pass its limit."""
    pixels[3, 4], pixels[5, 6], pixels[7, 8] = limit, limit - 1, limit
    streak = read_streak(write_hpdta(place="Other", bits=bits, exposures=exposures))
    assert np.argwhere(streak.saturated).tolist() == [[3, 4], [7, 8]]


ITEX_TEXT = (
    '[Application],Software="HPD-TA"\r\n[Acquisition],NrExposure=1\r\n'
    '[Scaling],ScalingXUnit="nm",ScalingXScalingFile="",ScalingYUnit="ps",ScalingYScalingFile=""{}[Comment],UserComment=""'
)
SHAPE = (512, 672)
# Shape, type, some of the text, and of the time axis its ends, its steps and half of their last digit,
# s, as the data's notes state.
FACTS = {
    "operate_mode": (
        SHAPE,
        "uint32",
        ((0.0, 16.009e-6), (31.08e-9, 31.44e-9), 5e-12),
        {"Camera/CameraName": "Orca R2", "Acquisition/NrExposure": "60"},
    ),
    "focus_mode": (SHAPE, "uint32", None, {"Scaling/ScalingYScalingFile": "Focus mode"}),
    "photon_counting": (
        SHAPE,
        "uint16",
        ((0.0, 4.632e-9), (8.86e-12, 9.66e-12), 5e-15),
        {"Acquisition/NrExposure": "10000", "Acquisition/ExposureTime": "200 ms"},
    ),
    "xaxis_other": ((508, 672), "uint16", None, {"Scaling/ScalingXScalingFile": "Other"}),
}


@pytest.mark.parametrize("name", FACTS)
def test_recorded_pictures(shared_data, name):
    shape, dtype, axis, entries = FACTS[name]
    path = shared_data / "devices" / "streak" / f"{name}.img"
    streak, (pixels, _) = read_streak(path), decode_itex(path.read_bytes())
    assert (pixels.shape, pixels.dtype, streak.counts.shape) == (shape, np.dtype(dtype), shape)
    np.testing.assert_array_equal(streak.counts, pixels.astype(np.float32))
    if axis is None:
        with pytest.raises(MissingTimeAxisError):
            _ = streak.times
    else:
        ends, (least, most), half_digit = axis
        np.testing.assert_allclose(streak.times[[0, -1]], ends, rtol=0, atol=100 * half_digit)
        steps = np.diff(streak.times)
        found = [steps.min(), steps.max()]
        np.testing.assert_allclose(found, [least, most], rtol=0, atol=half_digit)
    assert entries.items() <= streak.metadata.items()
    assert streak.metadata["Comment/UserComment"] == ""  # its section starts without a line break


@given(st.data())
def test_pictures_of_every_type_are_read_whatever_tables_they_have(data):
    dtype = data.draw(st.sampled_from(["u1", "<u2", "<u4"]))
    pixels = data.draw(arrays(dtype, array_shapes(min_dims=2, max_dims=2, max_side=9)))
    axes = data.draw(st.sets(st.sampled_from("XY")))
    tables = {axis: np.ones(pixels.shape[axis == "X"], np.float32) for axis in axes}
    kept = st.characters(exclude_categories=["Cs"], exclude_characters='[]"=')
    words = data.draw(st.text(kept, max_size=20))
    got, metadata = decode_itex(encode_itex(pixels, ITEX_TEXT.format(words), tables, (0, 65535)))
    np.testing.assert_array_equal(got, pixels)
    assert got.dtype == pixels.dtype
    assert metadata["Scaling/ScalingYUnit"] == "ps"


@pytest.fixture
def image():
    """Six rows of four pixels with a slowing sweep, exact in float32."""
    pixels, times = np.arange(24, dtype="<u2").reshape(6, 4), np.array([0, 1, 2.25, 3.5, 5, 6.5])
    tables = {"X": np.arange(4, 0, -1.0), "Y": times.astype(np.float32)}
    return encode_itex(pixels, ITEX_TEXT.format(""), tables, (3, 2))


def test_an_itex_file_is_read_as_a_streak(tmp_path, image):
    (tmp_path / "shot.img").write_bytes(image)
    streak = read_streak(tmp_path / "shot.img")
    np.testing.assert_array_equal(streak.counts, np.arange(24).reshape(6, 4))
    expected = np.array([0, 1, 2.25, 3.5, 5, 6.5]) * 1e-12
    np.testing.assert_allclose(streak.times, expected, rtol=1e-15)


def test_text_of_old_versions_is_western_windows():
    text = '[Application],Software="HiPic",Unit="µs"'.encode("latin-1")
    data = encode_itex(np.ones((2, 3), "u1"), "x" * len(text))
    _, metadata = decode_itex(data.replace(b"x" * len(text), text))
    assert metadata["Application/Unit"] == "µs"


@pytest.mark.parametrize("keep", [0, 1, 10, 63, 64, 150, 290, -25, -1])
def test_truncated_pictures_are_refused(image, keep):
    with pytest.raises(FileFormatError):
        decode_itex(image[:keep])


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [(12, 1, "type 1"), (12, 77, "type 77"), (4, 65535, "truncated"), (6, 0, "truncated")],
)
def test_headers_that_cannot_be_are_refused(image, place, value, problem):
    data = bytearray(image)
    data[place : place + 2] = value.to_bytes(2, "little")
    with pytest.raises(FileFormatError, match=problem):
        decode_itex(bytes(data))


def test_a_file_larger_than_any_picture_is_not_read(tmp_path):
    with open(tmp_path / "huge.img", "wb") as file:
        file.write(b"IM")
        file.truncate(1 << 31)  # a hole: takes no room on the disk
    with pytest.raises(FileFormatError, match="larger than any streak image"):
        read_streak(tmp_path / "huge.img")
