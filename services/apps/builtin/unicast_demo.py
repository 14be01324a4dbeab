"""Buttons send a message to one robot, over as many links as it takes (thesis 3.4.6).

See docs/reference/apps/unicast_demo.md.
"""

from collections.abc import Mapping
from typing import Any

from services.apps.builtin.show import ShowingApp
from swarm.messages import Flooded, Sent
from swarm.messages.codec import Value

BUTTONS = ("a", "b", "c")
TIMEOUT_S = 10.0


class UnicastDemo(ShowingApp):
    """Buttons A, B and C send to the next robot of swarm.toml, the one after it, and the third.

    Yellow at the sender until the receiver's mesh has confirmed it, then green; green at the receiver; red where it was
    not delivered in 10 s. Robots on the way only forward: they stay dark.
    """

    sent: int = 0
    delivered: int = 0
    received: int = 0
    _under_way: dict[str, tuple[str, float]]
    """The receiver and the time of each message under way, by ticket."""

    def start(self) -> None:
        self._under_way = {}
        self.robot.display("unicast: press a", "button", f"A {self._target('a')}", f"B {self._target('b')}")

    def on_button(self, button: str) -> None:
        """Send a text to the robot of this button."""
        to = self._target(button)
        if to == self.robot.name:
            self.show("alone", f"no robot for {button.upper()}", red=True)
            return
        self.sent += 1
        text = f"{self.robot.name} to {to}: {self.sent}"
        ticket = self.robot.send(to, text.encode(), priority="sync", timeout=TIMEOUT_S).ticket
        self._under_way[ticket] = (to, self.robot.now)
        self.show("sent", text, yellow=True)

    def on_message(self, message: Any) -> None:
        """Show that the message has arrived here."""
        self.received += 1
        self.show("received", message.payload.decode(errors="replace"), green=True)

    def on_answer(self, ticket: str, outcome: Flooded | Sent) -> None:
        """Show whether the text was delivered, and the time that it took."""
        assert isinstance(outcome, Sent)
        to, began = self._under_way.pop(ticket)
        took = self.robot.now - began
        self.robot.record("took", took)
        if outcome.delivered:
            self.delivered += 1
            self.show("delivered", f"{to} has it, {1e3 * took:.0f} ms", green=True)
        else:
            self.show("lost", f"{to}: {outcome.problem}", red=True)

    def _target(self, button: str) -> str:
        swarm = self.robot.swarm
        return swarm[(swarm.index(self.robot.name) + 1 + BUTTONS.index(button)) % len(swarm)]

    def result(self) -> Mapping[str, Value]:
        """Messages sent, delivered, and received from others."""
        return {"sent": self.sent, "delivered": self.delivered, "received": self.received}
