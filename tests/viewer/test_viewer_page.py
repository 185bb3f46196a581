"""The page in a browser: what a user sees, clicks and takes along."""

import contextlib
import http.server
import io
import shutil
import threading
import time

import numpy as np
import pytest
import viser
from matplotlib.image import imread
from viewer_scenes import PlaneSource, frames, volume

from apps.viewer.page import LOOPBACK, Page, PageDoor
from apps.viewer.session import Session, read_state
from apps.viewer.sources import (
    GATE_AROUND_FRAME,
    LINEAR_NOTE,
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
PATIENCE_MS = 60_000  # a software renderer on a busy machine draws twice a second
WINDOW = {"width": 1024, "height": 700}
SCENE = "canvas[data-engine]"
# Says whether a page may open a WebSocket and receives something.
OPEN_SOCKET = """place => new Promise(decide => {
    const socket = new WebSocket(place, ["viser-v" + "VERSION"]);
    socket.onmessage = () => decide(true);
    socket.onclose = () => decide(false);
})""".replace("VERSION", viser.__version__)
# Where the controls are.
PLACES = """Array.from(document.querySelectorAll("label, button, input"))
    .filter(e => e.offsetParent && !e.closest("[class*=Slider]"))
    .map(e => e.getBoundingClientRect()).map(r => [r.x, r.y, r.width, r.height])"""
HARMLESS = ("THREE.Clock", "GPU stall", "GroupMarkerNotSet", "Automatic fallback to software WebGL")


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("there is no chromium here (on Debian: apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS.split())
        yield opened
        opened.close()


def until(met, what, patience_ms=PATIENCE_MS):
    """Wait for something to become so."""
    deadline = time.monotonic() + patience_ms / 1e3
    while not met():
        assert time.monotonic() < deadline, f"waited in vain until {what}"
        time.sleep(0.05)


def succeeds(act):
    """Say whether something could be done; the page may just have drawn its place anew."""
    try:
        act()
    except (playwright.Error, AssertionError):
        return False
    return True


@contextlib.contextmanager
def serve(source, waiting=None):
    """A page of a source, while it is served."""
    page = Page(Session(source), waiting=waiting)
    thread = threading.Thread(target=page.run, daemon=True)
    thread.start()
    yield page
    page.close()
    thread.join(10)


class Seen:
    """A served page and the tab that looks at it."""

    def __init__(self, browser, page):
        self.page, self.session, self.complaints = page, page.session, []
        self.tab = browser.new_page(viewport=WINDOW)
        self.tab.set_default_timeout(PATIENCE_MS)
        self.tab.on("console", self._listen)
        self.tab.on("pageerror", lambda fault: self.complaints.append(str(fault)))
        # A slow renderer would reduce the resolution, and say another size of the window.
        self.tab.goto(f"{page.address}&fixedDpr=1")
        self.tab.locator("#label").wait_for(timeout=LOADING_MS)
        # that the renderer is a slow one
        notice = self.tab.locator("[class*=Notification-closeButton]")
        notice.first.wait_for(timeout=LOADING_MS)
        notice.first.click()
        until(self.is_framed, "the page has framed the cloud for this window", LOADING_MS)
        until(lambda: self.picture().std() > 0.02, "the scene is drawn", LOADING_MS)

    def _listen(self, line):
        if line.type in ("error", "warning") and not any(word in line.text for word in HARMLESS):
            self.complaints.append(line.text)

    def row(self, label):
        """The control with a label."""
        return self.tab.locator(
            f'xpath=//label[normalize-space()="{label}"]/ancestor::div[contains(@class,"Flex-root")][1]'
        )

    def type(self, label, value, field=-1):
        """Type into a number's box; a slider's is its last one."""
        box = self.row(label).locator("input:not([type=hidden])").nth(field)
        box.fill(value)
        box.press("Tab")

    def choose(self, label, option):
        """Choose from a list."""
        self.row(label).locator("input:not([type=hidden])").first.click()
        self.tab.get_by_role("option", name=option, exact=True).click()

    def press(self, button):
        self.tab.get_by_role("button", name=button, exact=True).click()

    def tick(self, label):
        """Click a box until it has changed: the panel that holds it may still be moving."""
        box = self.row(label).locator("input[type=checkbox]")
        wanted = not box.is_checked()

        def click():
            if box.is_checked() != wanted:  # an earlier click may have come late
                box.click(force=True)
            playwright.expect(box).to_be_checked(checked=wanted, timeout=2000)

        until(lambda: succeeds(click), f"'{label}' is {'' if wanted else 'un'}ticked")

    def save(self, button, path):
        """Press a button that has a file downloaded."""
        with self.tab.expect_download() as download:
            self.press(button)
        download.value.save_as(path)
        return path

    def text(self, place):
        return str(self.tab.locator(place).inner_text())

    def number(self, place):
        return int(self.text(place))

    def until_number(self, place, number):
        until(lambda: self.number(place) == number, f"{place} says {number}")

    def until_text(self, place, words):
        until(lambda: words in self.text(place), f"{place} says '{words}'")

    def until_other(self, before, difference=0.2):
        until(lambda: np.abs(self.picture() - before).max() > difference, "the picture changes")

    def picture(self):
        """What the scene looks like on the page."""
        return imread(io.BytesIO(self.tab.locator(SCENE).screenshot()))[..., :3]

    def find(self, xyz):
        """Row and column of points in the picture of the scene, and its shape."""
        canvas = self.tab.locator(SCENE).bounding_box()
        shape = round(canvas["height"]), round(canvas["width"])
        row, column, _ = self.page.viewpoint.project(xyz, shape)
        return row, column, shape

    def place(self, row, column):
        """Where a pixel of the scene lies in the window, from the left and the top."""
        canvas = self.tab.locator(SCENE).bounding_box()
        return canvas["x"] + column, canvas["y"] + row

    def is_framed(self):
        """Whether the browser looks from where it was sent, every point lies in the free part of the
        window, and the cloud fills much of it.
        """
        clients, canvas = (
            list(self.page.server.get_clients().values()),
            self.tab.locator(SCENE).bounding_box(),
        )
        if not clients or canvas is None:
            return False
        row, column, shape = self.find(self.session.latest.cloud.xyz)
        try:
            camera = clients[0].camera
            if (camera.image_height, camera.image_width) != shape:
                return False
        except AssertionError:  # it has not said anything yet
            return False
        same_view = np.isclose(camera.fov, self.page.viewpoint.field_of_view, rtol=1e-3)
        inside = 0 < row.min() < row.max() < shape[0] and 0 < column.min() < column.max() < shape[1]
        fills = max(np.ptp(row) / shape[0], np.ptp(column) / shape[1]) > 0.6
        return bool(same_view and inside and fills)

    def unfold(self, folder, label):
        """Unfold a folder until a control in it is seen: a click on what moves is lost."""

        def click():
            if not self.row(label).is_visible():
                self.tab.get_by_text(folder, exact=True).click()
                self.tab.wait_for_timeout(1000)
            return bool(self.row(label).is_visible())

        until(click, f"'{folder}' is unfolded")

    def reset_filters(self):
        """Whether all points are shown after the button. A browser reports a drag in pieces, of
        which the last may come after it.
        """
        self.press("reset filters")
        self.tab.wait_for_timeout(500)
        return self.number("#points") == 85


@pytest.fixture(scope="module")
def seen(browser):
    with serve(TransientSource("frames <b>.h5", frames())) as page:
        opened = Seen(browser, page)
        yield opened
        opened.tab.close()


def test_it_loads(seen):
    seen.until_number("#points", 85)
    assert seen.number("#frame-number") == 96
    assert seen.text("#label") == "REPLAY"
    assert "frames <b>.h5" in seen.text("body")  # no file name becomes HTML
    assert seen.tab.title() == "tofclip · frames <b>.h5"
    assert "where you look from is your own" in seen.text("#shared")
    for words in ("range (m)", "10.5 ns"):  # the scale and the time line
        assert seen.tab.get_by_text(words).is_visible()
    instant = seen.session.source.times[95]
    expected = f"{1e9 * instant:.2f} ns, range {299792458 * instant / 2:.3f} m"
    assert seen.text("#instant") == expected
    whole = seen.picture()
    seen.tick("box")
    seen.until_other(whole)
    seen.tick("box")
    until(lambda: seen.tab.locator("img").count() >= 3, "streak, intensity and depth are shown")


@pytest.mark.parametrize("size", [(1024, 700), (1280, 800), (1920, 1080)])
def test_the_cloud_fits_between_the_panels(seen, size):
    seen.tab.set_viewport_size({"width": size[0], "height": size[1]})
    until(seen.is_framed, "the page has framed the cloud for this window")
    canvas = seen.tab.locator(SCENE).bounding_box()
    assert canvas["x"] >= 200  # right of the pictures
    # left of the controls
    assert canvas["x"] + canvas["width"] <= seen.tab.locator("#label").bounding_box()["x"]
    seen.tab.set_viewport_size(WINDOW)


@pytest.mark.parametrize("seconds", [2.0, pytest.param(10.0, marks=pytest.mark.nightly)])
def test_no_control_moves_while_frames_pass(seen, seconds):
    seen.press("|<")
    seen.choose("speed", "1/2")
    seen.press("play")
    until(lambda: seen.number("#frame-number") > 2, "the frame advances")
    before, frames_seen = seen.tab.evaluate(PLACES), set()
    ends = time.monotonic() + seconds
    while time.monotonic() < ends:
        assert seen.tab.evaluate(PLACES) == before
        frames_seen.add(seen.number("#frame-number"))
    assert len(frames_seen) > 3
    seen.press("pause")
    seen.choose("speed", "1")
    seen.press(">|")


def test_play_pause_and_step(seen):
    seen.press("play")
    until(lambda: 1 < seen.number("#frame-number") < 96, "the frame advances")
    seen.press("pause")
    until(lambda: not seen.session.clock.playing, "it stands still")
    for button, frame in (("|<", 1), ("+10", 11)):
        seen.press(button)
        seen.until_number("#frame-number", frame)
    seen.type("frame", "41")
    seen.until_number("#frame-number", 41)
    assert seen.number("#points") == 36  # of the nearer square
    seen.tab.keyboard.press("End")
    seen.until_number("#points", 85)


def test_recolour(seen):
    before = seen.picture()
    seen.choose("colour", "intensity")
    seen.until_text("#scale", "intensity (counts)")
    seen.choose("palette", "inferno")
    seen.until_other(before)
    seen.choose("colour", "range")
    seen.until_text("#scale", "range (m)")


def test_filter(seen):
    seen.unfold("filters", "clip box")
    seen.type("keep from, to", "1.6", field=1)  # the squares are at 1.59 m and 1.68 m
    seen.until_number("#points", 36)
    until(seen.reset_filters, "it is back")


def test_a_plane_is_fitted_and_a_section_lies_in_it(seen):
    """The farther square, of 49 points, is a plane but for the noise of its ranges."""
    seen.unfold("section and plane", "section")
    seen.tick("section")
    seen.type("thickness", "10")
    seen.press("fit plane")
    seen.until_text("#plane", "of 85 points, residual")
    until(lambda: seen.number("#points") == 49, "only the square is shown")
    seen.tick("section")
    until(lambda: seen.number("#points") == 85, "all is shown again")


def test_the_clip_box_is_dragged_by_its_corners(seen):
    seen.until_number("#points", 85)
    seen.unfold("filters", "clip box")
    before = seen.picture()
    seen.tick("clip box")
    scene = seen.page.server.scene
    until(lambda: scene.get_handle_by_name("/clip/low") is not None, "there are handles")
    handle = scene.get_handle_by_name("/clip/low")
    # along the arrow that points right, until a part of the nearer square is outside
    row, column, _ = seen.find(handle.position + np.outer((0.5, 2.5), (handle.scale, 0, 0)))
    there = tuple(slice(round(middle) - 4, round(middle) + 5) for middle in (row[0], column[0]))
    until(lambda: np.ptp(seen.picture()[there] - before[there]) > 0.2, "its arrow is drawn")
    seen.tab.mouse.move(*seen.place(row[0], column[0]))
    seen.tab.mouse.down()
    seen.tab.mouse.move(*seen.place(row[0], column[1]), steps=8)
    seen.tab.mouse.up()
    until(lambda: seen.number("#points") < 85, "what lies outside of the box is left out")
    until(seen.reset_filters, "it is back")
    seen.tick("clip box")
    until(lambda: scene.get_handle_by_name("/clip/low") is None, "the handles are gone")


def test_pick_a_point_and_read_its_waveform(seen):
    shown, before = seen.session.latest, seen.picture()

    def click(points):
        row, column, _ = seen.find(shown.cloud.xyz[points].mean(axis=0, keepdims=True))
        seen.tab.mouse.click(*seen.place(row[0], column[0]))

    click(shown.cloud.range < 1.63)
    seen.until_text("#picked", "range 1.58")
    assert "pixel row" in seen.text("#picked")
    plot = seen.tab.locator(".uplot canvas")

    def shows_the_return():
        if plot.count() != 1:
            return False
        place = plot.bounding_box()
        if place is None or not 0 < place["height"] <= 700 - place["y"]:  # without scrolling
            return False
        taken = []
        if not succeeds(lambda: taken.append(plot.screenshot())):
            return False
        drawn = imread(io.BytesIO(taken[0]))
        red = (drawn[..., 0] > 0.6) & (drawn[..., 1] < 0.5)
        return bool(0.002 < red.mean() < 0.2)

    until(shows_the_return, "its waveform is drawn, with the return")
    click(shown.cloud.range > 1.63)
    seen.until_text("#picked", "distance 0.")
    seen.until_other(before, 0.3)
    # marks are small: two balls and a line
    assert np.abs(seen.picture() - before).mean() < 0.05


def test_refocus(seen):
    seen.choose("time gate", GATE_AROUND_FRAME)
    seen.type("frame", "31")
    seen.until_number("#points", 36)
    before = seen.session.latest
    seen.type("refocus", "1")
    until(lambda: seen.session.latest is not before, "it is refocused")
    assert seen.session.source.refocus.value == 1.0
    after = seen.session.latest
    assert not np.array_equal(after.pixels, before.pixels)
    seen.type("refocus", "0")
    until(lambda: seen.session.source.refocus.value == 0, "it is as it was")

    def measure_panel():
        first, last = (seen.row(one).bounding_box() for one in ("frame", "point size"))
        return float(last["y"] - first["y"])

    height = measure_panel()
    seen.choose("method", "linear")
    seen.until_text(".tofclip-notes", LINEAR_NOTE)
    assert measure_panel() == pytest.approx(height, abs=0.5)  # a note pushes nothing down
    seen.choose("method", "l1")


def test_screenshot_export_and_bookmark(seen, tmp_path):
    drawn = imread(seen.save("screenshot", tmp_path / "shot.png"))[..., :3]
    assert min(drawn.shape[:2]) > 300
    legend = drawn[-70:]
    assert legend.mean() > 0.8  # on white
    assert np.ptp(legend[:, :, 0] - legend[:, :, 2]) > 0.5  # the colours of the ranges
    assert drawn.std() > 0.01
    state = read_state(seen.save("save state", tmp_path / "state.json"))
    assert state["frame"] == seen.number("#frame-number")
    exported = PointCloud.load(seen.save("export", tmp_path / "shown.ply"))
    assert len(exported) == seen.number("#points")
    seen.press("bookmark")
    field = seen.row("view from").locator("input").first
    field.click()
    seen.tab.get_by_role("option", name="view 1", exact=True).click()
    until(lambda: field.input_value() == "...", "every browser looks from where it likes")
    for preset in ("front", "top", "side", "camera", "start"):
        seen.choose("view from", preset)


def test_k_shows_the_keys_and_nothing_was_complained_about(seen):
    seen.tab.evaluate("document.activeElement.blur()")  # into a box, a K is typed
    seen.tab.keyboard.press("k")
    seen.tab.get_by_text("play or pause").first.wait_for()
    seen.press("close")
    assert seen.complaints == []


def test_on_a_phone_the_panel_is_folded_and_the_scene_framed(browser, seen):
    tab = browser.new_page(viewport={"width": 390, "height": 800})
    tab.goto(seen.page.address)
    tab.locator("#label").wait_for(state="attached", timeout=LOADING_MS)
    handle = tab.get_by_text("tofclip · frames")
    until(lambda: handle.bounding_box()["y"] > 700, "the panel is folded", LOADING_MS)
    handle.click()
    until(lambda: handle.bounding_box()["y"] < 700, "it unfolds")
    tab.close()
    until(lambda: len(seen.page.server.get_clients()) == 1, "it has gone")


def test_a_page_that_waits_becomes_the_page_in_the_same_tab_until_it_ends(browser):
    """A raw shot takes seconds: the browser has loaded by then, and says what it waits for."""
    door = PageDoor(LOOPBACK, no_browser=True)
    door.open_waiting("shot.tif", "recovering <b>shot.tif")
    tab = browser.new_page(viewport=WINDOW)
    tab.goto(door.waiting[1])
    tab.locator("#waiting").wait_for(timeout=LOADING_MS)
    assert tab.locator("#waiting").inner_text() == "recovering <b>shot.tif ..."
    lost = tab.locator(".tofclip-lost")
    with serve(PlaneSource(), door.waiting) as page:
        tab.locator("#frame-number").wait_for(timeout=LOADING_MS)
        assert tab.locator("#waiting").count() == 0
        (client,) = page.server.get_clients().values()

        def is_framed():
            camera = client.camera
            there = Viewpoint(camera.position, camera.look_at, camera.fov)
            return page.viewpoint.is_close_to(there)

        until(is_framed, "the cloud is framed", LOADING_MS)
        assert not lost.is_visible()
    until(lost.is_visible, "the page says that no answer came")
    assert lost.inner_text().startswith("Connection lost: tofclip view has ended")
    tab.close()


class EmptyPage(http.server.BaseHTTPRequestHandler):
    """A page of another server of this computer."""

    def do_GET(self):
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_):
        """Say nothing."""


def test_the_pages_of_other_servers_see_nothing(browser):
    """Not even in the browser that has the cookie, which it sends along to every port."""
    with contextlib.ExitStack() as stack:
        page, second = (Page(Session(PlaneSource())) for _ in range(2))
        other = stack.enter_context(http.server.HTTPServer(("127.0.0.1", 0), EmptyPage))
        threading.Thread(target=other.serve_forever, daemon=True).start()
        context = browser.new_context()
        for end in (other.shutdown, page.close, second.close, context.close):
            stack.callback(end)
        tab, elsewhere = context.new_page(), f"http://127.0.0.1:{other.server_port}/"
        bare = page.address.partition("?")[0]
        socket_address = bare.replace("http:", "ws:")
        for address, status in (
            (bare, 403),
            (f"{page.address}x", 403),
            (page.address, 200),
            (second.address, 200),
            (bare, 200),  # the second's cookie is another
        ):
            assert tab.goto(address, timeout=LOADING_MS).status == status
        until(lambda: len(page.server.get_clients()) == 1, "the page has its WebSocket", LOADING_MS)
        assert tab.evaluate(OPEN_SOCKET, socket_address)
        assert tab.evaluate("document.cookie") == ""
        tab.goto(elsewhere, timeout=LOADING_MS)
        assert len(context.cookies(elsewhere)) == 2
        assert not tab.evaluate(OPEN_SOCKET, socket_address)
        tab.set_content(f"<iframe src='{bare}'></iframe>")
        until(lambda: tab.frames[1].url == "chrome-error://chromewebdata/", "no frame shows it")


@pytest.mark.nightly
def test_a_volume_as_a_surface(browser):
    with serve(VolumeSource("ball", volume())) as page:
        seen = Seen(browser, page)
        until(lambda: seen.number("#points") > 10, "the maximum projection is shown first")
        assert seen.text("#what") == "maximum projection"
        assert seen.text("#depth") == "of all 21 slices"
        assert seen.tab.locator("#frame-number").count() == 0  # it is not of slice 0
        seen.choose("show as", SLICE_MODE)
        seen.type("slice", "10")
        seen.until_text("#what", "slice 10 of 21")
        seen.until_text("#depth", "z 0.480 m")
        seen.choose("show as", SURFACE_MODE)
        seen.type("threshold", "0.6")
        until(lambda: page.session.source.threshold.value == 0.6, "the threshold is set")
        until(lambda: seen.picture().std() > 0.02, "the surface is drawn")
        assert seen.complaints == []
        seen.tab.close()
