"""The firmware's parts that know no hardware, compiled for this machine: a ctypes binding of host/pure.cpp."""

import ctypes
import shutil
import tempfile
from pathlib import Path

MORE, LOCATION, REFUSAL = 0, 1, 2


class Pure:
    """A fresh copy of the parts: their variables are as after power-on."""

    def __init__(self, path: Path) -> None:
        # A library is loaded once for each file, so each test has a file of its own, gone as soon as it is loaded.
        with tempfile.TemporaryDirectory() as folder:
            self._library = ctypes.CDLL(shutil.copy(path, folder))
        for name, result in (
            ("slave_received", ctypes.c_bool),
            ("slave_transmit", ctypes.c_uint8),
            ("pure_front", ctypes.c_uint8),
            ("location_feed", ctypes.c_uint8),
            ("location_begun", ctypes.c_bool),
            ("location_error", ctypes.c_uint8),
            ("location_copy", ctypes.c_uint8),
            ("tlv_whole", ctypes.c_bool),
            ("tone_top", ctypes.c_uint16),
            ("tone_prescaler", ctypes.c_uint8),
            ("tone_compare", ctypes.c_uint16),
            ("tune_tick", ctypes.c_bool),
            ("tune_pitch", ctypes.c_uint8),
            ("tune_left", ctypes.c_uint8),
            ("mailbox_byte", ctypes.c_uint8),
            ("mailbox_request", ctypes.c_uint16),
            ("pure_motor_writes", ctypes.c_uint32),
            ("pure_last_command", ctypes.c_uint16),
        ):
            getattr(self._library, name).restype = result

    def __getattr__(self, name: str) -> object:
        return getattr(self._library, name)

    def front(self, at: int, count: int) -> bytes:
        return bytes(self._library.pure_front(at + i) for i in range(count))

    def write(self, index: int, data: bytes = b"", *, stop: bool = True) -> int:
        """A write transaction; returns how many data bytes were acknowledged."""
        self._library.slave_started()
        acknowledge = self._library.slave_received(index)
        for done, byte in enumerate(data):
            if not acknowledge:
                self._library.slave_refused()
                return done
            acknowledge = self._library.slave_received(byte)
        if stop:
            self._library.slave_stopped()
        return len(data)

    def read(self, count: int) -> bytes:
        return bytes(self._library.slave_transmit() for _ in range(count))

    def read_at(self, index: int, count: int) -> bytes:
        self.write(index)
        return self.read(count)

    def load_tune(self, data: bytes) -> bool:
        """By way of the slave, as it is on the chip; whether it was taken."""
        refused = self.front(22, 1)
        assert self.write(160, data) == len(data)
        return self.front(22, 1) == refused

    def locations(self, data: bytes) -> list[tuple[bytes, tuple[bytes, ...]] | int]:
        """Feed bytes: a location as (place, ranges), or the error of a refusal, for each answer found."""
        found: list[tuple[bytes, tuple[bytes, ...]] | int] = []
        for byte in data:
            result = self._library.location_feed(byte)
            if result == REFUSAL:
                found.append(self._library.location_error())
            elif result == LOCATION:
                copy = (ctypes.c_uint8 * 300)()
                count = self._library.location_copy(copy)
                raw = bytes(copy)
                found.append((raw[:13], tuple(raw[13 + 20 * n : 33 + 20 * n] for n in range(count))))
        return found

    def whole(self, data: bytes) -> bool:
        return self._library.tlv_whole(data, len(data))

    def quadrature(self, pairs: list[tuple[bool, bool]]) -> tuple[int, int]:
        """Count and errors."""
        lost = ctypes.c_uint32(0)
        flat = bytes(bit for pair in pairs for bit in pair)
        return self._library.quadrature_count(flat, ctypes.c_size_t(len(pairs)), ctypes.byref(lost)), lost.value
