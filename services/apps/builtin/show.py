"""The common part of apps that show on LEDs and display what has happened to a message."""

from swarm import EventApp

SHOWN_S = 3.0
"""Seconds after the last message after which the LEDs go off, as in the thesis."""


class ShowingApp(EventApp):
    """Base of apps that call `show`."""

    def show(self, what: str, text: str, *, red: bool = False, yellow: bool = False, green: bool = False) -> None:
        """Record a text as `what`, and show it together with these LEDs for a while."""
        self.robot.record(what, text)
        self.robot.display(what, text)
        self.robot.leds(red=red, yellow=yellow, green=green)
        self.robot.after(SHOWN_S, "dark")

    def on_timer(self, name: str) -> None:
        """Switch the LEDs off."""
        self.robot.leds(red=False, yellow=False, green=False)
