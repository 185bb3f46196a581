"""Open time taggers by their addresses, and list those that are connected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from devices.ledger import Ledger
from devices.registry import DiscoveredInstrument
from devices.stream import STREAM_OPTIONS, StreamSource, parse_buffer_settings
from devices.timetag.codec import TimeTagCodec
from devices.timetag.feed import AcquisitionSettings, TimeTaggerFeed
from devices.timetag.registers import BARE_CHIP_IDENTITY, INSTRUMENT, USB_IDENTITY
from devices.uri import Uri
from devices.usb import UsbLink, find_devices, read_serial, system_backend
from tofclip.errors import DeviceError, DeviceNotFoundError

OPTIONS = ("channels", "delta", "transfer_kib", "reconnect_s", *STREAM_OPTIONS)


def open_timetag(uri: Uri) -> StreamSource:
    """Open
    ``timetag://SERIAL?channels=15&delta=0&transfer_kib=512&buffer_mib=64&policy=block&reconnect_s=5``.
    """
    uri.reject_unknown(*OPTIONS)
    backend = system_backend()
    try:
        return open_on_backend(uri, uri.location, backend)
    except DeviceNotFoundError as fault:
        if any(find_devices(BARE_CHIP_IDENTITY, backend)):
            raise DeviceNotFoundError(
                f"a USB device {BARE_CHIP_IDENTITY} is connected, a chip without firmware; "
                "load the time tagger's into it first"
            ) from fault
        raise


def open_on_backend(uri: Uri, serial: str, backend: Any) -> StreamSource:
    """Open the time tagger behind a backend of pyusb, with the values of an address (`OPTIONS`).

    `serial`: of the instrument; empty: any; `backend`: of pyusb.
    """
    standard = AcquisitionSettings()
    acquisition = AcquisitionSettings(
        uri.value("channels", int, standard.channels),
        uri.value("delta", int, standard.delta),
        int(uri.value("transfer_kib", float, standard.transfer_bytes / 1024) * 1024),
        uri.value("reconnect_s", float, standard.reconnect),
    )
    held, ledger = parse_buffer_settings(uri), Ledger()
    link = UsbLink(USB_IDENTITY, serial, backend)
    try:
        feed = TimeTaggerFeed(link, ledger, acquisition)
        return StreamSource(feed, TimeTagCodec(), ledger, held)
    except BaseException:
        link.close()
        raise


def find_timetaggers() -> list[DiscoveredInstrument]:
    """Look for connected time taggers; an empty list where there is no USB to look at."""
    try:
        backend = system_backend()
        return [*_list_timetaggers(backend), *_list_bare_chips(backend)]
    except DeviceError:
        return []


def _list_timetaggers(backend: Any) -> Iterator[DiscoveredInstrument]:
    for device in find_devices(USB_IDENTITY, backend):
        try:
            serial, note = read_serial(device, USB_IDENTITY), ""
        except DeviceError as fault:
            serial, note = "", str(fault)
        yield DiscoveredInstrument(f"timetag://{serial}", INSTRUMENT, note)


def _list_bare_chips(backend: Any) -> Iterator[DiscoveredInstrument]:
    for _ in find_devices(BARE_CHIP_IDENTITY, backend):
        yield DiscoveredInstrument(
            "timetag://",
            INSTRUMENT,
            "a chip without firmware; load the time tagger's into it first",
        )
