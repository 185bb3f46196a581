"""Signals that end a recorder, at random moments: the camera's gain goes down, the file is whole."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from devices.emulation.harness import HOST
from devices.emulation.remoteex import EmulatedStreakCamera
from devices.emulation.scenes import EmulatedLight, simulate_line_light
from devices.recording.check import verify

SCRIPT = Path(__file__).with_name("signalled_recorders.py")
INTERRUPTED = 130


@pytest.mark.parametrize("count", [3, pytest.param(60, marks=pytest.mark.nightly)])
def test_whenever_a_signal_comes_the_gain_goes_down(tmp_path: Path, count: int) -> None:
    camera = EmulatedStreakCamera(EmulatedLight.of(simulate_line_light(), 1), 50)
    port, data_port = camera.ports
    address = f"remoteex://{HOST}:{port}?data_port={data_port}&mcp_gain=40"
    words = [sys.executable, str(SCRIPT), str(tmp_path), str(count), "7", address]
    places = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": places}
    ended = 0
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as script:
        assert script.stdin is not None
        assert script.stdout is not None
        for line in script.stdout:
            name, file, status, seconds = line.split()
            assert (int(status), float(seconds) < 10) == (INTERRUPTED, True), line
            assert (camera.gain, camera.is_running) == ("0", False), line
            path = tmp_path / file
            if path.exists():  # it came so far
                found = verify(path)
                assert (found.is_sound, found.fault) == (True, "interrupted"), name
                assert found.records == found.stats["delivered"]
            ended += 1
            script.stdin.write("next\n")
            script.stdin.flush()
    assert (ended, script.returncode) == (count, 0)
    camera.close()
