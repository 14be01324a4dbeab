"""A button floods the robot's name to the whole swarm (thesis 3.4.5). docs/reference/apps/flooding_demo.md."""

from collections.abc import Mapping
from typing import Any

from services.apps.builtin.show import ShowingApp
from swarm.messages import Flooded, Sent
from swarm.messages.codec import Value


class FloodingDemo(ShowingApp):
    """Any button floods a message. A robot that has it shows yellow; all show green when the last one has it."""

    floods: int = 0
    """Number of own floods so far."""
    heard: int = 0
    """Number of other robots' floods."""
    complete: int = 0
    """Floods, own and others', of which this robot knows that all have them."""
    _lost: int = 0
    _began: dict[str, float]

    def start(self) -> None:
        self._began = {}
        self.robot.display("flooding: press a", "button")

    def on_button(self, button: str) -> None:
        """Flood a text with the number of this press."""
        self.floods += 1
        text = f"{self.robot.name} says {button} {self.floods}"
        ticket = self.robot.flood(text.encode(), priority="sync", announce=True).ticket
        self._began[ticket] = self.robot.now
        self.show("sent", text, yellow=True)

    def on_message(self, message: Any) -> None:
        """Show that the message has arrived here."""
        self.heard += 1
        self.show("heard", message.payload.decode(errors="replace"), yellow=True)

    def on_answer(self, ticket: str, outcome: Flooded | Sent) -> None:
        """Show whether all robots have our text, and the time that it took."""
        assert isinstance(outcome, Flooded)
        took = self.robot.now - self._began.pop(ticket, self.robot.now)
        self.robot.record("took", took)
        if outcome.complete:
            self.complete += 1
            self.show("complete", f"{len(outcome.robots)} reached, {1e3 * took:.0f} ms", green=True)
        else:
            self._lost += 1
            self.show("incomplete", f"{len(outcome.robots)} reached: {outcome.problem}", red=True)

    def on_announced(self, origin: str, outcome: Flooded) -> None:
        """Show that all robots have the text of another one."""
        if outcome.complete:
            self.complete += 1
            self.show("complete", f"all have {origin}'s", green=True)

    def result(self) -> Mapping[str, Value]:
        """Floods sent, heard, known to be complete, and incomplete."""
        return {"floods": self.floods, "heard": self.heard, "complete": self.complete, "incomplete": self._lost}
