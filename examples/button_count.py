"""Count the button presses of the whole swarm: a press is flooded, every robot counts and shows what it heard."""

from swarm import EventApp


class ButtonCount(EventApp):
    """`swarm sim examples/button_count.py`, and elsewhere `swarm hand press r1 A`."""

    presses: int

    def on_button(self, button):
        """Tell all others, and count it here."""
        self.robot.flood(button.encode())
        self.count(self.robot.name, button)

    def on_message(self, message):
        """A press on another robot."""
        self.count(message.sender, message.payload.decode())

    def count(self, robot, button):
        """Show who pressed what."""
        self.presses += 1
        self.robot.display(f"{self.presses} presses", f"last: {button} on {robot}")
