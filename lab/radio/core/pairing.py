"""Authentication of a link: link keys, simple pairing, PINs. The exchange as hosts see it, not the cryptography.

(Core specification 5.4, vol 2 part F, 4.2 and vol 4 part E, 7.1.10 ff.)
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from lab.radio.core import hci
from lab.radio.core.hci import Ev, Op, Status

CONFIRMATION = 123456
"""The number that both sides would show."""

UNAUTHENTICATED, AUTHENTICATED, COMBINATION = 4, 5, 0
"""Types of a link key: by simple pairing without and with a person who compared numbers; by PIN."""

DISPLAY_YES_NO = 1
PROTECTED = 1
"""In an authentication requirement: against a man in the middle."""


@dataclass
class Pairing:
    """One authentication of a link between `initiator` and `responder`."""

    initiator: str
    responder: str
    simple: bool
    """Whether both hosts can pair simply."""
    new_key: Callable[[], bytes]
    _keys: dict[str, bytes] = field(default_factory=dict)
    _capabilities: dict[str, bytes] = field(default_factory=dict)
    _confirmed: set[str] = field(default_factory=set)
    _pins: dict[str, bytes] = field(default_factory=dict)
    _out: list[tuple[str, bytes]] = field(default_factory=list)
    status: int | None = None
    """How it ended; None while it goes on."""

    def events(self) -> list[tuple[str, bytes]]:
        """(address, event) for the hosts, in order."""
        out, self._out = self._out, []
        return out

    def start(self) -> None:
        """The initiator's host wants the link authenticated."""
        self._ask(self.initiator, Ev.LINK_KEY_REQUEST)

    def reply(self, who: str, op: int, parameters: bytes) -> None:
        """What a host says to a question of ours, after the address of the other side."""
        other = self.responder if who == self.initiator else self.initiator
        match op:
            case Op.LINK_KEY_REPLY:
                self._keys[who] = parameters
                if len(self._keys) == 1:
                    self._ask(self.responder, Ev.LINK_KEY_REQUEST)
                else:
                    self._end(Status.SUCCESS if self._keys[other] == parameters else Status.AUTHENTICATION_FAILURE)
            case Op.LINK_KEY_NEGATIVE_REPLY:
                if who == self.responder:  # it lost its key
                    self._end(Status.KEY_MISSING)
                else:
                    self._ask(self.initiator, Ev.IO_CAPABILITY_REQUEST if self.simple else Ev.PIN_REQUEST)
            case Op.IO_CAPABILITY_REPLY:
                self._capabilities[who] = parameters
                self._ask(other, Ev.IO_CAPABILITY_RESPONSE, parameters)
                if len(self._capabilities) == 1:
                    self._ask(other, Ev.IO_CAPABILITY_REQUEST)
                else:
                    for each in (self.initiator, self.responder):
                        self._ask(each, Ev.CONFIRMATION_REQUEST, struct.pack("<I", CONFIRMATION))
            case Op.CONFIRM:
                self._confirmed.add(who)
                if len(self._confirmed) == 2:
                    self._paired(AUTHENTICATED if self._protected() else UNAUTHENTICATED)
            case Op.PIN_REPLY:
                self._pins[who] = parameters[1 : 1 + parameters[0]]
                if len(self._pins) == 1:
                    self._ask(self.responder, Ev.PIN_REQUEST)
                elif self._pins[other] == self._pins[who]:
                    self._paired(COMBINATION)
                else:
                    self._end(Status.AUTHENTICATION_FAILURE)
            case Op.IO_CAPABILITY_NEGATIVE_REPLY:
                self._refused(Status.PAIRING_NOT_ALLOWED)
            case Op.CONFIRM_NEGATIVE:
                self._refused(Status.AUTHENTICATION_FAILURE)
            case Op.PIN_NEGATIVE_REPLY:
                self._end(Status.KEY_MISSING)

    def _ask(self, who: str, code: int, more: bytes = b"") -> None:
        other = self.responder if who == self.initiator else self.initiator
        self._out.append((who, hci.event(code, hci.to_wire(other) + more)))

    def _protected(self) -> bool:
        """Whether people compare the numbers: one side wants it and both can."""
        capabilities = self._capabilities.values()
        return any(each[2] & PROTECTED for each in capabilities) and all(
            each[0] == DISPLAY_YES_NO for each in capabilities
        )

    def _paired(self, kind: int) -> None:
        key = self.new_key()
        for who, other in ((self.initiator, self.responder), (self.responder, self.initiator)):
            if self._capabilities:
                self._out.append((who, hci.event(Ev.SIMPLE_PAIRING_COMPLETE, b"\0" + hci.to_wire(other))))
            self._ask(who, Ev.LINK_KEY, key + bytes((kind,)))
        self._end(Status.SUCCESS)

    def _refused(self, code: int) -> None:
        for who, other in ((self.initiator, self.responder), (self.responder, self.initiator)):
            self._out.append((who, hci.event(Ev.SIMPLE_PAIRING_COMPLETE, bytes((code,)) + hci.to_wire(other))))
        self._end(code)

    def _end(self, code: int) -> None:
        """The air adds the event for the initiator, which names the link's handle."""
        self.status = code
