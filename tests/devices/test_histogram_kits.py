"""Histogram kits: their lines of text, and the driver against kits made of software behind a
pseudo-terminal.
"""

import sys

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from instruments import finish, take
from numpy.testing import assert_array_equal

import devices
from devices.emulation.histogram_kits import (
    compute_zone_ranges,
    format_tmf8828,
    format_vl53l8,
)
from devices.histogram_kits import (
    Tmf8828Options,
    Tmf8828Parser,
    Vl53l8Options,
    Vl53l8Parser,
    find_tmf_zones,
)
from devices.transients import read_photons
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceNotFoundError,
    MissingDependencyError,
)
from tofclip.units import SPEED_OF_LIGHT

pytest.importorskip("serial", reason="histogram kits need pyserial")


def make_tmf_parser(zones=64):
    return Tmf8828Parser(Tmf8828Options(bin_ps=250, zones=zones))


def parse(parser, lines):
    found = [parser.parse_line(line.rstrip()) for line in lines]
    return [frame for frame in found if frame is not None]


def draw_counts(zones, seed, bins=128):
    return np.random.default_rng(seed).integers(0, 1 << 24, (bins, zones)).astype(np.uint32)


@pytest.mark.parametrize("zones", [64, 9])
def test_three_bytes_of_every_bin_come_together(zones):
    parser = make_tmf_parser(zones)
    for number, seed in enumerate((1, 2, 3)):
        counts = draw_counts(zones, seed)
        (frame,) = parse(parser, format_tmf8828(counts, number, 5000))
        assert_array_equal(frame.counts, counts)
        assert (frame.missing, frame.stamp) == (0, pytest.approx(1e-3))


def test_zones_lie_where_the_makers_programs_put_them():
    """The eight channels of the first half of the first capture, in pixels of 8 x 8."""
    assert find_tmf_zones(64)[:8].tolist() == [56, 60, 40, 44, 24, 28, 8, 12]
    assert sorted(find_tmf_zones(64)) == list(range(64))


def test_halves_that_are_both_numbered_from_0():
    counts = draw_counts(64, 4)
    lines = []
    for line in format_tmf8828(counts, 0, 0):
        words = line.split(b",")
        if words[0] == b"#Raw":
            words[2] = b"%d" % (int(words[2]) % 30)
        lines.append(b",".join(words))
    (frame,) = parse(make_tmf_parser(), lines)
    assert_array_equal(frame.counts, counts)
    assert frame.stamp is None


def test_what_is_missing_is_told():
    """A line torn, frames not sent, and the beginning missed."""
    parser = make_tmf_parser()
    frames = [format_tmf8828(draw_counts(64, seed), seed, 1) for seed in range(70)]
    assert parse(parser, frames[0][100:])[0].counts is None
    torn = frames[1].copy()
    torn[7] = torn[7][:30]
    assert parse(parser, torn)[0].counts is None
    (after_gap,) = parse(parser, frames[5])
    assert after_gap.counts is not None
    assert after_gap.missing == 3
    (wrapped,) = parse(parser, frames[66])  # numbers have eight bits, four for each frame
    assert wrapped.missing == 60


@given(st.binary(max_size=300))
def test_any_line_is_survived(line):
    for parser in (make_tmf_parser(), Vl53l8Parser(Vl53l8Options())):
        for head in (b"", b"#Raw,65,3,", b"#Obj,65,3,", b"Aggregate ", b"Aggregate 0, Bins: "):
            parser.parse_line(head + line)


def test_compact_histograms_of_each_zone():
    parser = Vl53l8Parser(Vl53l8Options())
    counts = draw_counts(16, 5, 24) % 100_000
    lines = [b"Zone 3: No target\r\n", *format_vl53l8(counts), *format_vl53l8(counts)[:9]]
    (frame,) = parse(parser, lines)
    assert_array_equal(frame.counts, counts)
    # The next one is cut and begins anew: it is whole, and what was cut is not counted twice.
    (again,) = parse(parser, format_vl53l8(counts))
    assert_array_equal(again.counts, counts)
    torn = format_vl53l8(counts)
    torn[5] = torn[5][:-9] + b"\r\n"
    assert parse(parser, torn)[0].counts is None
    less_than_nothing = torn[1].replace(b"Bins: ", b"Bins: -").strip()
    assert parser.parse_line(less_than_nothing) is None


@pytest.mark.parametrize(
    ("address", "shape"),
    [
        ("sim+tmf8828://?seed=1&rate=100", (128, 8, 8)),
        ("sim+tmf8828://?seed=1&rate=100&zones=9&start=", (128, 3, 3)),
        ("sim+vl53l8://?seed=1&rate=100&zones=64&sub_sample=1&bins=60", (60, 8, 8)),
        ("sim+vl53l8://?seed=1&rate=100&shape=2x8", (24, 2, 8)),
    ],
)
def test_the_peak_of_each_zone_is_where_the_wall_is(address, shape):
    counted = read_photons(f"{address}&scans=3")
    assert counted.counts.shape == shape
    zones = shape[1] * shape[2]
    ranges = counted.times[counted.counts.argmax(axis=0)] * SPEED_OF_LIGHT / 2
    bin_m = counted.bin_width * SPEED_OF_LIGHT / 2
    assert np.abs(ranges.ravel() - compute_zone_ranges(zones)).max() < bin_m
    assert counted.to_image().photons > 100 * zones


def test_every_frame_is_accounted_for():
    with devices.open("sim+tmf8828://?seed=1&rate=200&torn=4&lost=5") as source:
        frames = take(source, 12)
        info = source.info.as_dict()
        finish(source)
    stats = source.stats
    # Of 20 frames 4 are lost, and of the others 4 torn.
    assert [int(frame["number"]) for frame in frames[:6]] == [0, 1, 2, 5, 6, 8]
    assert stats.lost_device >= 3
    assert stats.malformed >= 3
    assert info["zones"] == 64


def test_a_kit_that_is_unplugged():
    with devices.open("sim+tmf8828://?seed=1&rate=100&reconnect_s=0.2") as source:
        take(source, 2)
        source._release()
        with pytest.raises(DeviceDisconnectedError, match="no answer came"):
            take(source, 1000)
    assert source.stats.is_balanced
    assert source.stats.delivered >= 2


def test_what_cannot_be_opened(monkeypatch):
    with pytest.raises(DeviceNotFoundError, match="is the kit connected"):
        devices.open("vl53l8:///nowhere")
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[serial\]"):
        devices.open("vl53l8:///dev/null")
