"""Study: the viewer in a headless chromium on this machine, drawn by a software renderer.

From handing a cloud over until the page answers that it has it, against the answer alone; from
turning a cloud until it is drawn from there, in as much detail as the page chooses and with all
points; and from opening a PLY file until it is drawn, against reading the file's bytes. Needs
playwright and chromium.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright
from viser import _messages

from apps.benchmarks.harness import Prepare, PreparedCase
from apps.viewer.page import Page
from apps.viewer.points import DetailChooser
from apps.viewer.session import Session
from apps.viewer.source import Source, View, make_cloud
from apps.viewer.source_factory import open_source

FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
)
WINDOW = {"width": 1100, "height": 640}
FRAMES, MAX_POINTS_IN_MEMORY = 32, 8_000_000
PATIENCE_S = 60.0
TURN_RAD = np.deg2rad(2.0)


class MovingSheet(Source):
    """A sheet of points that moves: every frame is another cloud."""

    def __init__(self, points: int) -> None:
        super().__init__("sheet", 60.0)
        side = round(points**0.5)
        x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
        frames = max(2, min(FRAMES, MAX_POINTS_IN_MEMORY // points))
        self._views = [View(_bend_sheet(x, y, number)) for number in range(frames)]

    def __len__(self) -> int:
        return len(self._views)

    def view(self, number: int) -> View:
        return self._views[number]


def _bend_sheet(x: Any, y: Any, number: int) -> Any:
    z = 3 + 0.2 * np.sin(4 * x + 2 * np.pi * number / FRAMES) * np.cos(3 * y)
    xyz = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    return make_cloud(xyz, {"intensity": z.ravel()})


class WholeDetail(DetailChooser):
    """Draws all points, however slow that is."""

    def count(self, points: int, moving: bool) -> int:
        return points


def make_echo_request(server: Any, answered: Callable[[], None]) -> Callable[[], None]:
    """Have the page call back once all is drawn, by viser's inner messages: only to measure."""
    names = (f"tofclip-drawn-{number % 4}" for number in itertools.count())

    def receive(_: int, message: Any) -> None:
        if message.request_uuid.startswith("tofclip-drawn"):
            answered()

    server._websock_server.register_handler(_messages.LocalStorageGetItemResponseMessage, receive)

    def ask() -> None:
        name = next(names)
        server._websock_server.queue_message(
            _messages.LocalStorageGetItemRequestMessage(name, name)
        )

    return ask


def open_browser(stack: contextlib.ExitStack) -> Any:
    """A browser that is closed with the stack."""
    driver = stack.enter_context(sync_playwright())
    browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS.split())
    stack.callback(browser.close)
    return browser


def serve_page(source: Source, whole: bool = False) -> tuple[Page, Callable[[], None]]:
    """A page that is served, and what waits until a browser has drawn all that was sent so far."""
    page, answered = Page(Session(source)), threading.Event()
    if whole:
        page.points.detail = WholeDetail()
    ask = make_echo_request(page.server, answered.set)

    def wait() -> None:
        answered.clear()
        ask()
        page.server.flush()
        if not answered.wait(PATIENCE_S):
            raise TimeoutError(f"the browser did not answer within {PATIENCE_S:g} s")

    threading.Thread(target=page.run, daemon=True).start()
    return page, wait


def make_stack() -> contextlib.ExitStack:
    """What is closed when the process ends."""
    stack = contextlib.ExitStack()
    atexit.register(stack.close)
    return stack


def open_sheet(points: int, whole: bool) -> tuple[Page, Callable[[], None]]:
    """A moving sheet in a tab, as soon as the page knows how quick the tab is."""
    stack = make_stack()
    tab = open_browser(stack).new_page(viewport=WINDOW)
    page, wait = serve_page(MovingSheet(points), whole)
    stack.callback(page.close)
    tab.goto(page.address)
    tab.locator("#frame-number").wait_for(timeout=1e3 * PATIENCE_S)
    deadline = time.monotonic() + PATIENCE_S
    while not (whole or page.points.is_settled) and time.monotonic() < deadline:
        time.sleep(0.1)
    wait()
    return page, wait


def play_sheet(points: int, whole: bool) -> PreparedCase:
    """Show frame after frame as if it were played, in as much detail as the page chooses or whole."""
    page, wait = open_sheet(points, whole)
    numbers = itertools.cycle(range(len(page.session.source)))
    page.session.clock.rate = 1e-9  # this case says which frame is due

    def show_frame() -> None:
        number, sent = next(numbers), threading.Event()

        def move() -> None:
            page.session.clock.play()
            page.session.clock.jump(number)
            sent.set()

        page.post(move)
        sent.wait(PATIENCE_S)
        wait()

    return PreparedCase(show_frame, wait, 1)


def orbit_sheet(points: int, whole: bool) -> PreparedCase:
    """Turn a sheet about its middle, in as much detail as the page chooses or whole."""
    page, wait = open_sheet(points, whole)
    (client,) = page.server.get_clients().values()
    target = np.array(client.camera.look_at)
    away = np.array(client.camera.position) - target
    steps = itertools.count()

    def turn() -> None:
        angle = TURN_RAD * next(steps)
        across = np.array([np.cos(angle), 0.0, np.sin(angle)]) * away[2] * 0.3
        client.camera.position = target + away + across
        client.camera.look_at = target
        wait()

    return PreparedCase(turn, wait, 1)


def prepare_large_cloud(points: int) -> PreparedCase:
    """A PLY file, from opening it to all of it drawn in a tab of its own."""
    stack = make_stack()
    path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "large.ply"
    xyz = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (points, 3))
    make_cloud(xyz.astype(np.float32)).save(path)
    browser = open_browser(stack)

    def show_file() -> None:
        tab = browser.new_page(viewport=WINDOW)
        page, wait = serve_page(open_source(str(path)))
        tab.goto(page.address)
        wait()
        tab.close()
        page.close()

    return PreparedCase(show_file, path.read_bytes, 1)


PREPARE: dict[str, Prepare] = {
    "viewer-frames": partial(play_sheet, whole=False),
    "viewer-whole_frames": partial(play_sheet, whole=True),
    "viewer-orbit": partial(orbit_sheet, whole=False),
    "viewer-whole_orbit": partial(orbit_sheet, whole=True),
    "viewer-file": prepare_large_cloud,
}
