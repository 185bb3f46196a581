"""The viewer in a headless browser on this machine: updates a second, latency, and how soon a large
cloud is seen.

    python tests/benchmarks/viewer.py [--json] [--seconds 10] [--points 15625]

Needs playwright and chromium. The browser draws with a software renderer, on the same cores as the
program.

* updates: frames that the page says it has, in the step of its loop that draws them, per second;
* processor: time that the program, and the browser with its software renderer, need for an update;
  these do not depend on what else the machine does;
* latency: from the moment a frame is handed to the server until the page's answer that it has it is
  back;
* large: a PLY file of a million points, from opening it to all of it being drawn in a tab that was
  open already.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright
from viser import _messages

from apps.viewer.clouds import make_cloud
from apps.viewer.page import Page
from apps.viewer.session import DisplayedFrame, Session
from apps.viewer.source import Source, View
from apps.viewer.source_factory import open_source

FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
)
WINDOW = {"width": 1100, "height": 640}
LARGE = 1_000_000
FRAMES = 200


def make_echo_request(server: Any, answered: Callable[[], None]) -> Callable[[], None]:
    """Return a function that asks the page to answer once all that was sent so far is drawn.

    It reaches into viser's inner messages, which only a measurement may do.
    """
    names = (f"tofclip-drawn-{number % 4}" for number in itertools.count())

    def heard(_: int, message: Any) -> None:
        if message.request_uuid.startswith("tofclip-drawn"):
            answered()

    server._websock_server.register_handler(_messages.LocalStorageGetItemResponseMessage, heard)

    def ask() -> None:
        name = next(names)
        server._websock_server.queue_message(
            _messages.LocalStorageGetItemRequestMessage(name, name)
        )

    return ask


class Waves(Source):
    """A sheet of points that moves: every frame is another cloud."""

    def __init__(self, points: int) -> None:
        super().__init__("waves", 60.0)
        side = round(points**0.5)
        x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
        self._views = [View(_wave(x, y, 2 * np.pi * number / FRAMES)) for number in range(FRAMES)]

    def __len__(self) -> int:
        return FRAMES

    def view(self, number: int) -> View:
        return self._views[number]


class Timed(Page):
    """A page that remembers when each frame was handed over, and when the browser answered that it
    had it.
    """

    def __init__(self, *arguments: Any) -> None:
        self.handed: list[float] = []
        self.answered: list[float] = []
        super().__init__(*arguments)
        self._ask = make_echo_request(
            self.server, lambda: self.answered.append(time.perf_counter())
        )

    def _draw(self, shown: DisplayedFrame, now: float) -> None:
        self.handed.append(time.perf_counter())
        super()._draw(shown, now)
        self._ask()


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=int, default=15_625)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=FLAGS.split()
        )
        figures = {**_streamed(browser, asked.points, asked.seconds), **_large(browser)}
        browser.close()
    print(
        json.dumps(figures)
        if asked.json
        else "\n".join(f"{name:28} {value:g}" for name, value in figures.items())
    )


def _wave(x: Any, y: Any, phase: float) -> Any:
    z = 3 + 0.2 * np.sin(4 * x + phase) * np.cos(3 * y)
    return make_cloud(
        np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32), {"intensity": z.ravel()}
    )


def _served(page: Page) -> threading.Thread:
    thread = threading.Thread(target=page.run, daemon=True)
    thread.start()
    return thread


def _streamed(browser: Any, points: int, seconds: float) -> dict[str, float]:
    page = Timed(Session(Waves(points)))
    _served(page)
    tab = browser.new_page(viewport=WINDOW)
    tab.goto(page.address)
    tab.locator("#frame-number").wait_for(timeout=60_000)
    time.sleep(2)  # the tab has caught up
    page.handed.clear()
    page.answered.clear()
    page.post(page.session.play)
    time.sleep(1)
    begin = len(page.answered)
    program, family = time.process_time(), _processor_seconds()
    time.sleep(seconds)
    program, family = time.process_time() - program, _processor_seconds() - family
    latencies = [1e3 * (then - now) for now, then in zip(page.handed, page.answered, strict=False)][
        begin:
    ]
    updates = len(page.answered) - begin
    tab.close()
    page.close()
    return {
        "points": points,
        "updates_per_second": updates / seconds,
        "program_processor_ms": 1e3 * program / updates,
        "browser_processor_ms": 1e3 * (family - program) / updates,
        "latency_median_ms": statistics.median(latencies),
        "latency_worst_tenth_ms": float(np.quantile(latencies, 0.9)),
    }


def _processor_seconds() -> float:
    """Processor time of this program and of all that it has started, s."""
    parents, used = {}, {}
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "stat").read_text().rpartition(")")[2].split()
        except (OSError, IndexError):
            continue
        if entry.name.isdecimal() and len(words) > 12:
            parents[int(entry.name)] = int(words[1])
            used[int(entry.name)] = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    family = {os.getpid()}
    while more := {child for child, parent in parents.items() if parent in family} - family:
        family |= more
    return sum(used.get(one, 0.0) for one in family)


def _latencies(sent: list[tuple[int, float]], seen: list[list[float]]) -> list[float]:
    """Time from handing a frame over to seeing its number; a number comes round again only after
    seconds.
    """
    found = []
    for frame, at in seen:
        earlier = [then for number, then in sent if number == frame and then <= at]
        if earlier:
            found.append(at - earlier[-1])
    return found


def _large(browser: Any) -> dict[str, float]:
    tab = browser.new_page(viewport=WINDOW)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.ply"
        xyz = np.random.default_rng(0).uniform(-1, 1, (LARGE, 3)).astype(np.float32) + np.float32(
            [0, 0, 3]
        )
        make_cloud(xyz).save(path)
        started = time.perf_counter()
        session = Session(open_source(str(path)))
        page = Page(session)
        ready = time.perf_counter()
        drawn = threading.Event()
        ask = make_echo_request(page.server, drawn.set)
        _served(page)
        tab.goto(page.address)
        page.post(ask)
        drawn.wait(60)
        done = time.perf_counter()
        tab.close()
        page.close()
    return {"large_points": LARGE, "large_read_s": ready - started, "large_seen_s": done - started}


if __name__ == "__main__":
    main()
