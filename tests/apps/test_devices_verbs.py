"""tofclip devices and tofclip record, on emulated instruments."""

from pathlib import Path

import pytest

import devices
from devices import registry
from devices.recorder import record_source
from devices.recording.check import verify
from tofclip.plugins import Parts

SIM = "sim+timetag://?seed=1&pace=realtime&rate=1e6"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "run.h5"
    record_source(devices.open(SIM), path, 0.3)
    return path


def find_one():
    return [registry.DiscoveredInstrument("timetag://T9", "a tagger", "asleep")]


def test_listing_needs_no_hardware(shell, monkeypatch):
    found = shell.figures("devices list")
    assert isinstance(found["devices"], list)
    assert {"timetag", "sim+timetag", "file"} <= set(found["kinds"])
    assert "sim+timetag" in shell("devices list").out
    one = Parts("tofclip.finders", "finder", {"one": f"{__name__}:find_one"})
    monkeypatch.setattr(registry, "FINDERS", one)
    assert "timetag://T9" in shell("devices list").out
    note = {"uri": "timetag://T9", "instrument": "a tagger", "note": "asleep"}
    assert shell.figures("devices list")["devices"] == [note]


def test_information(shell):
    live = shell.figures(f"devices info '{SIM}'")
    assert (live["instrument"], live["is_live"]) == ("FX2 time tagger", True)
    assert live["clock_hz"] == 1 / live["calibration_tick_s"] == 128e6
    replayed = shell.figures("devices info file://{recording}")
    assert shell.figures("devices info {recording}") == replayed
    assert replayed == {**live, "is_live": False, "is_seekable": True}
    # info does not read the bytes
    found = shell.figures("info {recording}")
    assert (found["kind"], found["attributes"]["codec"]) == ("recording", "timetag")
    assert found["children"]["calibration"]["attributes"]["tick_s"] == 1 / 128e6
    assert "fields" not in found


def test_trying_out(shell):
    found = shell.figures(f"devices test '{SIM}' --seconds 0.4")
    assert {"timeouts", "reconnects"} <= set(found)
    assert found["records"] == found["delivered"] > 300_000
    # A million records of 6 bytes a second, and less on a machine that stood still meanwhile.
    assert 0 < found["bytes_per_second"] <= 1.25 * 6e6
    received = found["bytes_per_second"] * found["seconds"]
    assert received == pytest.approx(6 * found["records"], rel=0.25)
    assert found["lost_device"] == found["dropped_host"] == found["malformed"] == 0
    assert "bytes per second" in shell(f"devices test '{SIM}' --seconds 0.1").out


def test_recording_and_verifying(shell):
    done = shell.figures(f"record '{SIM}' --out run.h5 --seconds 0.3")
    found = shell.figures("devices verify run.h5")
    assert (found["sound"], found["complete"]) == (True, True)
    assert found["records"] == done["delivered"] > 0
    assert found["bytes"] == done["bytes"] == 6 * done["records"]
    shell.refuses("record file://run.h5 --out run.h5", "is an input too")
    assert "wrote again.h5" in shell("record file://run.h5 --out again.h5").out
    assert verify(Path("again.h5")).records == done["delivered"]


def test_damage_is_named_and_repaired(shell, recording):
    content = bytearray(recording.read_bytes())
    content[len(content) // 2] ^= 0xFF
    Path("run.h5").write_bytes(content)
    said = "tofclip: error: run.h5: is damaged; tofclip devices repair makes a sound copy\n"
    assert shell.figures("devices verify run.h5", status=2, said=said)["damaged_blocks"] == 1
    assert "wrote sound.h5" in shell("devices repair run.h5 --out sound.h5").out
    assert shell("devices verify sound.h5").status == 0


def test_what_was_recorded_is_recovered(shell, tmp_path):
    """By the name of the file, as every other verb takes it."""
    made = tmp_path / "shots.h5"
    record_source(devices.open("sim+remoteex://?seed=1&scene=small&frames=2"), made, 2.0)
    found = shell.figures(f"recover {made} --method linear --out frames.h5")
    assert found["image_shape"] == [32, 32]
