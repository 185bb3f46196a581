"""USB by pyusb: finding an instrument, talking to it, and the faults of both as our exceptions."""

from __future__ import annotations

import array
import contextlib
import errno
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

from devices.stream import retry_connect
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

if TYPE_CHECKING:
    import usb.core

INTERFACE_NUMBER = 0
VENDOR_REQUEST = 0x40  # Type of a control request of the maker's own, from host to device
_UNPLUGGED = (DeviceDisconnectedError, "was unplugged")
# What a system error means, and what is said of it
_FAULTS: dict[int, tuple[type[DeviceError], str]] = {
    errno.ETIMEDOUT: (DeviceTimeoutError, "sent nothing in time"),
    errno.EBUSY: (DeviceBusyError, "is used by another program; close that first"),
    errno.EPIPE: (DeviceStalledError, "stalled; unplug it and plug it in again"),
    errno.EOVERFLOW: (
        TransferOverflowError,
        "sent more than was asked for; the transfer is lost",
    ),
    **dict.fromkeys(
        (errno.ENODEV, errno.EIO, errno.ENOENT, errno.ENXIO, errno.ESHUTDOWN), _UNPLUGGED
    ),
}


class UsbIdentity(NamedTuple):
    """Vendor and product number."""

    vendor: int
    product: int

    def __str__(self) -> str:
        return f"{self.vendor:04x}:{self.product:04x}"


def system_backend() -> Any:
    """Return pyusb's backend for this machine's USB, on the libusb that `libusb-package` brings."""
    try:
        import libusb_package
        import usb.backend.libusb1

        backend = usb.backend.libusb1.get_backend(find_library=libusb_package.find_library)
    except (ImportError, OSError) as fault:
        raise UsbBackendError(
            f"the USB library does not load ({fault}); install pyusb and libusb-package"
        ) from fault
    if backend is None:
        raise UsbBackendError(
            "libusb does not load on this machine; install libusb-package or the system's libusb-1.0"
        )
    return backend


def find_devices(identity: UsbIdentity, backend: Any) -> Iterator[usb.core.Device]:
    """Yield every connected instrument of that kind."""
    import usb.core

    with translate_errors(identity):
        yield from usb.core.find(
            find_all=True, backend=backend, idVendor=identity.vendor, idProduct=identity.product
        )


def read_serial(device: usb.core.Device, identity: UsbIdentity) -> str:
    """Return the serial number, empty where there is none."""
    with translate_errors(identity):
        return str(device.serial_number or "")


@contextlib.contextmanager
def translate_errors(identity: UsbIdentity) -> Iterator[None]:
    """Turn the exceptions of pyusb into ours."""
    import usb.core

    try:
        yield
    except usb.core.NoBackendError as fault:  # a ValueError, so it has to come first
        raise UsbBackendError("no USB library was found; install libusb-package") from fault
    except usb.core.USBError as fault:
        number = errno.ETIMEDOUT if isinstance(fault, usb.core.USBTimeoutError) else fault.errno
        if number == errno.EACCES:
            raise _make_permission_error(identity) from fault
        kind, said = _FAULTS.get(number, (DeviceError, f": {' '.join(str(fault).split())}"))
        raise kind(f"USB device {identity} {said}".replace(" :", ":")) from fault
    except ValueError as fault:
        if "langid" not in str(fault):
            raise
        # pyusb says so where it may not open the device.
        raise _make_permission_error(identity) from fault
    except NotImplementedError as fault:
        raise DeviceError(
            f"USB device {identity}: this system's USB library cannot do that ({fault})"
        ) from fault


def _make_permission_error(identity: UsbIdentity) -> DevicePermissionError:
    vendor, product = str(identity).split(":")
    return DevicePermissionError(
        f"USB device {identity} may not be opened by this user; put this line into "
        "/etc/udev/rules.d/70-tofclip.rules and plug it in again: "
        f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{vendor}", ATTR{{idProduct}}=="{product}", TAG+="uaccess"'
    )


class UsbLink:
    """One claimed USB instrument, known by its serial number (empty: the only one). Not for two
    threads at once. Reading and writing clear a stalled endpoint and try once more.
    """

    def __init__(self, identity: UsbIdentity, serial: str, backend: Any) -> None:
        self.identity, self.serial, self._backend = identity, serial, backend
        self._open()

    def read(self, endpoint: int, buffer: array.array[int], timeout: float) -> int:
        """Fill `buffer` from a bulk endpoint and return how many bytes came; fewer than fit are no fault."""
        return self._retry_after_halt(
            endpoint, lambda: int(self._device.read(endpoint, buffer, _to_milliseconds(timeout)))
        )

    def write(self, endpoint: int, data: bytes, timeout: float) -> None:
        sent = self._retry_after_halt(
            endpoint, lambda: int(self._device.write(endpoint, data, _to_milliseconds(timeout)))
        )
        if sent != len(data):
            raise DeviceTimeoutError(
                f"USB device {self.identity} took only {sent} of {len(data)} bytes in time"
            )

    def request(self, number: int, value: int, timeout: float) -> None:
        """Send a vendor request (``bRequest``, ``wValue``) without data to the firmware."""
        with translate_errors(self.identity):
            self._device.ctrl_transfer(
                VENDOR_REQUEST, number, value, 0, None, _to_milliseconds(timeout)
            )

    def reconnect(self, patience: float) -> None:
        """Wait until the instrument with this serial number is back, and claim it."""
        self.close()
        retry_connect(self._open, patience)

    def close(self) -> None:
        """Let go of the instrument; that it is gone already is fine."""
        import usb.core
        import usb.util

        with contextlib.suppress(usb.core.USBError):
            usb.util.dispose_resources(self._device)

    def _open(self) -> None:
        """Find the one instrument that is meant, and claim it."""
        import usb.core
        import usb.util

        serial = self.serial
        known = [
            (device, read_serial(device, self.identity))
            for device in find_devices(self.identity, self._backend)
        ]
        fitting = [(device, number) for device, number in known if serial in ("", number)]
        if not fitting:
            others = ", ".join(number or "one without serial number" for _, number in known)
            wanted = f" with serial number {serial}" if serial else ""
            raise DeviceNotFoundError(
                f"no USB device {self.identity}{wanted} is connected (connected: {others or 'none'})"
            )
        if len(fitting) > 1:
            numbers = ", ".join(number for _, number in fitting if number)
            advice = (
                f"say which: {numbers}" if numbers else "none has a serial number; unplug others"
            )
            raise DeviceNotFoundError(
                f"several USB devices {self.identity} are connected; {advice}"
            )
        self._device, self.serial = fitting[0]
        with translate_errors(self.identity):
            # Only Linux and macOS have drivers to detach.
            with contextlib.suppress(NotImplementedError):
                if self._device.is_kernel_driver_active(INTERFACE_NUMBER):
                    self._device.detach_kernel_driver(INTERFACE_NUMBER)
            try:
                self._device.get_active_configuration()
            except usb.core.USBError:
                # only where there is none, because this resets the device
                self._device.set_configuration()
            usb.util.claim_interface(self._device, INTERFACE_NUMBER)

    def _retry_after_halt(self, endpoint: int, transfer: Callable[[], int]) -> int:
        """Do a transfer; if the endpoint has stalled, clear it and try once more."""
        import usb.core

        with translate_errors(self.identity):
            try:
                return transfer()
            except usb.core.USBError as fault:
                if fault.errno != errno.EPIPE:
                    raise
            self._device.clear_halt(endpoint)
            return transfer()


def _to_milliseconds(seconds: float) -> int:
    """Return what libusb takes: 0 would mean for ever."""
    return max(1, round(seconds * 1000))
