"""Parts of compiled loops and their vectors, hearing of the compiler's work, and runs that cannot
keep it.
"""

import io
import logging
import os
import pickle
import subprocess
import sys

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numba import njit

from apps import cli
from tofclip import vectors
from tofclip.compiling import compile_as_part
from tofclip.vectors import (
    choose,
    copy_transposed,
    count_set_lanes,
    fill_vector,
    find_highest_lane,
    list_set_lanes,
    load_vector,
    raise_vector,
    store_vector,
    sum_vector,
)


def test_a_part_runs_from_python_and_from_a_compiled_loop(caplog):
    @compile_as_part(fastmath=True)
    def halve(number):
        return number / 2

    @numba.njit(error_model="python")
    def quarter(number):
        return halve(halve(number))

    caplog.set_level(logging.INFO, "tofclip.compiling")
    assert (halve(3.0), caplog.messages) == (1.5, [])
    for number in (3.0, 5.0):
        assert quarter(number) == number / 4
        assert caplog.messages == ["quarter", "halve"]


@pytest.mark.parametrize("is_terminal", [True, False])
def test_the_program_announces_compiling_in_one_line_on_a_terminal_only(is_terminal, monkeypatch):
    def run(words, **options):
        double = compile_as_part()(lambda number: 2 * number)

        @numba.njit
        def quadruple(number):
            return double(double(number))

        @numba.njit
        def add_one(number):
            return number + 1

        return int(add_one(quadruple(2))) - 9

    printed = io.StringIO()
    printed.isatty = lambda: is_terminal
    monkeypatch.setattr(cli, "app", run)
    monkeypatch.setattr(sys, "stderr", printed)
    assert cli.main([]) == 0
    said = printed.getvalue()
    assert said.count("compiling loops for this processor, once") == int(is_terminal)
    assert said.count("\n") == int(is_terminal)


class TestCache:
    LOOP = """
from tofclip.compiling import compile_loop

@compile_loop()
def add_one(numbers):
    numbers[0] += 1
"""
    CALL_IT = """
from apps import cli

def run(*_, **__):
    import numpy
    from loops import add_one
    add_one(numpy.zeros(1))

cli.app = run
sys.exit(cli.main([]))
"""

    def run(self, folder, home, cache, *first):
        """Compile and run a loop by the program, in a process without other places for the cache;
        return the lines that it says.
        """
        (folder / "loops.py").write_text(self.LOOP)
        places = {"HOME": str(home), "XDG_CACHE_HOME": str(home), "NUMBA_CACHE_DIR": str(cache)}
        done = subprocess.run(
            [sys.executable, "-c", "import sys; " + "; ".join(first) + self.CALL_IT],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path]), **places},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stderr.splitlines()

    def assert_not_kept(self, said):
        (line,) = said
        warning = "compiled loops cannot be kept, so every run compiles them again"
        assert line.startswith(f"tofclip: warning: {warning}")
        assert "NUMBA_CACHE_DIR" in line

    def test_without_a_place_for_compiled_loops_they_are_compiled_for_the_run(self, tmp_path):
        """As in an installation that is read-only, for a user without a home."""
        (tmp_path / "file").touch()  # a folder below it cannot be made by anybody
        forbid = "from numba.core.caching import InTreeCacheLocator as place"
        nowhere = "place.get_cache_path = lambda _: '/dev/null/cache'"
        below = tmp_path / "file" / "cache"
        self.assert_not_kept(self.run(tmp_path, tmp_path / "file", below, forbid, nowhere))

    def test_a_full_disk_of_the_cache_keeps_no_result(self, tmp_path):
        fill = "from numba.core.caching import IndexDataCacheFile as file"
        full = "file._save_data = lambda *_: open('/dev/full', 'w', 1).write('loop\\n')"
        self.assert_not_kept(self.run(tmp_path, tmp_path / "home", tmp_path / "cache", fill, full))

    @pytest.mark.parametrize(
        "left",
        [b"", pickle.dumps(numba.__version__) + b"ctofclip.gone\nloop\n."],
        ids=["damaged", "of a version with other modules"],
    )
    def test_a_cache_that_cannot_be_read_is_made_anew(self, tmp_path, left):
        assert self.run(tmp_path, tmp_path / "home", tmp_path) == []
        kept = list(tmp_path.rglob("*.nb[ic]"))
        assert kept
        for file in kept:
            file.write_bytes(left)
        assert self.run(tmp_path, tmp_path / "home", tmp_path) == []
        assert all(file.read_bytes() != left for file in kept)


# Vectors in compiled loops do what NumPy does with sixteen numbers: whole ones, of which float32
# sums are exact in any order.
floats = arrays(np.float32, vectors.LENGTH, elements=st.integers(-1000, 1000).map(np.float32))


@njit
def _combine(one, other, results):
    a, b = load_vector(one, np.uintp(0)), load_vector(other, np.uintp(0))
    store_vector(results[0], np.uintp(0), a + b)
    store_vector(results[1], np.uintp(0), a - b)
    store_vector(results[2], np.uintp(0), a * b)
    store_vector(results[3], np.uintp(0), choose((a > b) & (b >= fill_vector(one[3])), a, b))
    store_vector(results[4], np.uintp(0), raise_vector(a, b))
    return sum_vector(a), find_highest_lane(b), list_set_lanes(a >= b), count_set_lanes(a >= b)


@given(floats, floats)
def test_arithmetic_and_choice(one, other):
    results = np.empty((5, vectors.LENGTH), np.float32)
    total, highest, bits, number = _combine(one, other, results)
    chosen = np.where((one > other) & (other >= one[3]), one, other)
    expected = [one + other, one - other, one * other, chosen, np.maximum(one, other)]
    np.testing.assert_array_equal(results, expected)
    assert (total, highest, number) == (one.sum(), other.max(), (one >= other).sum())
    assert int(bits) == sum(1 << k for k in np.flatnonzero(one >= other).tolist())


@njit
def _transpose(source, stride, target, step):
    copy_transposed(source, np.uintp(3), stride, target, np.uintp(5), step)


def test_sixteen_vectors_become_sixteen_others():
    source = np.arange(3 + 16 * 20, dtype=np.float32)
    target = np.full(5 + 16 * 19, -1, np.float32)
    _transpose(source, np.uintp(20), target, np.uintp(19))
    written = target[5:].reshape(16, 19)
    np.testing.assert_array_equal(written[:, :16], source[3:].reshape(16, 20)[:, :16].T)
    assert np.all(target[:5] == -1)
    assert np.all(written[:, 16:] == -1)
