"""Robots that touch under virtual time: while one moves, all bodies near it are looked at.

Bodies that stand still are not asked, so a run in which nobody drives costs nothing.
"""

from collections.abc import Mapping

from services.balancer.bridge.link import TELEMETRY_S
from sim.core.contacts import Contacts
from sim.virtual.events import EventQueue
from sim.virtual.robot.balancer import VirtualBalancer


class ContactWatch:
    """Looks each `TELEMETRY_S` at the robots that move, and lets those that touch feel it."""

    def __init__(self, time: EventQueue, contacts: Contacts, balancers: Mapping[str, VirtualBalancer]) -> None:
        self._time, self._contacts, self._balancers = time, contacts, balancers
        self._moving: dict[str, None] = {}
        self._looking = False
        for name, balancer in balancers.items():
            balancer.begins_to_move = self._begins
            body = balancer.body
            contacts.pose(name, time.now, (body.x, body.y), body.heading, 0.0, body.tilt)

    def _begins(self, robot: str) -> None:
        self._moving[robot] = None
        if not self._looking:
            self._looking = True
            self._time.at(self._time.now + TELEMETRY_S, self._look)

    def _look(self) -> None:
        now = self._time.now
        for name in tuple(self._moving):
            body = self._balancers[name].look()
            speed = body.demand[0] if body.moves else 0.0
            if not body.moves:
                del self._moving[name]
            for hit in self._contacts.pose(name, now, (body.x, body.y), body.heading, speed, body.tilt):
                balancer = self._balancers[hit.robot]
                balancer.act(hit.knock(balancer.body.heading))
                self._moving[hit.robot] = None  # it may fall, which the next look sees
        self._looking = bool(self._moving)
        if self._looking:
            self._time.at(now + TELEMETRY_S, self._look)
