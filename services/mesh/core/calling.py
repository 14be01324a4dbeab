"""Calls: those that this robot makes, and those of others from their arrival until the handshake is over.

A robot that has no link for a while knocks: it calls one of those that should call it. Who calls on a radio hears a
knock as a reason to call back at once, and makes no second connection of it. Once there is a link again, it knocks at
each of the others that still lack theirs once.

Robots that were apart while the hub changed have different hubs, so both of two robots may call, or both may wait.
Where both call, a second call of the robot with the lower name is no knock but makes the link. Where both wait, a knock
makes it, and a robot that lacks its hub knocks again every few minutes. Over the link they come to have the same hub.

`Callers` bounds what a stranger can cost us before we believe a word of it: `MAX_HALF_OPEN` handshakes at once for
all of them and `MAX_PER_SOURCE` for one address, and an address whose handshakes we refuse is shut out for a while.
An address of a neighbour has room of its own, which nobody else's calls take, and is never shut out: a neighbour that
was set up wrongly dials with a back-off of its own, and who forges its address must not be able to lock it out.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping

from services.mesh.core.actions import Actions, Dial, LinksChanged, Supervise
from services.mesh.core.link.calls import Caller, Local
from services.mesh.core.link.neighbour import Link
from services.mesh.core.link.session import Session
from services.mesh.core.routing.wanted_links import Linking

KNOCK = 12.0
"""Seconds between two looks of a robot whether it lacks links; up to twice that, so that robots do not look
together. A lost hub has a successor by then, whose radio a knock of 5 s would take."""

MAX_HALF_OPEN = 16
"""Handshakes of strangers, and of callers without a known address, at the same time."""

MAX_PER_SOURCE = 8
"""Handshakes of one address at the same time."""

FIRST_SHUT_OUT = 0.2
"""Seconds that an address is shut out after a refused handshake; doubles with each further one."""

LONGEST_SHUT_OUT = 5.0
"""s; as long as our own robots wait at most until they call again."""

AGAIN = 100.0
"""Seconds between two knocks of robots that reach each other, all together, at a hub that does not call them: the pages
of an absent hub, 5 s each, then take the share of time that the hub has for its own pages (`link.calls.SHARE`)."""

SUPERVISED = 1.25
"""Factor by which a link's end of patience must have changed until its transport is told again."""

_MAX_REMEMBERED = 256
"""Addresses whose refusals are remembered; the longest unheard of goes first."""

_NEVER = float("inf")


class Callers:
    """Remembers whom we refused."""

    def __init__(self) -> None:
        self._refused: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def refusal(self, caller: Caller, half_open: Iterable[Caller], now: float) -> tuple[str, str, str] | None:
        """Return why a caller may not begin its handshake: counter, problem and text; None where it may."""
        if caller.robot == "":
            text = f"connection refused: {caller.source} is the address of no robot of ours"
            return "refused_robot", "strange address", text
        if self.has_room(caller, half_open, now):
            return None
        limit = f"more than {MAX_HALF_OPEN} wait for their handshake, or the last ones from there were refused"
        text = f"connection refused source={caller.source or 'unknown'}: {limit}"
        return "half_open", "half-open connections", text

    def has_room(self, caller: Caller, half_open: Iterable[Caller], now: float) -> bool:
        """Return whether a caller may begin its handshake while those of `half_open` are in theirs."""
        if now < self._refused.get(caller.source, (0, 0.0))[1]:
            return False
        same = strangers = 0
        for other in half_open:
            same += caller.source == other.source != ""
            strangers += not other.has_own_room
        return same < MAX_PER_SOURCE and (caller.has_own_room or strangers < MAX_HALF_OPEN)

    def refused(self, caller: Caller, now: float) -> None:
        """Note that a handshake of this caller was refused."""
        if caller.has_own_room or not caller.source:
            return
        count, _ = self._refused.pop(caller.source, (0, 0.0))
        self._refused[caller.source] = count + 1, now + min(LONGEST_SHUT_OUT, FIRST_SHUT_OUT * 2.0 ** min(count, 16))
        if len(self._refused) > _MAX_REMEMBERED:
            self._refused.popitem(last=False)

    def confirmed(self, caller: Caller) -> None:
        """Forget the refusals of a caller that has proved to be a robot of the swarm."""
        self._refused.pop(caller.source, None)


class Calling:
    """The calls of one robot."""

    def __init__(
        self, local: Local, linking: Linking, links: Mapping[str, Link], actions: Actions, random: Callable[[], float]
    ) -> None:
        """`links` are those of this robot, as they change; `random` gives numbers from 0 up to 1."""
        self._local = local
        self._linking = linking
        self._links = links
        self._actions = actions
        self._random = random
        self._callers = Callers()
        self._half_open: dict[Session, Caller] = {}
        self._calls: dict[str, float] = {}
        """Robots that we are calling, and since when we have called nobody else before them."""
        self._look_at = 0.0 if local.pages else _NEVER
        """The time of the next check whether this robot has no link."""
        self._alone = False
        self._owed = set(self._callers_of_this())
        """Robots at which to knock once although there is a link: they may have taken this one for absent while it had
        none, as at the start."""
        self._lacked: set[str] = set()
        """The robots of `_owed` with which there was no link at the last look."""
        self._knocks = 0
        self._owed_since = 0.0
        """The time at which this robot last came to owe knocks to all that should call it."""
        self._again = AGAIN
        self._knocked: set[str] = set()
        """Robots whose call was taken for a knock, and with which there has been no link since."""

    # -- own calls -------------------------------------------------------------------------------------------

    def call(self, link: Link, now: float) -> None:
        """Call a neighbour."""
        link.attempt = True
        self._calls[link.peer] = now
        self._actions.add(Dial(link.peer))

    def called(self, peer: str, now: float) -> float:
        """Note that a call is over. Return how long the radio was busy with it: calls wait for one another."""
        began = self._calls.pop(peer, now)
        for other in self._calls:
            self._calls[other] = now
        return now - began

    def handle_timer(self, now: float) -> None:
        """Call the neighbours whose time has come."""
        for link in tuple(self._links.values()):
            if link.session is None and link.dialler is not None and link.dialler.take(now):
                self.call(link, now)
                self._actions.add(LinksChanged())

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` or `to_knock_at` has something to do."""
        earliest = self._look_at
        for link in self._links.values():
            if link.session is None and link.dialler is not None:
                deadline = link.dialler.next_deadline()
                if deadline is not None and deadline < earliest:
                    earliest = deadline
        return earliest

    def patience(self, peer: str) -> float:
        """Return how long a handshake with a neighbour that this robot has called may take, s: longer after calls in
        vain."""
        link, least = self._links.get(peer), self._local.times.handshake
        doubled = 0 if link is None else min(link.unanswered, 16)
        return min(least * 2.0**doubled, max(self._local.times.patience, least))

    def lost(self) -> None:
        """Note that a link has ended."""
        if not any(link.session for link in self._links.values()):
            self._owed = set(self._callers_of_this())

    def to_knock_at(self, now: float) -> str | None:
        """Return the robot at which to knock now; None where there is none, or this one need not look yet."""
        if now < self._look_at:
            return None
        self._look_at = now + KNOCK * (1.0 + self._random())
        self._owe_again(now)
        before, self._alone = self._alone, not any(link.session or link.attempt for link in self._links.values())
        callers = self._callers_of_this()
        if not self._alone:
            # Only those missing at the last look, too: where a call is under way, a knock would collide with it.
            lacked, self._lacked = self._lacked, {name for name in self._owed if self._lacks(name)}
            callers = [name for name in callers if name in lacked & self._lacked]
        elif before:
            self._lacked = set(self._owed)
            callers = [name for name in callers if self._linking.carried or self._lacks(name)]
        else:
            self._lacked, callers = set(), []
        if not callers:
            return None
        self._knocks += 1
        caller = callers[(self._knocks - 1) % len(callers)]
        if not self._alone:
            self._owed.discard(caller)
        return caller

    def _owe_again(self, now: float) -> None:
        """Owe a knock again, from time to time, to all that should call this robot: where the hub can change, they may
        have another hub than this robot and wait for its call."""
        if self._linking.hub() is None:
            return
        together = 1 + sum(map(self._linking.is_reachable, self._local.dials))
        if now >= self._owed_since + self._again * together:
            self._owed = set(self._callers_of_this())
            # Spread, so that robots that have lost a hub together do not knock together.
            self._owed_since, self._again = now, AGAIN * (0.5 + self._random())

    def _callers_of_this(self) -> list[str]:
        """Return the robots that are to call this one."""
        return [name for name, dials in self._local.dials.items() if not dials]

    def _lacks(self, name: str) -> bool:
        """Return whether there is to be a link with a robot, and is none."""
        link = self._links.get(name)
        return link is not None and link.lasting and link.session is None and not link.attempt

    # -- calls of others -------------------------------------------------------------------------------------

    def refusal(self, caller: Caller, now: float) -> tuple[str, str, str] | None:
        """Return why a caller may not begin its handshake: counter, problem and text; None where it may."""
        return self._callers.refusal(caller, self._half_open.values(), now)

    def is_knock(self, robot: str, now: float) -> bool:
        """Return whether a call is a knock of a robot that this one calls; then it is called soon."""
        link = self._links.get(robot)
        if not self._local.pages or not self._local.dials.get(robot) or (link is not None and link.session is not None):
            return False
        if self.may_call(robot):
            return False
        if self._linking.hub() is not None:
            self._knocked.add(robot)
        if link is not None and link.dialler is not None:
            link.dialler.hurry(now)
        else:
            self._linking.knocked(robot, now)
        return True

    def may_call(self, robot: str) -> bool:
        """Return whether a robot that this one calls may call it: the robot has knocked and there is still no link, so
        each of the two may take the other's calls for knocks. Only the robot with the lower name may, for the two must
        not replace each other's connection."""
        return robot in self._knocked and robot < self._local.robot

    def supervise(self, peer: str, session: Session) -> None:
        """Have the transport of a link that is ours to call know how long silence may last, where that has changed by
        much. The other robot may have called: then another hub has been chosen since."""
        if not self._local.dials.get(peer):
            session.supervised = 0.0
            return
        seconds = session.dead_after
        if not seconds / SUPERVISED <= session.supervised <= seconds * SUPERVISED:
            session.supervised = seconds
            self._actions.add(Supervise(session, seconds))

    def begun(self, session: Session, caller: Caller) -> None:
        """The handshake with a caller begins."""
        self._half_open[session] = caller

    def confirmed(self, session: Session) -> None:
        """Note that a handshake has succeeded."""
        self._alone = False
        self._knocked.discard(session.peer or "")
        if (caller := self._half_open.pop(session, None)) is not None:
            self._callers.confirmed(caller)

    def failed(self, session: Session, now: float, *, refused: bool) -> tuple[str, str]:
        """Note that a handshake has failed. Return its peer and the caller's address; `refused`: this robot refused
        it."""
        caller = self._half_open.pop(session, None)
        if caller is not None and refused:
            self._callers.refused(caller, now)
        robot, source = (None, "") if caller is None else (caller.robot, caller.source)
        self._knocked.discard(robot or "")  # its next call is a knock again: perhaps this robot reaches it
        return robot or session.dialled or "a caller", source
