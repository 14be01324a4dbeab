"""Large messages of both overlays: one exchange of pieces (`core.exchange`), and those who want and have them."""

from collections import Counter
from collections.abc import Callable, Collection

from services.mesh.core.bulk import pieces
from services.mesh.core.bulk.exchange import Exchange
from services.mesh.core.bulk.pieces import Id, Packet
from services.mesh.core.bulk.transfers import Transfers
from services.mesh.core.overlays.large_floods import LargeFloods


class Large:
    """Calls with `now` must not go back in time."""

    def __init__(
        self,
        me: str,
        transfers: Transfers,
        floods: LargeFloods,
        *,
        emit: Callable[[Packet], bool],
        neighbours: Callable[[], Collection[str]],
        counters: Counter[str],
    ) -> None:
        """`emit(packet)` sends one, False where there is no way."""
        self._transfers = transfers
        self._floods = floods
        self._exchange = Exchange(
            me, emit=emit, has=self._has, finished=self._finished, others=neighbours, counters=counters
        )  # fmt: skip
        transfers.exchange = floods.exchange = self._exchange

    def receive(self, packet: Packet, now: float) -> None:
        """A packet for this robot; raises `FrameError`."""
        if packet.kind in (pieces.OFFER, pieces.STATE):
            self._transfers.receive(packet, now)
            return
        want = self._exchange.receive(packet, now)
        if want is not None and packet.id.flood:
            self._floods.wanted(packet.id, packet.sender, want.have, now)
        elif want is not None:
            self._transfers.wanted(packet.sender, packet.id, want.have, now)

    def ways_changed(self, now: float) -> None:
        """Routes are others than before."""
        self._exchange.ways_changed(now)
        self._transfers.ways_changed(now)

    def handle_timer(self, now: float) -> None:
        """Whatever is due."""
        self._exchange.handle_timer(now)
        self._transfers.handle_timer(now)

    def next_deadline(self) -> float:
        """When `handle_timer` wants to be called."""
        return min(self._exchange.next_deadline(), self._transfers.next_deadline())

    def _has(self, id: Id, peer: str) -> bytes | None:
        return self._floods.has(id) if id.flood else self._transfers.has(id, peer)

    def _finished(self, id: Id, payload: bytes | None, now: float) -> None:
        (self._floods if id.flood else self._transfers).finished(id, payload, now)
