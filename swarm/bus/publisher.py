"""The publisher of one key, which knows whether anybody listens."""

from swarm import clock
from swarm.bus.zenoh_runtime import direct, zenoh
from swarm.messages.keys import STOP

_CERTAIN_S = 1.0
"""Seconds after which a router has told who listens."""
_ARM = "/mesh/set/arm"
"""What the keys end with that take stops back."""


class Audience:
    """The knowledge of whether anybody listens to a key, as far as the router has told."""

    def __init__(self) -> None:
        self.doubt()

    def doubt(self) -> None:
        """Take the audience to be there until `ask_at`, when the router is asked anew. What it tells meanwhile does not
        count."""
        self.there, self.sure, self.ask_at = True, False, clock.now() + _CERTAIN_S

    def matched(self, status: zenoh.MatchingStatus) -> None:
        """Note that the audience has come or gone."""
        if self.sure:
            self.there = status.matching


class Publisher:
    """A declared publisher: it costs half the CPU time of a plain put, and hardly any where nobody listens to its key.

    Zenoh would not send that either. But what decides so is not in the processor's caches when a message comes: a
    twentieth of a mesh's CPU time was in Zenoh's library for what nobody heard.
    """

    def __init__(self, session: zenoh.Session, key: str, *, urgent: bool) -> None:
        """Raises `zenoh.ZError` where the bus does not take the key."""
        # Zenoh holds what it calls, so that must not be this: nothing would ever let go of it.
        self.audience = Audience()
        self._publisher = session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=_priority(key, urgent),
            # Subscribers hear other sessions only; else those of this one would be its audience.
            allowed_destination=zenoh.Locality.REMOTE,
        )
        self._listener = self._publisher.declare_matching_listener(direct(self.audience.matched))

    def heard(self) -> bool:
        """Return whether anybody may listen. Raises `zenoh.ZError`."""
        audience = self.audience
        if audience.sure and audience.there:
            return True
        now = clock.now()
        if now < audience.ask_at:
            return audience.there
        # In this order, since who comes meanwhile is told of by `matched`.
        audience.sure, audience.there, audience.ask_at = True, False, now + _CERTAIN_S
        if self._publisher.matching_status.matching:  # type: ignore[attr-defined]
            audience.there = True
        # One message a second goes to Zenoh whatever it says of listeners: were its word wrong, lost, or overtaken by
        # an older one, this key would be silent for ever. Where nobody listens it goes no further.
        return True

    def put(self, payload: bytes, encoding: str) -> None:
        """Publish `payload`. Raises `zenoh.ZError`."""
        self._publisher.put(payload, encoding=encoding)


def _priority(key: str, urgent: bool) -> zenoh.Priority:
    """Stops have a queue of their own, here as in the router: they wait for nothing else, however urgent it is. What
    takes them back shares it, since whoever arms the swarm and then stops it must be heard in this order."""
    if key == STOP or key.endswith(_ARM):
        return zenoh.Priority.REAL_TIME
    return zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA
