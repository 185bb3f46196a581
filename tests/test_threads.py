"""Blocks and items on threads, and the threads of BLAS."""

import os
import subprocess
import sys
import threading
import time

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from tofclip import threads as threads_module
from tofclip.errors import InputError
from tofclip.threads import (
    LANES,
    THREADS_VARIABLE,
    limit_blas_threads,
    map_parallel,
    run_blocks,
    split_blocks,
    thread_count,
)


@pytest.fixture(params=["1", "3"])
def threads(request, monkeypatch):
    monkeypatch.setenv(THREADS_VARIABLE, request.param)
    return int(request.param)


class TestBlocks:
    def test_they_cover_everything_once(self):
        pieces = list(split_blocks(2 * LANES + 5))
        covered = [i for piece in pieces for i in range(piece.start, piece.stop)]
        assert covered == list(range(2 * LANES + 5))
        assert all(piece.stop - piece.start <= LANES for piece in pieces)

    def test_every_block_runs_on_no_more_threads_than_allowed(self, threads):
        seen, names = [], set()

        def work(piece):
            seen.append(piece.start)
            names.add(threading.current_thread().name)

        run_blocks(work, 10 * LANES)
        assert sorted(seen) == list(range(0, 10 * LANES, LANES))
        assert len(names) <= threads

    @pytest.mark.usefixtures("threads")
    def test_the_first_fault_is_raised(self):
        def work(piece):
            raise InputError(f"block {piece.start}")

        with pytest.raises(InputError, match="block 0"):
            run_blocks(work, 4 * LANES)

    @pytest.mark.parametrize("value", ["0", "-1", "two", "1.5"])
    def test_a_nonsensical_thread_count_is_refused(self, monkeypatch, value):
        monkeypatch.setenv(THREADS_VARIABLE, value)
        with pytest.raises(InputError, match=THREADS_VARIABLE):
            thread_count()


class TestItems:
    def test_they_have_a_core_each_and_come_back_in_order(self, threads):
        busy, most, lock = [0], [0], threading.Lock()

        def work(item):
            with lock:
                busy[0] += 1
                most[0] = max(most[0], busy[0])
            names = set()
            run_blocks(lambda _: names.add(threading.current_thread().name), 4 * LANES)
            time.sleep(0.01 * (item % 3))
            with lock:
                busy[0] -= 1
            return item, len(names)

        assert list(map_parallel(work, range(10))) == [(item, 1) for item in range(10)]
        assert most[0] <= threads

    def test_a_failed_one_ends_the_row_in_its_place_and_few_are_begun_after_it(self):
        begun = []

        def work(item):
            begun.append(item)
            if item == 2:
                raise InputError("the third")
            return item

        coming = map_parallel(work, iter(range(1000)))
        assert [next(coming), next(coming)] == [0, 1]
        with pytest.raises(InputError, match="the third"):
            next(coming)
        assert len(begun) <= 3 + thread_count()

    def test_they_are_taken_as_they_are_needed(self):
        taken = []
        coming = map_parallel(lambda item: item, (taken.append(n) or n for n in range(1000)))
        assert next(coming) == 0
        # one for each thread waits while the first result is used; without threads none does
        needed = 1 if thread_count() == 1 else thread_count() + 1
        assert len(taken) == needed
        coming.close()
        assert len(taken) == needed

    def test_a_forgotten_map_may_be_closed_while_this_thread_holds_the_lock(self):
        coming = map_parallel(abs, range(1000))
        assert next(coming) == 0

        def close_as_the_collector_might():
            with threads_module._blas_lock:
                coming.close()

        closing = threading.Thread(target=close_as_the_collector_might, daemon=True)
        closing.start()
        closing.join(30)
        assert not closing.is_alive()


class TestBlas:
    def count(self):
        libraries = [one for one in threadpool_info() if one["user_api"] == "blas"]
        return [library["num_threads"] for library in libraries]

    def test_overlapping_limits_hold_until_the_last_ends_and_then_restore(self):
        with threadpool_limits(2, user_api="blas"):
            before = self.count()
            first, second = limit_blas_threads(), limit_blas_threads()
            first.__enter__()
            second.__enter__()
            first.__exit__(None, None, None)
            during = self.count()
            second.__exit__(None, None, None)
            assert set(during) == {1}
            assert self.count() == before == [2] * len(before)

    def test_a_library_that_is_loaded_later_is_limited_too(self):
        pytest.importorskip("cv2", reason="OpenCV brings a BLAS of its own")
        script = """
from threadpoolctl import threadpool_info
from tofclip.threads import limit_blas_threads

def blas_threads():
    return {x["filepath"]: x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"}

with limit_blas_threads():
    before = blas_threads()
    import cv2
    with limit_blas_threads():
        during = blas_threads()
print(len(before), set(during.values()), set(blas_threads().values()))
"""
        finished = subprocess.run(
            [sys.executable, "-c", script],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "2"},
        )
        assert finished.stdout == "2 {1} {2}\n"
