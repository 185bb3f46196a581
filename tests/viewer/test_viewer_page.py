"""The page in a browser: what a user sees, clicks and takes along."""

from __future__ import annotations

import http.server
import io
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser
from matplotlib.image import imread
from viewer_scenes import PlaneSource, frames, volume

from apps.viewer.page import Page, WaitingPage
from apps.viewer.session import Session
from apps.viewer.sources import (
    GATE_AROUND_FRAME,
    SLICE_MODE,
    SURFACE_MODE,
    TransientSource,
    VolumeSource,
)
from apps.viewer.viewpoint import Viewpoint
from tofclip.lidar import PointCloud

playwright = pytest.importorskip(
    "playwright.sync_api", reason="the page is driven by playwright: pip install playwright"
)
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
)
LOADING_MS = 120_000  # a page and its first picture, while all cores compute something else
PATIENCE_MS = 30_000  # a software renderer on a busy machine draws twice a second
SCENE = "canvas[data-engine]"
OPEN_SOCKET = """place => new Promise(decide => {
    const socket = new WebSocket(place, ["viser-v" + "VERSION"]);
    socket.onmessage = () => decide(true);
    socket.onclose = () => decide(false);
})""".replace("VERSION", viser.__version__)
"""Says whether a page may open a WebSocket and receives something."""

HARMLESS = ("THREE.Clock", "GPU stall", "GroupMarkerNotSet", "Automatic fallback to software WebGL")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("there is no chromium here (on Debian: apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS.split())
        yield opened
        opened.close()


class Seen:
    """A served session and the tab that looks at it."""

    def __init__(self, browser: Any, session: Session) -> None:
        self.page, self.complaints = Page(session), []
        self._thread = threading.Thread(target=self.page.run, daemon=True)
        self._thread.start()
        self.tab = browser.new_page(viewport={"width": 1024, "height": 700})
        self.tab.set_default_timeout(PATIENCE_MS)
        self.tab.on("console", self._listen)
        self.tab.on("pageerror", lambda fault: self.complaints.append(str(fault)))
        self.tab.goto(self.page.address)
        self.tab.locator("#label").wait_for(timeout=LOADING_MS)
        notice = self.tab.locator(
            "[class*=Notification-closeButton]"
        )  # that the renderer is a slow one
        notice.first.wait_for(timeout=LOADING_MS)
        notice.first.click()
        until(self.is_framed, "the page has framed the cloud for this window", LOADING_MS)
        until(lambda: picture(self).std() > 0.02, "the scene is drawn", LOADING_MS)

    def _listen(self, line: Any) -> None:
        if line.type in ("error", "warning") and not any(word in line.text for word in HARMLESS):
            self.complaints.append(line.text)

    def row(self, label: str) -> Any:
        """The control with a label."""
        return self.tab.locator(
            f'xpath=//label[normalize-space()="{label}"]/ancestor::div[contains(@class,"Flex-root")][1]'
        )

    def type(self, label: str, value: str, field: int = -1) -> None:
        """Type into a number's box; a slider's is its last one."""
        box = self.row(label).locator("input:not([type=hidden])").nth(field)
        box.fill(value)
        box.press("Tab")

    def choose(self, label: str, option: str) -> None:
        """Choose from a list."""
        self.row(label).locator("input:not([type=hidden])").first.click()
        self.tab.get_by_role("option", name=option, exact=True).click()

    def is_framed(self) -> bool:
        """Whether every point lies in the free part of the window, and the cloud fills much of it."""
        clients = list(self.page.server.get_clients().values())
        canvas = self.tab.locator(SCENE).bounding_box()
        if not clients or canvas is None or not self.is_drawn_by(clients[0], canvas):
            return False
        shape = round(canvas["height"]), round(canvas["width"])
        row, column, _ = self.page.viewpoint.project(self.page.session.latest.cloud.xyz, shape)
        inside = 0 < row.min() < row.max() < shape[0] and 0 < column.min() < column.max() < shape[1]
        fills = max(np.ptp(row) / shape[0], np.ptp(column) / shape[1]) > 0.6
        return bool(inside and fills)

    def is_drawn_by(self, client: Any, canvas: Any) -> bool:
        """Whether the browser has said that it looks from where it was sent, in a window of this size."""
        try:
            camera = client.camera
            shape = camera.image_height, camera.image_width
        except AssertionError:  # it has not said anything yet
            return False
        same_view = np.isclose(camera.fov, self.page.viewpoint.field_of_view, rtol=1e-3)
        return bool(shape == (round(canvas["height"]), round(canvas["width"])) and same_view)

    def tick(self, label: str) -> None:
        """Click a box until it has changed: the panel that holds it may still be moving."""
        box = self.row(label).locator("input[type=checkbox]")
        wanted = not box.is_checked()

        def click() -> None:
            if box.is_checked() != wanted:  # an earlier click may have come late
                box.click(force=True)
            playwright.expect(box).to_be_checked(checked=wanted, timeout=2000)

        until(lambda: _succeeds(click), f"'{label}' is {'' if wanted else 'un'}ticked")

    def open_filters(self) -> None:
        """Unfold the filters, unless another test has done so."""
        if not self.row("clip box").is_visible():
            self.tab.get_by_text("filters", exact=True).click()

    def press(self, button: str) -> None:
        self.tab.get_by_role("button", name=button, exact=True).click()

    def reset_filters(self) -> bool:
        """Whether all points are shown after the button. A browser reports a drag in pieces, of
        which the last may come after it.
        """
        self.press("reset filters")
        self.tab.wait_for_timeout(500)
        return self.number("#points") == 85

    def number(self, place: str) -> int:
        return int(self.tab.locator(place).inner_text())

    def close(self) -> None:
        self.tab.close()
        self.page.close()
        self._thread.join(10)


def until(met: Callable[[], bool], what: str, patience_ms: float = PATIENCE_MS) -> None:
    """Wait for something to become so."""
    deadline = time.monotonic() + patience_ms / 1e3
    while not met():
        assert time.monotonic() < deadline, f"waited in vain until {what}"
        time.sleep(0.05)


def _succeeds(act: Callable[[], Any]) -> bool:
    """Say whether something could be done; the page may just have drawn its place anew."""
    try:
        act()
    except (playwright.Error, AssertionError):
        return False
    return True


@pytest.fixture(scope="module")
def seen(browser: Any) -> Iterator[Seen]:
    opened = Seen(browser, Session(TransientSource("frames <b>.h5", frames())))
    yield opened
    opened.close()


def picture(seen: Seen) -> np.ndarray:
    """What the scene looks like on the page."""
    return imread(io.BytesIO(seen.tab.locator(SCENE).screenshot()))[..., :3]


def test_it_loads(seen: Seen) -> None:
    until(lambda: seen.number("#points") == 85, "all points are shown")
    assert seen.number("#frame-number") == 95
    assert seen.tab.locator("#label").inner_text() == "REPLAY"
    assert "frames <b>.h5" in seen.tab.locator("body").inner_text()  # no file name becomes HTML
    until(lambda: picture(seen).std() > 0.02, "the scene is drawn")
    assert seen.tab.get_by_text("range (m)").is_visible()
    assert seen.tab.title() == "tofclip · frames <b>.h5"
    assert "where you look from is your own" in seen.tab.locator("#shared").inner_text()
    assert seen.tab.get_by_text("10.5 ns").is_visible()  # the time line
    instant = seen.page.session.source.times[95]
    words = seen.tab.locator("#instant").inner_text()
    assert words == f"{1e9 * instant:.2f} ns, range {299792458 * instant / 2:.3f} m"
    whole = picture(seen)
    seen.tick("box")
    until(lambda: bool(np.abs(picture(seen) - whole).max() > 0.2), "the box disappears")
    seen.tick("box")
    until(lambda: seen.tab.locator("img").count() >= 3, "streak, intensity and depth are shown")


@pytest.mark.parametrize("size", [(1024, 700), (1280, 800), (1920, 1080)])
def test_the_cloud_fits_between_the_panels(seen: Seen, size: tuple[int, int]) -> None:
    """Every point lies in the free part of the window, and the cloud fills much of it."""
    seen.tab.set_viewport_size({"width": size[0], "height": size[1]})
    until(seen.is_framed, "the page has framed the cloud for this window")
    canvas = seen.tab.locator(SCENE).bounding_box()
    panel = seen.tab.locator("#label").bounding_box()
    assert canvas["x"] >= 200  # right of the pictures
    assert canvas["x"] + canvas["width"] <= panel["x"]  # left of the controls
    seen.tab.set_viewport_size({"width": 1024, "height": 700})


@pytest.mark.parametrize("seconds", [2.0, pytest.param(10.0, marks=pytest.mark.nightly)])
def test_no_control_moves_while_frames_pass(seen: Seen, seconds: float) -> None:
    seen.press("|<")
    seen.choose("speed", "1/2")
    places = """Array.from(document.querySelectorAll("label, button, input"))
        .filter(e => e.offsetParent && !e.closest("[class*=Slider]"))
        .map(e => e.getBoundingClientRect()).map(r => [r.x, r.y, r.width, r.height])"""
    seen.press("play")
    until(lambda: seen.number("#frame-number") > 2, "the frame advances")
    before, frames_seen = seen.tab.evaluate(places), set()
    ends = time.monotonic() + seconds
    while time.monotonic() < ends:
        assert seen.tab.evaluate(places) == before
        frames_seen.add(seen.number("#frame-number"))
    assert len(frames_seen) > 3
    seen.press("pause")
    seen.choose("speed", "1")
    seen.press(">|")


def test_a_page_that_waits_becomes_the_page_in_the_same_tab(browser: Any) -> None:
    """A raw shot takes seconds: the browser has loaded by then, and says what it waits for."""
    waiting = WaitingPage("shot.tif", "recovering <b>shot.tif")
    tab = browser.new_page(viewport={"width": 1024, "height": 700})
    tab.goto(waiting.address)
    tab.locator("#waiting").wait_for(timeout=LOADING_MS)
    assert tab.locator("#waiting").inner_text() == "recovering <b>shot.tif ..."
    page = Page(Session(PlaneSource()), waiting=waiting)
    thread = threading.Thread(target=page.run, daemon=True)
    thread.start()
    tab.locator("#frame-number").wait_for(timeout=LOADING_MS)
    assert tab.locator("#waiting").count() == 0
    (client,) = page.server.get_clients().values()
    until(lambda: page.viewpoint.is_close_to(look(client)), "the cloud is framed", LOADING_MS)
    tab.close()
    page.close()
    thread.join(10)


def look(client: Any) -> Viewpoint:
    """Where a browser looks from."""
    return Viewpoint(client.camera.position, client.camera.look_at, client.camera.fov)


def test_play_pause_and_step(seen: Seen) -> None:
    seen.press("play")
    until(lambda: 0 < seen.number("#frame-number") < 95, "the frame advances")
    seen.press("pause")
    until(lambda: not seen.page.session.clock.playing, "it stands still")
    seen.press("|<")
    until(lambda: seen.number("#frame-number") == 0, "the first frame is shown")
    seen.press("+10")
    until(lambda: seen.number("#frame-number") == 10, "ten frames further on")
    seen.type("frame", "40")
    until(lambda: seen.number("#frame-number") == 40, "the frame that was typed is shown")
    assert seen.number("#points") == 36  # of the nearer square
    seen.tab.keyboard.press("End")
    until(lambda: seen.number("#points") == 85, "all points are shown again")


def test_recolour(seen: Seen) -> None:
    before = picture(seen)
    seen.choose("colour", "intensity")
    until(
        lambda: "intensity (counts)" in seen.tab.locator("#scale").inner_text(), "the scale says so"
    )
    seen.choose("palette", "inferno")
    until(lambda: bool(np.abs(picture(seen) - before).max() > 0.2), "the colours are others")
    seen.choose("colour", "range")
    until(lambda: "range (m)" in seen.tab.locator("#scale").inner_text(), "they come back")


def test_filter(seen: Seen) -> None:
    seen.open_filters()
    seen.type("range", "1.6", field=1)  # the squares are at 1.59 m and 1.68 m
    until(lambda: seen.number("#points") == 36, "the farther square is left out")
    until(seen.reset_filters, "it is back")


def test_the_clip_box_is_dragged_by_its_corners(seen: Seen) -> None:
    until(lambda: seen.number("#points") == 85, "all points are shown")
    seen.open_filters()
    before = picture(seen)
    seen.tick("clip box")
    scene = seen.page.server.scene
    until(lambda: scene.get_handle_by_name("/clip/low") is not None, "there are handles")
    handle: Any = scene.get_handle_by_name("/clip/low")
    canvas = seen.tab.locator(SCENE).bounding_box()
    # along the arrow that points right, until a part of the nearer square is outside
    arrow = handle.position + np.outer((0.5, 2.5), (handle.scale, 0, 0))
    shape = round(canvas["height"]), round(canvas["width"])
    row, column, _ = seen.page.viewpoint.project(arrow, shape)
    there = np.s_[
        round(row[0]) - 4 : round(row[0]) + 5, round(column[0]) - 4 : round(column[0]) + 5
    ]
    until(lambda: bool(np.ptp(picture(seen)[there] - before[there]) > 0.2), "its arrow is drawn")
    seen.tab.mouse.move(canvas["x"] + column[0], canvas["y"] + row[0])
    seen.tab.mouse.down()
    seen.tab.mouse.move(canvas["x"] + column[1], canvas["y"] + row[1], steps=8)
    seen.tab.mouse.up()
    until(lambda: seen.number("#points") < 85, "what lies outside of the box is left out")
    until(seen.reset_filters, "it is back")
    seen.tick("clip box")
    until(lambda: scene.get_handle_by_name("/clip/low") is None, "the handles are gone")


def test_pick_a_point_and_read_its_waveform(seen: Seen) -> None:
    shown, before = seen.page.session.latest, picture(seen)
    assert shown is not None
    canvas = seen.tab.locator(SCENE).bounding_box()
    assert canvas is not None
    near = shown.cloud.xyz[shown.cloud.range < 1.63].mean(axis=0, keepdims=True)
    row, column, _ = seen.page.viewpoint.project(
        near, (round(canvas["height"]), round(canvas["width"]))
    )
    seen.tab.mouse.click(canvas["x"] + column[0], canvas["y"] + row[0])
    words = seen.tab.locator("#picked")
    until(lambda: "range 1.58" in words.inner_text(), "the point is described")
    assert "pixel row 1" in words.inner_text()
    plot = seen.tab.locator(".uplot canvas")

    def shows_the_return() -> bool:
        if plot.count() != 1:
            return False
        place = plot.bounding_box()
        if place is None or not 0 < place["height"] <= 700 - place["y"]:  # without scrolling
            return False
        taken: list[bytes] = []
        if not _succeeds(lambda: taken.append(plot.screenshot())):
            return False
        drawn = imread(io.BytesIO(taken[0]))
        red = (drawn[..., 0] > 0.6) & (drawn[..., 1] < 0.5)
        return bool(0.002 < red.mean() < 0.2)

    until(shows_the_return, "its waveform is drawn, with the return")
    far = shown.cloud.xyz[shown.cloud.range > 1.63].mean(axis=0, keepdims=True)
    row, column, _ = seen.page.viewpoint.project(
        far, (round(canvas["height"]), round(canvas["width"]))
    )
    seen.tab.mouse.click(canvas["x"] + column[0], canvas["y"] + row[0])
    until(lambda: "distance 0." in words.inner_text(), "the distance of both is shown")
    until(lambda: bool(np.abs(picture(seen) - before).max() > 0.3), "both are marked")
    assert np.abs(picture(seen) - before).mean() < 0.05  # marks are small: two balls and a line


def test_refocus(seen: Seen) -> None:
    seen.choose("time gate", GATE_AROUND_FRAME)
    seen.type("frame", "30")
    until(lambda: seen.number("#points") == 36, "the gate is shown")
    before = seen.page.session.latest
    seen.type("refocus", "1")
    until(lambda: "quick look (linear)" in seen.tab.inner_text("body"), "it says how")
    until(
        lambda: (
            seen.page.session.source.refocus.value == 1.0 and seen.page.session.latest is not before
        ),
        "it is recovered anew",
    )
    after = seen.page.session.latest
    assert before is not None
    assert after is not None
    assert after.pixels is not None
    assert after.pixels[:, 0].mean() > before.pixels[:, 0].mean() + 1
    seen.type("refocus", "0")
    until(lambda: seen.page.session.source.refocus.value == 0, "it is as it was")


def test_screenshot_export_and_bookmark(seen: Seen, tmp_path: Path) -> None:
    with seen.tab.expect_download() as download:
        seen.press("screenshot")
    download.value.save_as(tmp_path / "shot.png")
    drawn = imread(tmp_path / "shot.png")[..., :3]
    assert min(drawn.shape[:2]) > 300
    legend = drawn[-70:]
    assert legend.mean() > 0.8  # on white
    assert np.ptp(legend[:, :, 0] - legend[:, :, 2]) > 0.5  # the colours of the ranges
    assert drawn.std() > 0.01
    with seen.tab.expect_download() as download:
        seen.press("export")
    download.value.save_as(tmp_path / "shown.ply")
    assert len(PointCloud.load(tmp_path / "shown.ply")) == seen.number("#points")
    seen.press("bookmark")
    until(
        lambda: seen.row("view from").locator("input").first.input_value() == "view 1",
        "the view is remembered",
    )
    for preset in ("front", "top", "side", "camera", "start"):
        seen.choose("view from", preset)


def test_k_shows_the_keys(seen: Seen) -> None:
    seen.tab.evaluate("document.activeElement.blur()")  # into a box, a K is typed
    seen.tab.keyboard.press("k")
    seen.tab.get_by_text("play or pause").first.wait_for()
    seen.press("close")


def test_nothing_was_complained_about(seen: Seen) -> None:
    assert seen.complaints == []


def test_a_lost_connection_is_said_in_words(browser: Any) -> None:
    seen = Seen(browser, Session(PlaneSource()))
    words = seen.tab.locator(".tofclip-lost")
    assert not words.is_visible()
    seen.page.close()
    until(words.is_visible, "the page says that no answer came")
    assert words.inner_text().startswith("Connection lost: tofclip view has ended")
    seen.close()


def test_the_pages_of_other_servers_see_nothing(browser: Any) -> None:
    """Not even in the browser that has the cookie, which it sends along to every port."""
    page, second = Page(Session(PlaneSource())), Page(Session(PlaneSource()))
    other = http.server.HTTPServer(("127.0.0.1", 0), EmptyPage)
    threading.Thread(target=other.serve_forever, daemon=True).start()
    context = browser.new_context()
    tab, elsewhere = context.new_page(), f"http://127.0.0.1:{other.server_port}/"
    bare = page.address.partition("?")[0]
    socket_address = bare.replace("http:", "ws:")
    try:
        assert tab.goto(bare, timeout=LOADING_MS).status == 403
        assert tab.goto(f"{page.address}x", timeout=LOADING_MS).status == 403
        for one in (page, second):
            assert tab.goto(one.address, timeout=LOADING_MS).status == 200
        assert tab.goto(bare, timeout=LOADING_MS).status == 200  # the second's cookie is another
        until(lambda: len(page.server.get_clients()) == 1, "the page has its WebSocket", LOADING_MS)
        assert tab.evaluate(OPEN_SOCKET, socket_address)
        assert tab.evaluate("document.cookie") == ""
        tab.goto(elsewhere, timeout=LOADING_MS)
        assert len(context.cookies(elsewhere)) == 2
        assert not tab.evaluate(OPEN_SOCKET, socket_address)
        tab.set_content(f"<iframe src='{bare}'></iframe>")
        until(lambda: tab.frames[1].url == "chrome-error://chromewebdata/", "no frame shows it")
    finally:
        context.close()
        other.shutdown()
        other.server_close()
        page.close()
        second.close()


class EmptyPage(http.server.BaseHTTPRequestHandler):
    """A page of another server of this computer."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


def test_a_volume_as_a_surface(browser: Any) -> None:
    seen = Seen(browser, Session(VolumeSource("ball", volume())))
    try:
        until(lambda: seen.number("#points") > 10, "the maximum projection is shown first")
        assert seen.tab.locator("#what").inner_text() == "maximum projection"
        assert seen.tab.locator("#depth").inner_text() == "of all 21 slices"
        assert seen.tab.locator("#frame-number").count() == 0  # it is not of slice 0
        seen.choose("show as", SLICE_MODE)
        seen.type("slice", "10")
        until(
            lambda: seen.tab.locator("#what").inner_text() == "slice 10 of 21", "the slice is named"
        )
        until(lambda: seen.tab.locator("#depth").inner_text() == "z 0.500 m", "its depth is said")
        seen.choose("show as", SURFACE_MODE)
        seen.type("threshold", "0.6")
        until(lambda: seen.page.session.source.threshold.value == 0.6, "the threshold is set")
        until(lambda: picture(seen).std() > 0.02, "the surface is drawn")
        assert seen.complaints == []
    finally:
        seen.close()
