"""Messages of the mesh's overlays for apps: floods, and messages to one robot."""

from swarm.frozen import frozen
from swarm.messages.codec import MAX_REQUEST, Short, with_telemetry


@frozen
class FloodRequest:
    """Command on `mesh/set/flood`: carry a payload to the whole swarm, and say in `mesh/flooded` whom it reached.

    It appears on every other robot's bus, raw, under `swarm/<this robot>/app/<app>/flood`.
    """

    LIMIT = MAX_REQUEST
    ticket: Short
    """The name of this request. A repetition of it gets the same answer and is not flooded again."""
    app: Short
    payload: bytes
    priority: Short
    """control, sync or bulk."""
    announce: bool
    """Whether every robot is to learn that all have it."""


@frozen
class Flooded:
    """End of a flood, on `swarm/<origin>/mesh/flooded` at its origin, and elsewhere where all are to know it."""

    t: float
    """The time at which this robot learned it."""
    ticket: str
    """The ticket of the request at the origin; empty on other robots."""
    app: str
    robots: tuple[str, ...]
    """The robots that it reached, besides the origin."""
    complete: bool
    """Whether these are all robots that could be reached."""
    problem: str
    """Why it is not complete; empty otherwise."""


@frozen
class SendRequest:
    """Command on `mesh/set/send`: carry a payload to one robot, and say in `mesh/sent` whether it arrived.

    It appears on that robot's bus, raw, under `swarm/<this robot>/app/<app>/send/<to>`.
    """

    LIMIT = MAX_REQUEST
    ticket: Short
    app: Short
    to: Short
    payload: bytes
    priority: Short
    timeout: float
    """Seconds after which the message is given up."""


@frozen
class Reminder:
    """Command on `mesh/set/remind`: tell the answer to a request again or, where there is none yet, a `Progress`."""

    ticket: Short


@frozen
class Progress:
    """The progress of a request, on `swarm/<robot>/mesh/progress`."""

    t: float
    ticket: str
    known: bool
    """Whether the mesh knows the request. An unknown request was lost and must be made again."""
    size: int
    """Bytes of the payload; 0 for a small one, whose progress is not worth reporting."""
    moved: int
    """Bytes that have arrived: at the receiver, or at every neighbour that hands a flood on."""


@frozen
class Sent:
    """End of a message, on `swarm/<robot>/mesh/sent`."""

    t: float
    ticket: str
    app: str
    to: str
    delivered: bool
    """Whether the other robot's mesh has confirmed it."""
    problem: str
    """Why it was not confirmed; empty otherwise. The message may have arrived nevertheless if the answer was lost."""


@frozen
class Passed:
    """A message of an app, or the answer to one, was handed to a neighbour, on `swarm/<robot>/mesh/passed` of each
    robot on its way: so one sees which way it took, and when. Not of messages larger than a packet."""

    t: float
    app: str
    """The app; empty for an answer, which does not name it."""
    sender: str
    """The robot that has sent the message, also where this is the answer."""
    to: str
    number: int
    """Counts what the sender's mesh has sent to that robot since its start."""
    back: bool
    """Whether this is the answer on its way back."""
    next: str
    """The neighbour to which it went."""
    ticket: str
    """The ticket at the sender; empty elsewhere."""


TOPICS = with_telemetry(
    {
        ("mesh", "flooded"): Flooded,
        ("mesh", "sent"): Sent,
        ("mesh", "passed"): Passed,
        ("mesh", "set/flood"): FloodRequest,
        ("mesh", "set/send"): SendRequest,
        ("mesh", "set/remind"): Reminder,
        ("mesh", "progress"): Progress,
    }
)
"""Message type of each key, by (service, topic)."""
