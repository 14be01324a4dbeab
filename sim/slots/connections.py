"""Connections over the links of a slot radio: pairs of ends that pass on bytes in order, as sockets of RFCOMM do.

Virtual runs and the radio process of real ones share this: they differ in where an end's bytes come from and go.
"""

from collections.abc import Callable, Iterable
from random import Random

from services.mesh.links.rfcomm import DIAL_TIMEOUT
from sim.slots.calls import Calls
from sim.slots.devices import RadioLink
from sim.slots.parameters import FRAME, SlotParameters
from sim.slots.radio import EventClock, SlotRadio
from swarm.bluetooth.hci import SUPERVISION_SHARE

CHUNK = 4096
"""Bytes taken from an end at a time, as `services.mesh.sockets` does."""
SOCKET = 50_000
"""Bytes that the sender's socket takes, as `services.mesh.links.sim.SEND_BUFFER` has it."""


class End:
    """One end of a connection."""

    def __init__(self, robot: str, link: RadioLink) -> None:
        self.robot = robot
        self.link = link
        self.other: End = self
        self.alive = True
        """False once this end has closed, or has noticed that the other one has."""
        self.backlog = 0
        """Bytes that have not reached the other end."""
        self.full = False
        """Whether the robot does not read what has arrived here; then the other end sends nothing more."""

    def take(self) -> bytes | None:
        """Return the next bytes to send, b"" where there are none now, None where the robot has closed this end."""
        raise NotImplementedError

    def give(self, data: bytes) -> None:
        """Take bytes of the other end; b"" says that the other end has closed."""
        raise NotImplementedError

    def lost(self) -> None:
        """Note that the radio has given the link up."""
        raise NotImplementedError


class RadioConnections:
    """All connections of a swarm."""

    def __init__(self, clock: EventClock, names: Iterable[str], parameters: SlotParameters, seed: object) -> None:
        self._clock = clock
        self.radio = SlotRadio(clock, names, parameters, Random(f"{seed} slots"))
        self.radio.passes = self._passes
        self._calls = Calls(clock, self.radio)
        self.reachable = self._calls.reachable
        """The robots that can be called."""
        self.cuts: dict[frozenset[str], float] = {}
        """The time until which nothing passes between two robots."""

    def cut(self, a: str, b: str, seconds: float) -> None:
        """Let nothing pass between two robots for a while, or as long as an earlier cut lasts; 0 ends that."""
        pair, until = frozenset((a, b)), self._clock.now + seconds
        self.cuts[pair] = max(self.cuts.get(pair, 0.0), until) if seconds else until

    def call(self, caller: str, called: str, done: Callable[[RadioLink | None, str], None]) -> None:
        """Make a link; see `Calls.call`."""
        self._calls.call(caller, called, DIAL_TIMEOUT, done)

    def switch_off(self, robot: str) -> None:
        """Let a robot that loses its power fall silent: its neighbours lose their links by supervision."""
        self.radio.switch_off(robot)
        self._calls.switch_off(robot)

    def join(self, near: End, far: End) -> None:
        """Make a connection of two ends of one link."""
        near.other, far.other = far, near
        near.link.lost = lambda: self._lost(near, far)

    @staticmethod
    def wants(end: End) -> bool:
        """Return whether an end's socket takes more of its robot."""
        return end.alive and end.backlog < SOCKET and not end.other.full

    def flush(self, end: End) -> None:
        """Hand what an end has to send to the radio, as far as its socket takes it."""
        while self.wants(end):
            data = end.take()
            if data is None:
                self.close(end)
            elif not data:
                return
            else:
                for at in range(0, len(data), FRAME):
                    self._send(end, data[at : at + FRAME])

    def close(self, end: End) -> None:
        """Close an end: the other one hears of it after what was sent before, or when the radio gives the link up."""
        if end.alive:
            end.alive = False
            if end.other.alive:
                self._send(end, b"")
            else:
                self.radio.drop(end.link)

    def supervise(self, end: End, seconds: float) -> None:
        """Have the robot of an end be the central, and the radio give the connection up after somewhat less silence."""
        self.radio.be_central(end.robot, end.link)
        self.radio.supervise(end.link, SUPERVISION_SHARE * seconds)

    def _passes(self, a: str, b: str) -> bool:
        return not self.cuts or self.cuts.get(frozenset((a, b)), 0.0) <= self._clock.now

    @staticmethod
    def _lost(*ends: End) -> None:
        for end in ends:
            if end.alive:
                end.alive = False
                end.lost()

    def _send(self, end: End, data: bytes) -> None:
        end.backlog += len(data)
        self.radio.send(end.link, end.robot, len(data), lambda: self._arrived(end, data))

    def _arrived(self, sender: End, data: bytes) -> None:
        receiver = sender.other
        sender.backlog -= len(data)
        if receiver.alive:
            receiver.alive = bool(data)
            receiver.give(data)
        if not receiver.alive and not sender.alive:
            self.radio.drop(sender.link)
        else:
            self.flush(sender)
