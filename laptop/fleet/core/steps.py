"""The steps from a fresh Raspberry Pi OS Lite to a robot, one idea each.

A step judges the robot's facts (`swarm.onboard.bootstrap.facts`): they are fine as they are, they are to be changed, or
they cannot be helped. The same judgement, of facts gathered anew, verifies the change. Nothing is changed on a robot
while any step that comes before packages (`FIRST`) cannot be helped.
"""

from laptop.fleet.core import before, packages, settings
from laptop.fleet.core.wish import MIN_FREE, Step

LOOK = {
    "files": [*settings.FILES],
    "links": [*packages.FIRMWARE],
    "there": [
        "/etc/cloud",
        "/etc/swarm/key",
        *(f"{packages.SYNAPTICS}/{name}" for name in packages.FIRMWARE.values()),
    ],
    "disks": [*MIN_FREE],
    "units": ["bluetooth.service"],
}
"""The request for the facts that the steps need."""

FIRST = (
    Step("board", before.board),
    Step("system", before.system),
    Step("disk", before.disk),
    Step("key", before.key),
    Step("address", before.address),
    Step("clock", before.clock),
    Step("packages", packages.packages),
    Step("kernel", packages.kernel),
)
"""All of these are judged before anything is changed."""

THEN = (
    Step("boot", settings.boot),
    Step("cmdline", settings.cmdline),
    Step("i2c", settings.i2c),
    Step("radio", packages.radio),
    Step("bluetooth", settings.bluetooth),
    Step("realtime", settings.realtime),
    Step("network", settings.network),
    Step("name", settings.name),
)
"""These are judged when the packages are there."""
