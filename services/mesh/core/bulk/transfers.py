"""Unicast messages that are larger than a packet: offered by who sends, fetched by who receives (`bulk.exchange`).

    sender --OFFER 5--> receiver        so many bytes, under this key; repeated until something comes back
           <--WANT----- ---PIECE-->     as long as it takes; whatever is lost is asked for again
           <--STATE---                  delivered, refused, or: no room now, offer it again later

The receiver delivers each message once for each pair of incarnations. Numbers of messages that are over are told
apart in a window, so that a late or repeated offer leads to the same answer and nothing else.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from services.mesh.core.bulk import pieces
from services.mesh.core.bulk.exchange import BulkExchange, total_of
from services.mesh.core.bulk.numbered import Limits, Outbound, Outgoing, SeenLives
from services.mesh.core.bulk.pieces import DONE, LATER, OFFER, REFUSED, STATE, MessageId, Packet
from services.mesh.core.wire.frames import BULK

MAX_SENDING = 64
MAX_SENDING_BYTES = 4 * 1024 * 1024
"""Messages of this robot that are on their way or wait for their turn, and their bytes; more are refused."""

MAX_OFFERED = 4
"""Most transfers to one robot that are under way at the same time."""

MAX_SPAN = 32
WINDOW = 64
"""Largest span of the numbers under way to one robot. A receiver distinguishes this many numbers."""

FIRST_WAIT = 0.3
LONGEST_WAIT = 2.0
"""Seconds until an offer is repeated, doubling; and while its receiver has no room, or fetches."""

SILENCE = 20.0
"""Seconds without a word of the receiver after which a message is given up."""

MAX_COMING_BYTES = 4 * 1024 * 1024
"""Bytes, as announced, of the messages of all senders that are on their way here;"""
MAX_COMING_EACH = 2 * 1024 * 1024
"""and of one sender."""

STALLED = 3.0
"""Seconds without a new piece after which a message makes room for another one."""

COUNTERS = ("unicast_large_later",)

_NEVER = float("inf")


@dataclass(eq=False)
class Parcel(Outgoing):
    """An own message until its end."""

    done: int = 0
    """Bytes the receiver has, as it says."""
    heard: float = 0.0
    """The time at which the receiver last said something."""
    wait: float = FIRST_WAIT


class Transfers:
    """Large unicast messages of one robot. Calls with `now` must not go back in time."""

    def __init__(
        self,
        me: str,
        incarnation: int,
        *,
        emit: Callable[[Packet], bool],
        admits: Callable[[str, str], bool],
        deliver: Callable[[str, bytes, int], None],
        ended: Callable[[object, str, str], None],
        counters: Counter[str],
    ) -> None:
        """As `Unicast`; `emit(packet)` says whether there is a way. `exchange` is to be set before anything comes."""
        self._me = me
        self._incarnation = incarnation
        self._emit = emit
        self._admits = admits
        self._deliver = deliver
        self._ended = ended
        self._counters = counters
        self.exchange: BulkExchange
        self._own = Outbound[Parcel](Limits(MAX_SENDING, MAX_SENDING_BYTES, MAX_OFFERED, MAX_SPAN), self._launch, ended)
        self._over = SeenLives(WINDOW)
        """Messages of others that were delivered, refused or given up."""
        self._keys: dict[MessageId, str] = {}
        """The keys of messages on their way here."""

    # -- own messages ------------------------------------------------------------------------------------------

    def send(self, token: object, to: str, key: str, payload: bytes, now: float, deadline: float) -> None:
        """Send; `ended` is called once for each."""
        if self._own.has_room(len(payload)):
            self._own.add(Parcel(token, to, key, payload, deadline), now)
            return
        problem = (
            f"{self._own.messages} large messages of {self._own.size} bytes are under way already; "
            f"{MAX_SENDING} and {MAX_SENDING_BYTES} bytes are allowed"
        )
        self._ended(token, to, problem)

    def give_up(self, to: str, key: str) -> None:
        """End the transfers to `to` under this key: a newer value replaces them."""
        self._own.give_up(to, key)

    def has(self, id: MessageId, to: str) -> bytes | None:
        """Return the payload of an own message that `to` may fetch."""
        parcel = self._own.get(to, id.number)
        ours = id.origin == self._me and id.incarnation == self._incarnation
        return parcel.payload if ours and parcel is not None else None

    def progress(self, token: object) -> tuple[int, int] | None:
        """Return how many bytes of an own message have arrived, and how many it has; None where it is not under way."""
        found = [parcel for parcel in self._own.all() if parcel.token == token]
        return (found[0].done, len(found[0].payload)) if found else None

    # -- packets -----------------------------------------------------------------------------------------------

    def wanted(self, peer: str, id: MessageId, have: int, now: float) -> None:
        """Note that a receiver asked for pieces."""
        parcel = self._own.get(peer, id.number)
        if parcel is not None and id.incarnation == self._incarnation:
            parcel.done = min(have * pieces.SIZE, len(parcel.payload))
            self._heard(parcel, now)

    def receive(self, packet: Packet, now: float) -> None:
        """Take an OFFER or a STATE for this robot. Raises `FrameError`."""
        if packet.kind == OFFER:
            total, key = pieces.decode_offer(packet.body)
            state = self._on_offer(packet.sender, packet.id, total, key, now)
            if state is not None:
                self._tell(packet.id, state)
        else:
            self._on_state(packet, pieces.decode_state(packet.body), now)

    def finished(self, id: MessageId, payload: bytes | None, now: float) -> None:
        """Take a message that was fetched; `payload` is None where it was given up."""
        key = self._keys.pop(id)
        if payload is not None and self._over.of(id.origin, id.incarnation).add(id.number):
            self._deliver(key, payload, BULK)
            self._tell(id, DONE)

    def ways_changed(self, now: float) -> None:
        """Offer at once each message of which nothing was heard, since there may be new routes."""
        for parcel in self._own.under_way():
            if parcel.heard + FIRST_WAIT <= now:
                self._offer(parcel, now)

    # -- time --------------------------------------------------------------------------------------------------

    def handle_timer(self, now: float) -> None:
        """Repeat, or give up."""
        for parcel in self._own.all():
            if now >= parcel.deadline:
                self._own.end(parcel, f"not all of it arrived at {parcel.to} in time", now)
            elif parcel.number and now >= parcel.heard + SILENCE:
                self._own.end(parcel, f"no answer from {parcel.to} for {SILENCE:g} s", now)
            elif now >= parcel.next_at:
                self._offer(parcel, now)

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        silence = min((parcel.heard + SILENCE for parcel in self._own.under_way()), default=_NEVER)
        return min(silence, self._own.next_deadline())

    # -- the sender's side -------------------------------------------------------------------------------------

    def _launch(self, parcel: Parcel, now: float) -> None:
        parcel.heard = now
        self._offer(parcel, now)

    def _offer(self, parcel: Parcel, now: float) -> None:
        id = MessageId(self._me, self._incarnation, parcel.number, flood=False)
        body = pieces.encode_offer(len(parcel.payload), parcel.key)
        self._emit(Packet(OFFER, self._me, parcel.to, id, body))
        parcel.next_at = now + parcel.wait
        parcel.wait = min(2 * parcel.wait, LONGEST_WAIT)

    def _heard(self, parcel: Parcel, now: float) -> None:
        parcel.heard = now
        parcel.next_at = now + LONGEST_WAIT

    def _on_state(self, packet: Packet, state: int, now: float) -> None:
        parcel = self._own.get(packet.sender, packet.id.number)
        if parcel is None or packet.id.incarnation != self._incarnation:
            return
        if state == LATER:
            self._heard(parcel, now)
        else:
            self._own.end(parcel, f"{parcel.to} lets no {parcel.key} in" if state == REFUSED else "", now)

    # -- the receiver's side -----------------------------------------------------------------------------------

    def _on_offer(self, sender: str, id: MessageId, total: int, key: str, now: float) -> int | None:
        """Return the answer to an offer; None where the pieces are asked for."""
        if not self._admits(sender, key):
            self._counters["unicast_refused"] += 1
            return REFUSED
        if self._over.of(id.origin, id.incarnation).has(id.number):
            self._counters["unicast_duplicates"] += 1
            return DONE
        if id in self._keys:
            return LATER  # it may wait for its turn: the sender is not to take this robot for silent
        if not self._make_room(sender, id, total, now):
            self._counters["unicast_large_later"] += 1
            return LATER
        self._keys[id] = key
        self.exchange.fetch(id, total, sender, now)
        return None

    def _make_room(self, sender: str, id: MessageId, total: int, now: float) -> bool:
        coming = [fetch for fetch in self.exchange.fetching if not fetch.id.flood]
        for fetch in coming:
            if fetch.id.origin == sender and fetch.id.incarnation != id.incarnation and fetch.heard + STALLED <= now:
                self.exchange.drop(fetch.id, now)  # its sender was started anew
        coming = [fetch for fetch in coming if fetch.id in self._keys]
        if total_of(fetch for fetch in coming if fetch.id.origin == sender) + total > MAX_COMING_EACH:
            return False
        for fetch in sorted(coming, key=lambda fetch: fetch.heard):
            if total_of(coming) + total <= MAX_COMING_BYTES:
                break
            if fetch.heard + STALLED <= now:
                self.exchange.drop(fetch.id, now)
                coming.remove(fetch)
        return total_of(coming) + total <= MAX_COMING_BYTES

    def _tell(self, id: MessageId, state: int) -> None:
        self._emit(Packet(STATE, self._me, id.origin, id, pieces.encode_state(state)))
