"""Thirty ways in which instruments, their clients, readers and disks go wrong, and the test of each:
none may be silent, none may hang.
"""

from __future__ import annotations

import ast
from concurrent.futures import Future
from functools import lru_cache
from pathlib import Path
from time import monotonic

import numpy as np
import pytest

from devices.frames import FrameCodec
from devices.source import Info, Ledger, OverflowPolicy
from devices.stream import BufferSettings, StreamSource, Transfer
from tofclip.errors import BufferOverflowError

FOLDER = Path(__file__).parent

FAULTS = {
    # the file
    "a second recorder on one path": "test_recording::test_a_second_recorder_is_refused",
    "the file is removed or replaced": "test_recording::test_a_file_that_is_gone_is_noticed",
    "the disk is full": "test_recording::test_a_full_disk_keeps_what_was_recorded",
    "kill -9": "test_recording::test_killed_recorders_leave_what_they_flushed",
    "a quiet stream's last piece": "test_recording::test_what_a_quiet_stream_brought_is_in_the_file",
    "bits flipped at 400 places": "test_recording::test_one_flipped_bit_costs_one_block",
    "truncated at each 1000th byte": (
        "test_recording::test_a_truncated_recording_is_good_up_to_its_end_and_says_that_it_is_cut"
    ),
    "the computer's clock is set": (
        "test_recording::test_a_clock_that_is_set_does_not_stop_a_replay"
    ),
    # the program
    "SIGINT, SIGTERM, SIGHUP while pieces wait": "test_recording::test_a_signal_stops_and_drains",
    "SIGINT, SIGTERM, SIGHUP at random moments": (
        "test_signals::test_whenever_a_signal_comes_the_gain_goes_down"
    ),
    "the reading thread fails": "test_recording::test_a_reader_thread_never_dies_silently",
    "the instrument fails in a recording": (
        "test_recording::test_an_instrument_that_fails_leaves_a_whole_recording"
    ),
    "a reader 64 MiB behind": "test_fault_table::test_a_reader_64_mib_behind",
    "a reader slower than the camera": (
        "test_transients::test_a_slow_viewer_gets_the_newest_picture_and_is_told_of_the_others"
    ),
    # RemoteEx
    "stray bytes on the data port": (
        "test_remoteex::test_stray_bytes_on_the_data_port_are_thrown_away"
    ),
    "sequence numbers restart": "test_remoteex::test_numbers_that_restart_are_followed",
    "Latin-1": "test_remoteex_protocol::test_text_is_latin_1",
    "bare carriage returns in errors": (
        "test_remoteex::test_an_error_of_several_lines_does_not_shift_the_answers"
    ),
    "live mode runs already": "test_remoteex::test_live_mode_of_an_operator_is_joined_and_goes_on",
    "the camera is busy (code 7)": "test_remoteex::test_a_busy_camera_is_waited_for_or_stopped",
    "HPD-TA is not up": "test_remoteex::test_hpd_ta_is_started_where_it_is_not_up",
    "an answer comes late": (
        "test_remoteex::test_a_late_answer_is_waited_for_and_not_asked_for_again"
    ),
    "the connection breaks": "test_remoteex::test_after_an_unplugged_cable_the_stream_goes_on",
    "pictures fall out of the ring buffer": (
        "test_remoteex::test_pictures_that_fell_out_of_the_ring_are_accounted_for"
    ),
    # USB time tagger
    "CLEAR, stale replies, last session's records": (
        "test_timetag_unkindness::test_every_record_of_this_session_and_no_other"
    ),
    "replies late, lost or stalled": "test_timetag_unkindness::test_no_reply_is_taken_for_another",
    "unplugged and plugged in": "test_timetag_driver::test_a_loose_plug_is_followed",
    # the others
    "a SPAD array complains amid a picture": (
        "test_spad512::test_what_the_server_complains_of_is_passed_on"
    ),
    "packets of a GigE frame are missing": "test_aravis::test_identifiers_tell_what_is_missing",
    "a line of a kit is torn": "test_histogram_kits::test_every_frame_is_accounted_for",
}


@lru_cache
def list_tests(file: str) -> dict[str, str]:
    """Return the source of every test of a file, decorators included, by its name."""
    text = (FOLDER / f"{file}.py").read_text(encoding="utf-8")
    return {
        node.name: "\n".join(ast.unparse(part) for part in (*node.decorator_list, node))
        for node in ast.parse(text).body
        if isinstance(node, ast.FunctionDef)
    }


def test_there_are_thirty() -> None:
    assert len(FAULTS) == 30


@pytest.mark.parametrize("fault", FAULTS)
def test_each_has_a_test_that_runs_with_every_commit(fault: str) -> None:
    file, _, name = FAULTS[fault].partition("::")
    body = list_tests(file)[name]
    assert "assert" in body or "pytest.raises" in body
    assert "@pytest.mark.nightly" not in body


class BoundlessFeed:
    """Pictures of a mebibyte as fast as they are taken, up to a number."""

    codec = FrameCodec(1024, 1024, 8)
    info = Info("boundless")
    calibration = None

    def __init__(self, pictures: int) -> None:
        self._left, self._number = pictures, 0
        self._pixels = bytes(self.codec.pixel_bytes)

    def start(self) -> None:
        """Nothing to start."""

    def pull(self, timeout: float) -> Transfer | None:
        if self._number == self._left:
            return None
        self._number += 1
        packed = self.codec.pack_frame(self._number - 1, self._pixels)
        return Transfer(memoryview(packed), taken_at=monotonic())

    def stop(self) -> None:
        self._left = self._number

    def close(self) -> None:
        """Nothing to close."""


@pytest.mark.parametrize("policy", ["block", "drop_oldest", "fail", "newest"])
def test_a_reader_64_mib_behind(policy: OverflowPolicy) -> None:
    """What it gets, what is reported to it, and that the age is among it."""
    pictures = 80
    feed = BoundlessFeed(pictures)
    is_newest = policy == "newest"
    held = BufferSettings(64 << 20, "block" if is_newest else policy)
    ledger = Ledger()
    source = StreamSource(feed, feed.codec, ledger, held)  # type: ignore[arg-type]
    if is_newest:
        source.keep_newest()
    full = 1 if is_newest else 62
    deadline = monotonic() + 20
    while ledger.stats.acquired < (pictures if is_newest else full) and monotonic() < deadline:
        pass
    began = monotonic()
    numbers = []
    try:
        for batch in source:
            assert 0 < batch.taken_at <= batch.received_at <= monotonic()
            numbers += batch.records["number"].tolist()
    except BufferOverflowError:
        assert policy == "fail"
    source.close()
    stats = source.stats
    assert stats.is_balanced
    assert stats.delivered == len(numbers)
    assert np.all(np.diff(numbers) > 0)
    if policy == "block":
        assert numbers == list(range(pictures))  # it waits, and nothing is lost
    elif is_newest:
        assert numbers[-1] == pictures - 1
        assert stats.dropped_host == pictures - len(numbers)
    else:
        assert stats.dropped_host > 0 or stats.delivered == pictures
    assert monotonic() - began < 20


class ClosingFeed(BoundlessFeed):
    """Closes its own source after some pictures, as the collector may on the reader's thread."""

    def __init__(self, pictures: int) -> None:
        super().__init__(pictures)
        self.source: Future[StreamSource] = Future()

    def pull(self, timeout: float) -> Transfer | None:
        source = self.source.result()
        if self._number == 3:
            source.close()
        return super().pull(timeout)


def test_a_source_that_is_closed_on_its_own_thread_ends_as_any_other() -> None:
    feed = ClosingFeed(80)
    source = StreamSource(feed, feed.codec, Ledger())  # type: ignore[arg-type]
    feed.source.set_result(source)
    while source._ring.get(5.0) is not None:
        pass
    source._thread.join(5.0)
    assert not source._thread.is_alive()
