"""Every fault of the USB as an exception of ours, through pyusb's own code."""

import array
import errno
import sys

import pytest
import usb.backend.libusb1
import usb.core

from devices import timetag
from devices.address import Uri
from devices.emulation.usb import VirtualDevice, VirtualUsb, make_usb_error
from devices.timetag import BARE_CHIP_IDENTITY, find_timetaggers, open_timetag
from devices.usb import UsbIdentity, UsbLink, system_backend, translate_errors
from tofclip.errors import (
    DeviceBusyError,
    DeviceDisconnectedError,
    DeviceError,
    DeviceNotFoundError,
    DevicePermissionError,
    DeviceStalledError,
    DeviceTimeoutError,
    TransferOverflowError,
    UsbBackendError,
)

KIND = UsbIdentity(0x04B4, 0x1004)
OUT, IN = 0x02, 0x86


class Echo(VirtualDevice):
    """Sends back what it got; raises what it is asked to raise, once each."""

    def __init__(self, serial="A1", identity=KIND):
        super().__init__(identity, ("makers", "echo", serial), (OUT, IN))
        self.got = b""
        self.faults = []

    def receive(self, endpoint, data):
        self.got += data

    def fill(self, endpoint, buffer, timeout):
        if self.faults:
            number = self.faults.pop(0)
            if number == errno.EPIPE:
                self.halted.add(endpoint)
            if number == errno.ENODEV:
                self.unplug(2)
            raise make_usb_error(number)
        length = min(len(buffer), len(self.got))
        buffer[:length] = self.got[:length]
        return length


def linked(*instruments, serial=""):
    return UsbLink(KIND, serial, VirtualUsb(*instruments))


def received(link):
    buffer = array.array("B", bytes(64))
    return buffer[: link.read(IN, buffer, 0.1)].tobytes()


def test_the_serial_number_chooses():
    first, second = Echo("A1"), Echo("B2")
    assert linked(first, second, serial="B2").serial == "B2"
    with pytest.raises(DeviceNotFoundError, match=r"several.*say which: A1, B2"):
        linked(first, second)
    with pytest.raises(
        DeviceNotFoundError, match="with serial number C3 is connected \\(connected: A1, B2\\)"
    ):
        linked(first, second, serial="C3")
    with pytest.raises(DeviceNotFoundError, match="connected: none"):
        linked()
    assert linked(Echo("")).serial == ""


def test_another_program_holds_it():
    instrument = Echo()
    instrument.is_claimed_elsewhere = True
    with pytest.raises(DeviceBusyError, match="another program"):
        linked(instrument)


def test_no_permission_shows_the_rule_to_add():
    instrument = Echo()
    instrument.is_accessible = False
    with pytest.raises(DevicePermissionError) as caught:
        linked(instrument)
    assert isinstance(caught.value.__cause__, ValueError)  # what pyusb makes of it
    rule = 'SUBSYSTEM=="usb", ATTR{idVendor}=="04b4", ATTR{idProduct}=="1004", TAG+="uaccess"'
    assert rule in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (errno.ETIMEDOUT, DeviceTimeoutError),
        (errno.ENODEV, DeviceDisconnectedError),
        (errno.EIO, DeviceDisconnectedError),
        (errno.EOVERFLOW, TransferOverflowError),
        (errno.EACCES, DevicePermissionError),
        (errno.ENOMEM, DeviceError),
    ],
)
def test_faults_of_a_transfer(number, expected):
    instrument = Echo()
    link = linked(instrument)
    instrument.faults = [number]
    with pytest.raises(expected) as caught:
        received(link)
    assert type(caught.value) is expected


def test_a_stall_is_cleared_once():
    instrument = Echo()
    link = linked(instrument)
    link.write(OUT, b"x", 0.1)
    instrument.faults = [errno.EPIPE]
    assert received(link) == b"x"
    instrument.faults = [errno.EPIPE, errno.EPIPE]
    with pytest.raises(DeviceStalledError):
        received(link)


def test_an_unplugged_instrument_is_found_again():
    instrument = Echo()
    link = linked(instrument, Echo("B2"), serial="A1")
    instrument.faults = [errno.ENODEV]
    with pytest.raises(DeviceDisconnectedError):
        received(link)
    link.reconnect(5.0)
    link.write(OUT, b"again", 0.1)
    assert received(link) == b"again"
    instrument.unplug(float("inf"))
    with pytest.raises(DeviceDisconnectedError, match=r"came for 0.1 s .*serial number A1 is"):
        link.reconnect(0.1)
    link.close()


def test_a_partial_write_is_no_success(monkeypatch):
    link = linked(Echo())
    monkeypatch.setattr(VirtualUsb, "bulk_write", lambda *_: 2)
    with pytest.raises(DeviceTimeoutError, match="only 2 of 5"):
        link.write(OUT, b"hello", 0.1)


def test_a_device_is_configured_and_taken_from_a_kernels_driver(
    monkeypatch,
):
    done = []
    for name, answer in (("get_configuration", 0), ("is_kernel_driver_active", True)):
        monkeypatch.setattr(VirtualUsb, name, lambda *_, answer=answer: answer)
    for name in ("set_configuration", "detach_kernel_driver"):
        note = lambda _, __, value, name=name: done.append((name, value))  # noqa: E731
        monkeypatch.setattr(VirtualUsb, name, note)
    linked(Echo())
    assert sorted(done) == [("detach_kernel_driver", 0), ("set_configuration", 1)]


def test_no_usb_library(monkeypatch):
    assert system_backend() is not None  # the system has one
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda **_: None)
    with pytest.raises(UsbBackendError, match="libusb-package"):
        system_backend()
    assert find_timetaggers() == []
    with pytest.raises(UsbBackendError):
        open_timetag(Uri.parse("timetag://"))
    monkeypatch.setitem(sys.modules, "libusb_package", None)
    with pytest.raises(UsbBackendError, match="does not load"):
        system_backend()


def test_exceptions_that_pyusb_disguises():
    with pytest.raises(UsbBackendError), translate_errors(KIND):
        raise usb.core.NoBackendError("No backend available")
    with pytest.raises(DeviceError, match="cannot do that"), translate_errors(KIND):
        raise NotImplementedError
    with pytest.raises(ValueError, match=r"^a defect$"), translate_errors(KIND):
        raise ValueError("a defect")


def test_instruments_are_discovered(monkeypatch):
    shut = Echo("S9")
    shut.is_accessible = False
    bus = VirtualUsb(Echo("A1"), shut, Echo("", BARE_CHIP_IDENTITY))
    monkeypatch.setattr(timetag, "system_backend", lambda: bus)
    found = find_timetaggers()
    assert [(one.uri, bool(one.note)) for one in found] == [
        ("timetag://A1", False),
        ("timetag://", True),
        ("timetag://", True),
    ]
    assert "udev" in found[1].note
    assert "firmware" in found[2].note


@pytest.mark.parametrize(
    ("bus", "said"),
    [([Echo("", BARE_CHIP_IDENTITY)], "without firmware"), ([], "04b4:1004 is connected")],
)
def test_a_chip_without_firmware_is_told_from_nothing(bus, said, monkeypatch):
    monkeypatch.setattr(timetag, "system_backend", lambda: VirtualUsb(*bus))
    with pytest.raises(DeviceNotFoundError, match=said):
        open_timetag(Uri.parse("timetag://"))
