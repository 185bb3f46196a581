from __future__ import annotations

import threading

import pytest

from tofclip.errors import InputError
from tofclip.threads import LANES, THREADS_VARIABLE, blocks, on_this_thread, run_blocks, thread_count


def test_blocks_cover_everything_once():
    pieces = list(blocks(2 * LANES + 5))
    assert [i for piece in pieces for i in range(piece.start, piece.stop)] == list(range(2 * LANES + 5))
    assert all(piece.stop - piece.start <= LANES for piece in pieces)


@pytest.mark.parametrize("threads", ["1", "2"])
def test_every_block_runs_on_no_more_threads_than_allowed(monkeypatch, threads):
    monkeypatch.setenv(THREADS_VARIABLE, threads)
    seen, names = [], set()

    def work(piece: slice) -> None:
        seen.append(piece.start)
        names.add(threading.current_thread().name)

    run_blocks(work, 10 * LANES)
    assert sorted(seen) == list(range(0, 10 * LANES, LANES))
    assert len(names) <= int(threads)


def test_a_thread_may_keep_its_blocks_to_itself(monkeypatch):
    monkeypatch.setenv(THREADS_VARIABLE, "2")
    names: set[str] = set()

    def work(_: slice) -> None:
        names.add(threading.current_thread().name)

    with on_this_thread():
        run_blocks(work, 10 * LANES)
    assert names == {threading.current_thread().name}
    run_blocks(work, 10 * LANES)
    assert len(names) > 1


@pytest.mark.parametrize("threads", ["1", "2"])
def test_the_first_fault_is_raised(monkeypatch, threads):
    monkeypatch.setenv(THREADS_VARIABLE, threads)

    def work(piece: slice) -> None:
        raise InputError(f"block {piece.start}")

    with pytest.raises(InputError, match="block 0"):
        run_blocks(work, 4 * LANES)


@pytest.mark.parametrize("value", ["0", "-1", "two", "1.5"])
def test_a_nonsensical_thread_count_is_refused(monkeypatch, value):
    monkeypatch.setenv(THREADS_VARIABLE, value)
    with pytest.raises(InputError, match=THREADS_VARIABLE):
        thread_count()
