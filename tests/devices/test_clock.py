"""An instrument's clock, estimated from messages that are delayed at random."""

from __future__ import annotations

import numpy as np
import pytest

from devices.stream import WINDOW_S, InstrumentClock


def test_the_least_delay_remains_in_the_estimate_and_nothing_else() -> None:
    random = np.random.default_rng(0)
    clock = InstrumentClock()
    assert clock.to_host(1.0) == 0.0  # nothing known yet
    delays = 0.002 + random.exponential(0.05, 500)
    for number, delay in enumerate(delays):
        clock.observe(number * 0.01, 1000 + number * 0.01 + delay)
    assert clock.to_host(2.5) == pytest.approx(1002.5 + delays.min())


def test_quartzes_that_part_are_followed() -> None:
    clock, drift = InstrumentClock(), 50e-6
    for second in range(600):
        clock.observe(second * (1 + drift), second + 0.001)
    # An estimate from the first second would be wrong by 30 ms, one of two windows by 3 at most.
    assert clock.to_host(600 * (1 + drift)) == pytest.approx(600, abs=2 * WINDOW_S * drift + 0.001)


def test_a_stamp_that_goes_back_begins_anew() -> None:
    clock = InstrumentClock()
    clock.observe(100.0, 5.0)
    clock.observe(0.0, 6.0)
    assert clock.to_host(1.0) == pytest.approx(7.0)


def test_the_least_delay_is_known_for_a_window_and_the_one_before_it() -> None:
    clock = InstrumentClock()
    clock.observe(0.0, 1.0)
    clock.observe(WINDOW_S, WINDOW_S + 1.5)  # a new window, late from its first message on
    assert clock.to_host(40.0) == pytest.approx(41.0)
    clock.observe(2 * WINDOW_S + 1, 2 * WINDOW_S + 2.8)
    assert clock.to_host(80.0) == pytest.approx(81.5)  # the first window is forgotten
