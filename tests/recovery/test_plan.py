"""A plan checks before it runs."""

from __future__ import annotations

import numpy as np
import pytest
from three_view_shot import make_streak

from tofclip.errors import CalibrationError, InputError
from tofclip.recovery import DepthLockedFocus, FixedFocus, open_shot, plan_recovery
from tofclip.shots import Streak


@pytest.fixture
def streak() -> Streak:
    return make_streak()


def test_a_plan_refuses_before_it_runs(streak):
    shot = open_shot(streak)
    with pytest.raises(InputError, match="unknown method"):
        plan_recovery(shot, "magic")
    with pytest.raises(InputError, match="focus"):
        plan_recovery(shot, "tv", "sharp")
    with pytest.raises(CalibrationError, match="lenslet pitch"):
        plan_recovery(shot, "tv", DepthLockedFocus())
    with pytest.raises(InputError, match="device"):
        plan_recovery(shot, device="abacus")


def test_a_plan_knows_its_work_and_its_memory(streak):
    plan = plan_recovery(open_shot(streak), "linear", FixedFocus(0.5))
    done: list[int] = []
    frames = plan.run(done.append)
    assert sum(done) == plan.work == 12
    assert plan.memory_bytes == frames.values.nbytes + 90 * 12 * (4 + 1)
    np.testing.assert_array_equal(frames.shears, np.full(12, 0.5))
    again = plan.run()
    np.testing.assert_array_equal(again.values, frames.values)
