"""Photographs of the viewer's page in a headless chromium, for the gallery. Needs playwright."""

from __future__ import annotations

import contextlib
import shutil
import threading
import time
from pathlib import Path

from playwright.sync_api import sync_playwright

from apps.occlusion.experiment import ExperimentSettings, make_walking_scene
from apps.occlusion.live import WalkSource
from apps.viewer.page import Page
from apps.viewer.session import Session
from apps.viewer.source_factory import open_source

FLAGS = "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic"
WINDOW = {"width": 1280, "height": 800}
WALKED_STEPS = 6  # to where the person is behind the bush
PATIENCE_S = 120.0
SETTLE_S = 4.0  # s for a slow renderer's last frames


def photograph_page(name: str, out: str | Path) -> None:
    """Write a picture of the page as it looks at a source.

    Parameters
    ----------
    name : str
        What `tofclip view` takes; ``--live`` for the person behind a bush.
    out : path-like
        PNG.
    """
    walk = ExperimentSettings(side_px=64, samples=1)
    live = name == "--live"
    source = WalkSource(make_walking_scene("bush"), walk) if live else open_source(name)
    with contextlib.closing(source), contextlib.closing(Page(Session(source))) as page:
        threading.Thread(target=page.run, daemon=True).start()
        until = time.monotonic() + PATIENCE_S
        while live and len(source) <= WALKED_STEPS and time.monotonic() < until:
            time.sleep(0.1)
        with sync_playwright() as driver:
            browser = driver.chromium.launch(
                executable_path=shutil.which("chromium"), args=FLAGS.split()
            )
            tab = browser.new_page(viewport=WINDOW)
            tab.set_default_timeout(1e3 * PATIENCE_S)
            tab.goto(page.address)
            tab.locator("#frame-number").wait_for()
            notice = tab.locator("[class*=Notification-closeButton]").first
            notice.wait_for()  # that the renderer is a slow one
            notice.click()
            tab.locator("img").nth(1).wait_for()
            tab.wait_for_timeout(1e3 * SETTLE_S)
            tab.screenshot(path=out)
            browser.close()
