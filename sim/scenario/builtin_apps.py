"""What a simulation of a built-in app has by default, where its command line says nothing else.

Figures that the report has of such an app alone are made in `sim.scene`.
"""

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # the command line needs no loader to be read
    from services.apps.loader import LoadedApp


class RunDefaults(NamedTuple):
    """The defaults of a simulated run of one app."""

    iterations: int = 100
    """Iterations after which the run ends."""
    lying: str | None = None
    """The side on which robots lie at the start; None: they stand."""
    waits_for_button: bool = False
    """Whether nothing happens until somebody presses a button."""
    clock_skew: float = 0.0
    """Largest rate error of the robots' clocks under virtual time; 0: all robots have one clock."""


USUAL = RunDefaults()

BY_NAME = {
    "flooding_demo": RunDefaults(waits_for_button=True),
    "formation": RunDefaults(iterations=600),
    "goto": RunDefaults(iterations=3000),  # at most: it ends when all have arrived
    "led_sync": RunDefaults(clock_skew=20e-6),  # that of crystals
    "stand_up": RunDefaults(iterations=5, lying="front", waits_for_button=True),
    "unicast_demo": RunDefaults(waits_for_button=True),
}
"""The built-in apps that differ from the usual."""


def defaults_of(app: "LoadedApp") -> RunDefaults:
    """Return the defaults of an app; an author's app may have the name of a built-in one, and has the usual ones."""
    return BY_NAME.get(app.name, USUAL) if app.is_built_in else USUAL
