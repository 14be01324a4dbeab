"""A computer at the USB port of the simulated board: it sets a serial port (CDC ACM) up, and carries bytes over it."""

import ctypes
import struct
from typing import NamedTuple

from avr_bench import Bench

BUSY = -2
PACKET = 16
"""Bytes of a data packet, as the bootloader's descriptor has it."""
IN, OUT = 3, 4
"""Its data endpoints."""
LATER_S = 20e-6
"""Between two looks at an endpoint."""
SETTLED_S = 1e-3
PATIENCE_S = 2.0


class _Request(NamedTuple):
    """A standard request of USB 2.0, section 9.4."""

    kind: int
    number: int
    value: int
    length: int = 0


DEVICE_DESCRIPTOR = _Request(0x80, 6, 0x0100, 18)
SET_ADDRESS = _Request(0, 5, 7)
SET_CONFIGURATION = _Request(0, 9, 1)


class UsbHost:
    """Plugs the cable in, and opens the port; `ids` are those of the device (vendor, product)."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._received = bytearray()
        bench.call("usb_power", 1)
        bench.run(SETTLED_S)
        bench.call("usb_bus_reset")
        bench.run(SETTLED_S)
        descriptor = self._control(DEVICE_DESCRIPTOR)
        self.ids = struct.unpack_from("<2H", descriptor, 8)
        self._control(SET_ADDRESS)
        self._control(SET_CONFIGURATION)

    def write(self, data: bytes) -> None:
        """Send bytes in packets; what comes back meanwhile is kept, as by the kernel's driver, which always reads."""
        for start in range(0, len(data), PACKET):
            packet = data[start : start + PACKET]
            self._bench.run_until(lambda packet=packet: self._sent(packet), PATIENCE_S, LATER_S)

    def read(self, count: int, patience: float) -> bytes:
        """Return `count` bytes; fails where they do not come within `patience` seconds."""
        self._bench.run_until(lambda: self._look() >= count, patience, LATER_S)
        data = bytes(self._received[:count])
        del self._received[:count]
        return data

    def _sent(self, packet: bytes) -> bool:
        self._look()
        return self._bench.call("usb_out", OUT, packet, len(packet)) != BUSY

    def _look(self) -> int:
        self._received += self._take(IN) or b""
        return len(self._received)

    def _take(self, endpoint: int) -> bytes | None:
        data = (ctypes.c_uint8 * 64)()
        count = self._bench.call("usb_in", endpoint, data, 64)
        return None if count == BUSY else bytes(data[:count])

    def _control(self, request: _Request) -> bytes:
        words = struct.pack("<BBHHH", request.kind, request.number, request.value, 0, request.length)
        assert self._bench.call("usb_setup", words) != BUSY
        data = b""
        while True:
            self._bench.run(SETTLED_S)
            packet = self._take(0)
            assert packet is not None, f"{request} is not answered"
            data += packet
            if len(data) >= request.length:
                break
        if request.length:
            self._bench.call("usb_out", 0, b"", 0)
        self._bench.run(SETTLED_S)
        return data
