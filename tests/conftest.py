"""What every test may ask for, and what holds for all of them on any machine."""

import faulthandler
import gc
import os
import re
import signal
import sys
import threading
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:
    # Workers share the cores: products on threads of their own would only wait for each other.
    # This has to be said before NumPy is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if threading.current_thread() is threading.main_thread():
    # Started in the background by a shell, this process may ignore Ctrl-C, and so would what it starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest
from hypothesis import HealthCheck, settings

from tofclip.errors import MissingDependencyError
from tofclip.files import import_open3d

# How long an example takes says nothing where the first one compiles, or where other programs run.
anywhere = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("day", anywhere, max_examples=40)
settings.register_profile("night", anywhere, max_examples=400)
settings.load_profile("day")


@pytest.fixture(scope="session")
def open3d():
    """Open3D; what needs it is skipped where it has no wheel."""
    try:
        return import_open3d()
    except MissingDependencyError as fault:
        pytest.skip(str(fault))


ROOMS_OF_LONG_FILES = {"viewer", "apps"}
"""Their tests run whole programs."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Keep the tests of a file on one worker, so that it makes what they share once; the longest
    files come first, so that no worker has one left at the end.

    A mark ``xdist_group`` puts the tests of several files together, or splits a file.
    """
    items.sort(key=lambda item: ROOMS_OF_LONG_FILES.isdisjoint(item.path.parts))
    for item in items:
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(item.path.stem))


def pytest_collection_finish():
    """Look for no garbage among what was imported: it took one second of twenty-five."""
    gc.freeze()


SECONDS_TO_END = 120.0
"""What a worker may take between its last test and the end of its session."""


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish():
    """Let no worker that hangs after its last test keep all others: it says where, and ends.

    Tests that hang are ended likewise, by `faulthandler_timeout`.
    """
    if "PYTEST_XDIST_WORKER" in os.environ:
        faulthandler.dump_traceback_later(SECONDS_TO_END, exit=True, file=sys.__stderr__)


STRICT = "TOFCLIP_KNOWN_SKIPS_ONLY" in os.environ

KNOWN_SKIPS = {
    "": r"^no (recorded|clip pictures|/)|Aravis|Swabian|kiss_icp|bm3d|matrix registers|"
    "there is a graphics processor",
    "torch": "torch|PyTorch|another device than NumPy's",
    "browser": "chromium",
}
"""What a machine may lack, and, by its name in TOFCLIP_WITHOUT, what .ci/run may be told to do without."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    report = yield
    return refuse_unknown_skip(report)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    report = yield
    return refuse_unknown_skip(report)


def refuse_unknown_skip(report):
    """Let a skip fail in .ci/run if no reason that is known says why: what is not tested is said."""
    if not report.skipped or hasattr(report, "wasxfail") or not STRICT:
        return report
    assert isinstance(report.longrepr, tuple)
    reason = report.longrepr[2].removeprefix("Skipped: ")
    allowed = ["", *os.environ.get("TOFCLIP_WITHOUT", "").split()]
    if not any(re.search(KNOWN_SKIPS[name], reason) for name in allowed):
        report.outcome, report.longrepr = (
            "failed",
            f"skipped for a reason that is not known: {reason}",
        )
    return report


@pytest.fixture(scope="session")
def shared_data():
    """Folder with the instruments' recorded data; tests that need it are skipped where it is
    absent.
    """
    folder = Path(os.environ.get("TOFCLIP_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recorded data in {folder}; name its folder in TOFCLIP_DATA")
    return folder
