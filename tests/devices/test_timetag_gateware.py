"""The driver's register sequence, played into the time tagger's own gateware.

The gateware (github.com/bgamari/timetag-fpga, GPL) is not part of this project. Put a copy of it
somewhere, name the folder in TOFCLIP_TIMETAG_FPGA, and install Icarus Verilog (``iverilog``).
"""

import os
import shutil
import subprocess
from pathlib import Path
from typing import ClassVar

import pytest
from instruments import TAGS, make_tagger

from devices.emulation.timetag import COMMAND, EmulatedTimeTagger
from devices.emulation.usb import VirtualUsb
from devices.source import as_bytes
from devices.timetag import USB_IDENTITY, Capture, Register, TimeTagger
from devices.usb import UsbLink

BENCH = Path(__file__).with_name("timetag_bench.v")
GATEWARE = os.environ.get("TOFCLIP_TIMETAG_FPGA", "")
FILES = "event_tagger apdtimer_all strobe_latch reg_manager register sample_multiplexer sequencer timetag"
PHOTONS = 300

pytestmark = pytest.mark.skipif(
    not GATEWARE or shutil.which("iverilog") is None,
    reason="TOFCLIP_TIMETAG_FPGA does not name the gateware's folder, or there is no iverilog",
)


class Eavesdropper(EmulatedTimeTagger):
    """Notes the commands that it gets."""

    heard: ClassVar[list[bytes]] = []

    def receive(self, endpoint, data):
        self.heard.append(data)
        super().receive(endpoint, data)


def driver_commands():
    """Return what the driver sends to begin an acquisition, and to end it and count."""
    instrument = make_tagger(Eavesdropper, stale_replies=0, jammed_bytes=0, old_records=0, heard=[])
    tagger = TimeTagger(UsbLink(USB_IDENTITY, "", VirtualUsb(instrument)))
    tagger.reset()
    tagger.run(0xF, 0)
    beginning = len(instrument.heard)
    tagger.write(Register.CAPTURE, Capture.COUNT)
    tagger.read(Register.RECORDS)
    return instrument.heard[:beginning], instrument.heard[beginning:]


def simulate(folder, beginning, ending):
    """Return how many records the gateware counted, and the bytes that it delivered."""
    lines = []
    for number, command in enumerate([*beginning, *ending], 1):
        lines += [f"0 {byte:02x}" for byte in command]
        lines.append(f"1 {PHOTONS if number == len(beginning) else 0:x}")
    folder.joinpath("commands.txt").write_text("\n".join(lines) + "\n")
    sources = [str(Path(GATEWARE).resolve() / f"{name}.v") for name in FILES.split()]
    build = ["iverilog", f"-I{Path(GATEWARE).resolve()}", "-o", "bench", str(BENCH), *sources]
    subprocess.run(build, cwd=folder, check=True, timeout=120)
    subprocess.run(["vvp", "-n", "bench"], cwd=folder, check=True, timeout=300)
    delivered = bytes.fromhex(folder.joinpath("delivered.txt").read_text().replace("x", "0"))
    # What is asked about a register that is not there comes back undefined.
    text = folder.joinpath("replies.txt").read_text().split()
    replies = [text[at : at + 4] for at in range(0, len(text), 4)]
    asked = [COMMAND.unpack(command) for command in [*beginning, *ending]]
    assert len(replies) == len(asked)
    counts = [
        int("".join(reversed(reply)), 16)
        for reply, (_, what, register, _) in zip(replies, asked, strict=True)
        if (what, register) == (0, Register.RECORDS)
    ]
    return counts[-1], delivered


def test_what_the_gateware_counts_is_delivered(tmp_path):
    counted, delivered = simulate(tmp_path, *driver_commands())
    found = TAGS.decode(as_bytes(delivered), TAGS.start)
    assert counted == PHOTONS
    assert len(delivered) == 6 * counted
    assert (len(found.records), found.malformed) == (counted, 0)
    assert set(found.records["channels"]) == {1, 2, 4, 8}


def test_a_memory_that_is_held_empty_delivers_nothing(tmp_path):
    """Without the command that lets it fill again: the gateware is one that can fail us."""
    release = COMMAND.pack(0xAA, 1, Register.CLEAR, 0)
    beginning, ending = driver_commands()
    without = [command for command in beginning if command != release]
    assert len(without) == len(beginning) - 1
    counted, delivered = simulate(tmp_path, without, ending)
    assert counted == PHOTONS
    assert len(delivered) < 6
