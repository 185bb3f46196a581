"""tofclip devices and tofclip record, on emulated instruments."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from small_instrument import Run

import tofclip
from devices.recording.check import verify

SIM = "sim+timetag://?seed=1&pace=realtime&rate=1e6"
ROOT = Path(tofclip.__file__).parents[1]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import devices
    from devices.recorder import record_source

    path = tmp_path_factory.mktemp("recording") / "run.h5"
    record_source(devices.open(SIM), path, 0.3)
    return path


def test_listing_needs_no_hardware(run: Run) -> None:
    outcome = run("devices", "list", "--json")
    found = json.loads(outcome.out)
    assert outcome.status == 0
    assert isinstance(found["devices"], list)
    assert {"timetag", "sim+timetag", "file"} <= set(found["kinds"])
    assert "instruments are connected" in run("devices", "list").out


def test_what_is_connected_is_listed(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    from devices import registry

    monkeypatch.setattr(registry, "FINDERS", (f"{__name__}:find_one",))
    assert "timetag://T9" in run("devices", "list").out
    note = {"uri": "timetag://T9", "instrument": "a tagger", "note": "asleep"}
    assert json.loads(run("devices", "list", "--json").out)["devices"] == [note]


def find_one() -> list[object]:
    from devices.registry import DiscoveredInstrument

    return [DiscoveredInstrument("timetag://T9", "a tagger", "asleep")]


def test_information(run: Run, recording: Path) -> None:
    live = json.loads(run("devices", "info", SIM, "--json").out)
    assert (live["instrument"], live["clock_hz"], live["is_live"]) == (
        "FX2 time tagger",
        128_000_000,
        True,
    )
    assert live["calibration_tick_s"] == 1 / 128e6
    replayed = json.loads(run("devices", "info", f"file://{recording}", "--json").out)
    assert replayed == {**live, "is_live": False, "is_seekable": True}


def test_trying_out(run: Run) -> None:
    outcome = run("devices", "test", SIM, "--seconds", "0.4", "--json")
    found = json.loads(outcome.out)
    assert (outcome.status, outcome.err) == (0, "")
    counted = {"delivered", "dropped_host", "lost_device", "malformed", "timeouts", "reconnects"}
    assert counted | {"bytes_per_second", "records"} <= set(found)
    assert found["records"] == found["delivered"] > 300_000
    # A million records of 6 bytes a second, and less on a machine that stood still meanwhile.
    assert 0 < found["bytes_per_second"] <= 1.25 * 6e6
    received = found["bytes_per_second"] * found["seconds"]
    assert received == pytest.approx(6 * found["records"], rel=0.25)
    assert found["lost_device"] == found["dropped_host"] == found["malformed"] == 0
    assert "bytes per second" in run("devices", "test", SIM, "--seconds", "0.1").out


def test_faults_are_counted(run: Run) -> None:
    faulty = f"{SIM}&transfer_kib=4&faults=unplug@5:1,corrupt@9:4,timeout@12"
    found = json.loads(run("devices", "test", faulty, "--seconds", "0.5", "--json").out)
    assert found["reconnects"] == 1
    assert found["malformed"] >= 4
    assert found["timeouts"] >= 1


def test_recording_and_verifying(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    outcome = run("record", SIM, "--out", path, "--seconds", "0.3", "--json")
    done = json.loads(outcome.out)
    assert (outcome.status, outcome.err) == (0, "")
    found = json.loads(run("devices", "verify", path, "--json").out)
    assert (found["sound"], found["complete"]) == (True, True)
    assert found["records"] == done["delivered"] > 0
    assert found["bytes"] == done["bytes"] == 6 * done["records"]
    again = tmp_path / "again.h5"
    assert f"wrote {again}" in run("record", f"file://{path}", "--out", again).out
    assert verify(again).records == done["delivered"]


def test_info_does_not_read_the_bytes(run: Run, recording: Path) -> None:
    found = json.loads(run("info", recording, "--json").out)
    assert (found["kind"], found["attributes"]["codec"]) == ("recording", "timetag")
    assert found["children"]["calibration"]["attributes"]["tick_s"] == 1 / 128e6
    assert "fields" not in found


def test_damage_is_named_and_repaired(run: Run, recording: Path, tmp_path: Path) -> None:
    damaged, out = tmp_path / "run.h5", tmp_path / "sound.h5"
    content = bytearray(recording.read_bytes())
    content[len(content) // 2] ^= 0xFF
    damaged.write_bytes(content)
    outcome = run("devices", "verify", damaged, "--json")
    assert outcome.status == 2
    assert json.loads(outcome.out)["damaged_blocks"] == 1
    assert (
        outcome.err
        == f"tofclip: error: {damaged}: is damaged; tofclip devices repair makes a sound copy\n"
    )
    assert f"wrote {out}" in run("devices", "repair", damaged, "--out", out).out
    assert run("devices", "verify", out).status == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("devices", "test", "sim+timetag://?seed=x"), "seed cannot be 'x'"),
        (("devices", "test", "sim+timetag://", "--seconds", "0"), "positive"),
        (("devices", "test", "sim+timetag://", "--seconds", "nan"), "positive"),
        (("devices", "test", "sim+timetag://", "--seconds", "inf"), "finite"),
        (("devices", "test", "sim+unknown://"), "no source is called"),
        (("devices", "info", "timetag://"), "04b4:1004"),
        (("devices", "verify", "absent.h5"), "no such file"),
        (("record", "sim+timetag://", "--out", "run.txt"), "must end in .h5"),
        (
            ("record", "sim+timetag://", "--out", "run.h5", "--seconds", "-1"),
            "--seconds must be positive",
        ),
    ],
)
def test_unusable_input_is_one_line(
    run: Run, words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = run(*words)
    assert (outcome.status, outcome.err.count("\n"), outcome.out) == (2, 1, "")
    assert said in outcome.err
    assert not list(tmp_path.iterdir())


def test_a_recording_is_not_overwritten_unless_asked(
    run: Run, recording: Path, tmp_path: Path
) -> None:
    path = tmp_path / "run.h5"
    path.write_bytes(recording.read_bytes())
    before = path.read_bytes()
    outcome = run("record", SIM, "--out", path, "--seconds", "0.1")
    assert (outcome.status, path.read_bytes()) == (2, before)
    assert "--overwrite" in outcome.err
    assert run("record", SIM, "--out", path, "--seconds", "0.1", "--overwrite").status == 0
    assert path.read_bytes() != before


def test_an_input_is_not_overwritten(run: Run, recording: Path) -> None:
    outcome = run("record", f"file://{recording}", "--out", recording)
    assert outcome.status == 2
    assert "is an input too" in outcome.err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_a_whole_recording(tmp_path: Path, number: signal.Signals) -> None:
    path = tmp_path / "run.h5"
    command = [sys.executable, "-m", "tofclip", "record", SIM, "--out", str(path)]
    # A shell that puts the tests into the background has them ignore Ctrl-C, and children inherit
    # that.
    heed = partial(signal.signal, number, signal.SIG_DFL)
    recorder = subprocess.Popen(
        command, cwd=ROOT, stderr=subprocess.PIPE, env=os.environ, preexec_fn=heed
    )
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (path.exists() and verify(path).records):
        time.sleep(0.05)
    recorder.send_signal(number)
    _, said = recorder.communicate(timeout=60)
    assert recorder.returncode == 130
    assert b"interrupted" in said
    found = verify(path)
    assert (found.is_sound, found.complete, found.fault) == (True, True, "interrupted")
