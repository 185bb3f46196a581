"""Time taggers by their addresses, and those that are connected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from devices.ledger import Ledger
from devices.registry import Found
from devices.stream import StreamSource
from devices.stream_options import OPTIONS as STREAM_OPTIONS
from devices.stream_options import buffering
from devices.timetag.codec import TimeTagCodec
from devices.timetag.feed import Acquisition, TimeTaggerFeed
from devices.timetag.registers import BARE_CHIP, IDENTITY, INSTRUMENT
from devices.uri import Uri
from devices.usb import UsbLink, find, serial_of, system_backend
from tofclip.errors import DeviceError, DeviceNotFoundError

OPTIONS = ("channels", "delta", "transfer_kib", "reconnect_s", *STREAM_OPTIONS)


def open_timetag(uri: Uri) -> StreamSource:
    """Open ``timetag://SERIAL?channels=15&delta=0&transfer_kib=512&buffer_mib=64&policy=block&reconnect_s=5``."""
    uri.only(*OPTIONS)
    backend = system_backend()
    try:
        return opened(uri, uri.place, backend)
    except DeviceNotFoundError as fault:
        if any(find(BARE_CHIP, backend)):
            raise DeviceNotFoundError(
                f"a USB device {BARE_CHIP} is connected, a chip without firmware; load the time tagger's into it first"
            ) from fault
        raise


def opened(uri: Uri, serial: str, backend: Any) -> StreamSource:
    """Open the time tagger behind a backend of pyusb, with the values of an address (`OPTIONS`)."""
    standard = Acquisition()
    acquisition = Acquisition(
        uri.value("channels", int, standard.channels),
        uri.value("delta", int, standard.delta),
        int(uri.value("transfer_kib", float, standard.transfer_bytes / 1024) * 1024),
        uri.value("reconnect_s", float, standard.reconnect),
    )
    held, ledger = buffering(uri), Ledger()
    link = UsbLink(IDENTITY, serial, backend)
    try:
        feed = TimeTaggerFeed(link, ledger, acquisition)
        return StreamSource(feed, TimeTagCodec(), ledger, held)
    except BaseException:
        link.close()
        raise


def find_timetaggers() -> list[Found]:
    """Look for connected time taggers; an empty list where there is no USB to look at."""
    try:
        backend = system_backend()
        return [*_listed(backend), *_bare_chips(backend)]
    except DeviceError:
        return []


def _listed(backend: Any) -> Iterator[Found]:
    for device in find(IDENTITY, backend):
        try:
            serial, note = serial_of(device, IDENTITY), ""
        except DeviceError as fault:
            serial, note = "", str(fault)
        yield Found(f"timetag://{serial}", INSTRUMENT, note)


def _bare_chips(backend: Any) -> Iterator[Found]:
    for _ in find(BARE_CHIP, backend):
        yield Found("timetag://", INSTRUMENT, "a chip without firmware; load the time tagger's into it first")
