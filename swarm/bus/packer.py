"""Turns messages into the payloads that the bus carries; the real bus and the one of virtual time share it."""

import logging
from collections import Counter

from swarm.errors import LocalError
from swarm.messages.codec import MAX_BINARY, encode
from swarm.messages.keys import STOP
from swarm.messages.service import stop_payload

TOO_LARGE = "too_large"
"""Counts the messages that a process has dropped because the bus does not take them."""

_LOGGED = 256
"""Keys that are logged at most: an app may make up keys without end."""

_log = logging.getLogger("bus")


class Packer:
    """Packs the messages of one process. A message that the bus does not take is dropped, counted, and logged once for
    its key: a service never ends because it had too much to tell."""

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._logged: set[str] = set()

    def pack(self, key: str, message: object) -> bytes | None:
        """Return the payload of a message dataclass or of raw bytes; None where the message is dropped.

        A stop always has a payload: whatever it is made of, it stops.
        """
        if key == STOP:
            return stop_payload(message)
        try:
            if not isinstance(message, bytes | bytearray):
                return encode(message)
            if len(message) <= MAX_BINARY:
                return bytes(message)
            problem = f"{len(message)} bytes, the bus takes at most {MAX_BINARY}"
        except LocalError as error:
            problem = str(error)
        self._counters[TOO_LARGE] += 1
        if key not in self._logged and len(self._logged) < _LOGGED:
            self._logged.add(key)
            _log.error("dropped, here and whenever it happens again: key=%s %s", key, problem)
        return None
