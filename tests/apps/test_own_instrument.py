"""An instrument of one's own, in one file, by every verb; and what its histograms become."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest
import tcp_histograms
from tcp_histograms import BIN_S, BINS, HEADER, PICTURE_BYTES, SIDE

import devices
from devices import registry
from devices.emulation.harness import HOST, LoopbackServer
from tofclip.camera import Camera
from tofclip.lidar import PointCloud
from tofclip.lidar.ros import MESSAGE_TYPE, read_bag
from tofclip.units import SPEED_OF_LIGHT

SIGNAL, BACKGROUND, PULSE_S = 20.0, 0.02, 300e-12  # photons, photons a bin, standard deviation
BIN_M = BIN_S * SPEED_OF_LIGHT / 2


def draw_scene(shift_m=0.0):
    """Range of each pixel, m: a slanted wall, and a box in front of it."""
    y, x = np.indices((SIDE, SIDE))
    ranges = 3.0 + 0.01 * x + 0.005 * y
    ranges[8:20, 10:22] = 1.5 + shift_m
    return ranges


def draw_histograms(ranges, seed):
    """Photons (y, x, bins)."""
    times = BIN_S * (np.arange(BINS) + 0.5)
    off = times - 2 * ranges[..., np.newaxis] / SPEED_OF_LIGHT
    light = np.exp(-((off / PULSE_S) ** 2) / 2)
    light *= SIGNAL / light.sum(axis=-1, keepdims=True)
    return np.random.default_rng(seed).poisson(light + BACKGROUND).astype("<u2")


class HistogramServer:
    """Sends pictures, `rate` a second, to who connects; number 3 is never sent."""

    def __init__(self, ranges, rate=25.0):
        # A busy machine takes one of many: that none comes twice, their noise is another each time.
        self.drawn = [draw_histograms(ranges, seed).tobytes() for seed in range(64)]
        self.rate, self._closing = rate, threading.Event()
        self._server = LoopbackServer(self._serve)
        self.address = f"histograms://{HOST}:{self._server.port}"

    def _serve(self, connection):
        began, number = time.monotonic(), 0
        while not self._closing.wait(max(0.0, began + number / self.rate - time.monotonic())):
            if number != 3:
                data = self.drawn[number % len(self.drawn)]
                connection.send(HEADER.pack(number, PICTURE_BYTES) + data)
            number += 1

    def close(self):
        self._closing.set()
        self._server.close()


@pytest.fixture
def address(monkeypatch):
    monkeypatch.setattr(registry.SOURCES, "registered", {})
    devices.register_source("histograms", tcp_histograms.open_histograms)
    server = HistogramServer(draw_scene())
    yield server.address
    server.close()


def list_errors(cloud):
    """Error of each point's range over its deviation; a point's pixel follows from where it looks."""
    camera = Camera.pinhole((SIDE, SIDE), 40.0)
    x, y = (
        np.rint(SIDE // 2 + 40.0 * cloud.xyz[:, k] / cloud.xyz[:, 2]).astype(int) for k in (0, 1)
    )
    assert camera.image_shape == (SIDE, SIDE)
    return (cloud.range - draw_scene()[y, x]) / cloud.range_sigma


def test_one_file_and_every_verb(shell, address):
    assert len(Path(tcp_histograms.__file__).read_text().splitlines()) <= 120
    live = shell.figures(f"stream {address} --shots 12 --out live")
    assert (live["method"], live["clouds"]) == ("photons", 12)
    assert live["acquired"] == live["delivered"] + live["dropped"] + live["failed"]
    assert live["dropped_device"] == 1  # the third, which was never sent
    clouds = [PointCloud.load(one) for one in sorted(Path("live").iterdir())]
    assert all(len(cloud) > 0.95 * SIDE**2 for cloud in clouds)
    for cloud in (clouds[0], clouds[-1]):
        z = list_errors(cloud)
        # a few of a thousand are false, and errors of 1000 points spread by 2 %
        assert np.median(np.abs(z)) / 0.6745 == pytest.approx(1, abs=0.15)
    # photons of many shots are summed where nothing moves
    assert np.median(clouds[-1].range_sigma) < 0.4 * np.median(clouds[0].range_sigma)
    assert shell(f"record {address} --out run.h5 --seconds 1").status == 0
    verified = shell.figures("devices verify run.h5")
    played = shell.figures("stream run.h5 --out played")
    assert played["acquired"] == played["delivered"] == verified["records"]
    assert shell.figures("view run.h5 --png view.png")["points"] > 0.95 * SIDE**2
    shell.figures("lidar photons run.h5 --out range.npz")
    assert shell.figures("info range.npz")["kind"] == "range image"
    assert shell.figures("view range.npz --png range.png")["points"] > 0.95 * SIDE**2
    before = time.time_ns()
    shell.figures(f"stream {address} --shots 3 --out live.mcap --topic /kit/points --frame-id kit")
    stamps = [one.stamp_ns for one in read_bag("live.mcap")]
    assert before < stamps[0] < stamps[1] < stamps[2] < time.time_ns()
    held = shell.figures("info live.mcap")
    assert held["topics"] == {"/kit/points": {"type": MESSAGE_TYPE, "messages": 3}}
    assert held["seconds"] == pytest.approx((stamps[2] - stamps[0]) / 1e9, abs=1e-6)
    assert shell.figures("lidar bag live.mcap --out back --topic /kit/points")["clouds"] == 3
    for verb in ("stream run.h5", "view run.h5 --png tv.png"):
        assert "leave out the method" in shell(f"{verb} --method tv").err
    alone = shell.figures("lidar bag back/cloud_000002.ply --out alone.mcap")
    assert alone["points"] > 0.95 * SIDE**2
