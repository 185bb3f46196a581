"""Histograms that come live: sums of what drifts are true, and so are gates in coarse steps."""

import numpy as np
import pytest
from scipy.special import ndtr

from devices.frames import GatedOptions
from devices.transients import _make_gate_response
from tofclip.lidar import Pulse
from tofclip.lidar.photons import PhotonCube
from tofclip.sequences import make_pipeline
from tofclip.units import SPEED_OF_LIGHT

ROWS, COLUMNS = np.indices((32, 32))
BIN, SIGMA = 250e-12, 300e-12  # s


def take_shot(ranges, signal, seed):
    edges = BIN * np.arange(129)[:, np.newaxis, np.newaxis]
    light = signal * np.diff(ndtr((edges - 2 * ranges / SPEED_OF_LIGHT) / SIGMA), axis=0) + 0.02
    times = BIN * (np.arange(128) + 0.5)
    counts = np.random.default_rng(seed).poisson(light)
    return PhotonCube(counts, times, pulse=Pulse.gaussian(SIGMA * np.sqrt(8 * np.log(2))))


def find_returns(pipeline, shot):
    return pipeline.search(pipeline.recover(pipeline.rectify(shot)))


def compute_z(found, truth):
    ratio = (found.range - truth[found.y, found.x]) / found.confidence
    return float(np.sqrt(np.mean(np.clip(ratio, -6, 6) ** 2)))


@pytest.mark.parametrize(
    ("signal", "speed_mm"), [(200.0, 0.0), (20.0, 1.0), (200.0, 1.0), (20.0, 10.0), (200.0, 10.0)]
)
def test_what_drifts_is_where_it_is_now(signal, speed_mm):
    """Sums of 16 shots were late by 2 to 17 deviations. 16 clouds of 1000 pixels, which share what
    they say of the speed: z scatters by 0.05.
    """
    pipeline, z, sigma = None, [], []
    for number in range(24):
        ranges = 2 + 0.01 * COLUMNS + 0.005 * ROWS + 1e-3 * speed_mm * number
        shot = take_shot(ranges, signal, [number, 5])
        pipeline = pipeline or make_pipeline(shot)
        found = find_returns(pipeline, shot)
        assert len(found.range) > 1000
        z.append(compute_z(found, ranges))
        sigma.append(np.median(found.confidence))
    assert 0.85 < np.mean(z[8:]) < 1.2
    assert speed_mm > 1 or np.mean(sigma[8:]) < 0.35 * sigma[0]


@pytest.mark.parametrize(("step_ps", "width_ns"), [(100, 3), (640, 3), (1500, 5)])
@pytest.mark.parametrize("photons", [20.0, 2000.0])
def test_gates_in_coarse_steps_say_what_they_do_not_see(step_ps, width_ns, photons):
    """At steps of 96 mm a millimetre was said of errors of 14; and light that every pixel sees long
    was taken for background.
    """
    scan = {"gate_steps": int(20e3 // step_ps), "gate_step_ps": step_ps, "gate_width_ns": width_ns}
    gate = GatedOptions(mode="gated", gate_offset_ps=3000.0, **scan)
    delays = 6e-9 + 137e-12 * COLUMNS + 83e-12 * ROWS
    late = (delays - gate.opening_times[:, np.newaxis, np.newaxis]) / 1e-10
    light = photons * (ndtr(late) - ndtr(late - width_ns * 10)) + 0.004 * photons * width_ns
    counts = np.random.default_rng(0).poisson(light)
    pulse = _make_gate_response(gate.gate_record, gate.opening_times)
    shot = PhotonCube(counts, gate.opening_times, pulse=pulse, sampled=True)
    found = find_returns(make_pipeline(shot), shot)
    assert len(found.range) > 1000
    assert 0.7 < compute_z(found, delays * SPEED_OF_LIGHT / 2) < 1.3
