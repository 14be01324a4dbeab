"""The steps from a fresh Raspberry Pi OS Lite to a robot, one idea each.

A step judges the robot's facts (`swarm.onboard.bootstrap.facts`): they are fine as they are, they are to be changed, or
they cannot be helped. The same judgement, of facts gathered anew, verifies the change. Nothing is changed on a robot
while any step that comes before packages (`FIRST`) cannot be helped.
"""

from laptop.fleet.core import packages, provision_checks, settings
from laptop.fleet.core.wish import MIN_FREE, ProvisioningStep

REBOOT = "/run/swarm-reboot-needed"
"""A file on the robot. It holds the id of the boot in which a step changed something that needs another boot."""

LOOK = {
    "files": [*settings.FILES, REBOOT],
    "links": [*packages.FIRMWARE],
    "there": [
        "/etc/cloud",
        *(f"{packages.SYNAPTICS}/{name}" for name in packages.FIRMWARE.values()),
    ],
    "disks": [*MIN_FREE],
    "units": ["bluetooth.service"],
}
"""The request for the facts that the steps need."""

FIRST = (
    ProvisioningStep("board", provision_checks.board),
    ProvisioningStep("system", provision_checks.system),
    ProvisioningStep("disk", provision_checks.disk),
    ProvisioningStep("key", provision_checks.key),
    ProvisioningStep("address", provision_checks.address),
    ProvisioningStep("clock", provision_checks.clock),
    ProvisioningStep("packages", packages.packages),
    ProvisioningStep("kernel", packages.kernel),
)
"""Steps that are all judged before anything is changed."""

THEN = (
    ProvisioningStep("boot", settings.boot),
    ProvisioningStep("cmdline", settings.cmdline),
    ProvisioningStep("i2c", settings.i2c),
    ProvisioningStep("radio", packages.radio),
    ProvisioningStep("bluetooth", settings.bluetooth),
    ProvisioningStep("realtime", settings.realtime),
    ProvisioningStep("network", settings.network),
    ProvisioningStep("name", settings.name),
)
"""Steps that are judged when the packages are there."""
