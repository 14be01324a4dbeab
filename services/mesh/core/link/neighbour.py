"""One neighbour as a node keeps it: the connection in use, and what is told of all connections so far."""

from collections.abc import Callable

from services.mesh.core.link.dialler import Dialler
from services.mesh.core.link.session import CONNECTING, DOWN, Session
from swarm.messages import LinkState


class Link:
    """One robot that this one has a link with, or is to have."""

    __slots__ = (
        "attempt",
        "connection",
        "dialler",
        "dropped",
        "lasting",
        "peer",
        "reason",
        "received",
        "received_bytes",
        "refused",
        "sent",
        "sent_bytes",
        "session",
        "since",
    )

    def __init__(self, peer: str) -> None:
        self.peer = peer
        self.dialler: Dialler | None = None
        """None where the neighbour dials us, or is only called once."""
        self.lasting = False
        """Whether the link is to be there; else it is one as long as it is up."""
        self.session: Session | None = None
        """The connection in use, once it is up."""
        self.since = 0.0
        """When that connection came up."""
        self.attempt = False
        """Whether our dialling, or the handshake after it, is under way."""
        self.connection = 0
        self.reason = "not connected yet"
        self.sent = 0
        """Frames of earlier connections."""
        self.received = 0
        self.sent_bytes = 0
        self.received_bytes = 0
        self.dropped = 0
        """Messages lost while the link was down, or in the queues of earlier connections."""
        self.refused = 0

    def keep(self, random: Callable[[], float] | None) -> None:
        """The link is to last; `random` where we are the one who dials."""
        self.lasting = True
        if self.dialler is None and random is not None:
            self.dialler = Dialler(random)
            if self.attempt or self.session is not None:
                self.dialler.take(0.0)  # its first call is under way already

    def failed(self, reason: str, now: float) -> None:
        """A connection that we tried to make did not come about."""
        self.attempt = False
        self.reason = reason
        if self.dialler is not None:
            self.dialler.ended(now)

    def detach(self, session: Session, reason: str, now: float) -> None:
        """The connection in use is lost, or is given up."""
        self.session = None
        self.reason = reason
        self.sent += session.sent
        self.received += session.received
        self.sent_bytes += session.sent_bytes
        self.received_bytes += session.received_bytes
        self.dropped += session.queue.dropped
        if self.dialler is not None:
            self.dialler.ended(now)

    def state(self) -> LinkState:
        """For the key `mesh/links`."""
        session = self.session
        if session is None:
            state = CONNECTING if self.attempt else DOWN
            return LinkState(
                self.peer,
                state,
                self.connection,
                None,
                self.sent,
                self.received,
                self.reason,
                sent_bytes=self.sent_bytes,
                received_bytes=self.received_bytes,
                dropped=self.dropped,
                refused=self.refused,
            )
        pulse, window = session.pulse, session.window
        rtts = sorted(pulse.rtts)
        return LinkState(
            self.peer,
            session.state,
            self.connection,
            pulse.rtt,
            self.sent + session.sent,
            self.received + session.received,
            "",
            rtt_min=rtts[0] if rtts else None,
            rtt_median=rtts[len(rtts) // 2] if rtts else None,
            rtt_p99=rtts[len(rtts) * 99 // 100] if rtts else None,
            sent_rate=pulse.sent_rate,
            received_rate=pulse.received_rate,
            sent_bytes=self.sent_bytes + session.sent_bytes,
            received_bytes=self.received_bytes + session.received_bytes,
            queue=session.queue.waiting_bytes,
            in_flight=window.in_flight,
            window=int(window.limit),
            dropped=self.dropped + session.queue.dropped,
            refused=self.refused,
        )
