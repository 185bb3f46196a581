"""A USB of software: the interface that pyusb expects of a backend, over instruments that are
objects.
"""

from __future__ import annotations

import abc
import array
import errno
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from devices.usb import INTERFACE_NUMBER, VENDOR_REQUEST, UsbIdentity

BULK_TRANSFER = 2
HIGH_SPEED = 3
PACKET_BYTES = 512
ENGLISH_LANGID = b"\x09\x04"
GET_DESCRIPTOR, STRING = 6, 3


def make_usb_error(number: int) -> usb.core.USBError:
    """Return the exception that pyusb raises for a system error."""
    kind = usb.core.USBTimeoutError if number == errno.ETIMEDOUT else usb.core.USBError
    return kind(errno.errorcode[number], None, number)


class VirtualDevice(abc.ABC):
    """An instrument on the virtual USB."""

    def __init__(
        self, identity: UsbIdentity, strings: tuple[str, str, str], endpoints: tuple[int, ...]
    ) -> None:
        self.identity, self.strings, self.endpoints = identity, strings, endpoints
        self.halted: set[int] = set()
        self.enumerations_until_replug: float = 0
        """Enumerations in which it does not show; infinite: it is gone for good."""
        self.is_accessible = True
        self.is_claimed_elsewhere = False

    @property
    def is_plugged(self) -> bool:
        return self.enumerations_until_replug <= 0

    def unplug(self, looks: float) -> None:
        """Take it off the bus for a number of enumerations."""
        self.enumerations_until_replug = looks

    def clear_halt(self, endpoint: int) -> None:
        self.halted.discard(endpoint)

    def control(self, request: int, value: int) -> None:
        """Do what a vendor request asks for; without an override it knows none, and stalls."""
        raise make_usb_error(errno.EPIPE)

    @abc.abstractmethod
    def receive(self, endpoint: int, data: bytes) -> None:
        """Take what the host sends."""

    @abc.abstractmethod
    def fill(self, endpoint: int, buffer: memoryview, timeout: float) -> int:
        """Write what is asked for into `buffer`, return how many bytes; raise `make_usb_error`."""


class VirtualUsb(usb.backend.IBackend):  # type: ignore[misc] # pyusb has no types
    """A backend for pyusb (`usb.backend.IBackend`) over virtual devices."""

    def __init__(self, *devices: VirtualDevice) -> None:
        self._devices = devices

    def enumerate_devices(self) -> Iterator[VirtualDevice]:
        for device in self._devices:
            if device.is_plugged:
                yield device
            else:
                device.enumerations_until_replug -= 1

    def get_device_descriptor(self, dev: VirtualDevice) -> SimpleNamespace:
        return SimpleNamespace(
            # Standard device descriptor of USB 2.0, table 9-8; class 255 is vendor specific.
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=255, bDeviceSubClass=255, bDeviceProtocol=255,
            bMaxPacketSize0=64, idVendor=dev.identity.vendor, idProduct=dev.identity.product, bcdDevice=0x100,
            iManufacturer=1, iProduct=2, iSerialNumber=3 if dev.strings[2] else 0, bNumConfigurations=1,
            address=self._devices.index(dev) + 1, bus=1, port_number=1, port_numbers=(1,), speed=HIGH_SPEED,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: VirtualDevice, config: int) -> SimpleNamespace:
        """Describe the one configuration of a device; `IndexError` says, as pyusb expects, that there is
        no other.
        """
        one = SimpleNamespace(
            # USB 2.0, table 9-10.
            bLength=9, bDescriptorType=2, wTotalLength=18 + 7 * len(dev.endpoints), bNumInterfaces=1,
            bConfigurationValue=1, iConfiguration=0, bmAttributes=0x80, bMaxPower=250, extra_descriptors=[],
        )  # fmt: skip
        return [one][config]

    def get_interface_descriptor(
        self, dev: VirtualDevice, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        one = SimpleNamespace(
            # USB 2.0, table 9-12.
            bLength=9, bDescriptorType=4, bInterfaceNumber=INTERFACE_NUMBER, bAlternateSetting=0,
            bNumEndpoints=len(dev.endpoints), bInterfaceClass=255, bInterfaceSubClass=255, bInterfaceProtocol=255,
            iInterface=0, extra_descriptors=[],
        )  # fmt: skip
        return [[one]][intf][alt]

    def get_endpoint_descriptor(
        self, dev: VirtualDevice, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        return SimpleNamespace(
            # USB 2.0, table 9-13.
            bLength=7, bDescriptorType=5, bEndpointAddress=dev.endpoints[ep], bmAttributes=BULK_TRANSFER,
            wMaxPacketSize=PACKET_BYTES, bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: VirtualDevice) -> VirtualDevice:
        _require_ready(dev)
        if not dev.is_accessible:
            raise make_usb_error(errno.EACCES)
        return dev

    def close_device(self, dev_handle: VirtualDevice) -> None:
        """Nothing is held open."""

    def get_configuration(self, dev_handle: VirtualDevice) -> int:
        _require_ready(dev_handle)
        return 1

    def is_kernel_driver_active(self, dev_handle: VirtualDevice, intf: int) -> bool:
        _require_ready(dev_handle)
        return False

    def claim_interface(self, dev_handle: VirtualDevice, intf: int) -> None:
        _require_ready(dev_handle)
        if dev_handle.is_claimed_elsewhere:
            raise make_usb_error(errno.EBUSY)

    def release_interface(self, dev_handle: VirtualDevice, intf: int) -> None:
        _require_ready(dev_handle)

    def clear_halt(self, dev_handle: VirtualDevice, ep: int) -> None:
        _require_ready(dev_handle)
        dev_handle.clear_halt(ep)

    def ctrl_transfer(
        self, dev_handle: VirtualDevice, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data: Any,
        timeout: int,
    ) -> int:  # fmt: skip
        """Answer requests for string descriptors and those of the maker's own."""
        _require_ready(dev_handle)
        if bmRequestType == VENDOR_REQUEST:
            dev_handle.control(bRequest, wValue)
            return 0
        number = wValue & 0xFF
        if (bRequest, wValue >> 8) != (GET_DESCRIPTOR, STRING) or number > len(dev_handle.strings):
            raise make_usb_error(errno.EPIPE)
        text = [ENGLISH_LANGID, *(one.encode("utf-16-le") for one in dev_handle.strings)][number]
        # String descriptors are UTF-16LE behind their length and type; number 0 lists the
        # languages.
        answer = bytes([2 + len(text), STRING]) + text
        length = min(len(answer), len(data))
        data[:length] = array.array("B", answer[:length])
        return length

    def bulk_write(
        self, dev_handle: VirtualDevice, ep: int, intf: int, data: array.array[int], timeout: int
    ) -> int:
        _require_ready(dev_handle, ep)
        dev_handle.receive(ep, data.tobytes())
        return len(data)

    def bulk_read(
        self, dev_handle: VirtualDevice, ep: int, intf: int, buff: array.array[int], timeout: int
    ) -> int:
        _require_ready(dev_handle, ep)
        return dev_handle.fill(ep, memoryview(buff), timeout / 1000)


def _require_ready(device: VirtualDevice, endpoint: int = 0) -> None:
    if not device.is_plugged:
        raise make_usb_error(errno.ENODEV)
    if endpoint in device.halted:
        raise make_usb_error(errno.EPIPE)
