"""The commands of `swarm` on a robot. A laptop adds its own (`laptop.cli.commands`), which a robot does not carry.

Tools of a service are named here and imported when they are used: no module of `swarm` depends on a service.
"""

from typing import NoReturn

from swarm.onboard.command_line import Command, CommandGroup, Sections, main

ESTOP = "stop every robot, and list the robots that confirmed (also: swarm stop)"

MESH = CommandGroup(
    "show robots and links; change topology or members",
    {
        "show": Command("swarm.onboard.mesh.show", help="show the robots of the swarm, their links and the graph"),
        "topology": Command("swarm.onboard.mesh.topology", alone="show"),
        "epoch": Command("swarm.onboard.mesh.epoch", alone="show"),
    },
    alone="show",
)

MEASURE = CommandGroup(
    "measure links, paths and the I2C bus",
    {
        "rtt": Command("swarm.onboard.measure.links", ("rtt",), "measure round-trip times by payload size and overlay"),
        "throughput": Command(
            "swarm.onboard.measure.links",
            ("throughput",),
            "measure the throughput of links and paths, in bytes a second",
        ),
        "rssi": Command("swarm.onboard.measure.rssi", help="measure the signal strength of a Bluetooth link"),
        "i2c": Command("services.balancer.measure_i2c"),
    },
)

BALANCE = CommandGroup(
    "make robots stand or lie, by name or all",
    {
        "stand": Command("swarm.onboard.body.balance", ("stand",), "stand up and balance, from lying or held upright"),
        "rest": Command(
            "swarm.onboard.body.balance", ("rest",), "switch the motors off at once; this also ends a fault"
        ),
        "lie": Command("swarm.onboard.body.balance", ("lie",), "lie down gently, then switch the motors off"),
        "zero": Command("swarm.onboard.body.balance", ("zero",), "measure the gyro's zero again, at rest"),
    },
)

DRIVE = Command("swarm.onboard.body.drive", help="drive a robot by keyboard; it moves only while a key is held")
COMMISSION = Command(
    "swarm.onboard.commission.command", help="check a new robot part by part until it stands; writes a report"
)
PARAM = Command("swarm.onboard.param", help="show or change parameters of a running app")

TOOLS = {
    "dwm": Command("services.dwm.tool", help="show, configure and check UWB modules"),
    "calibrate": Command("services.dwm.calibrate.__main__", help="calibrate the UWB module of a robot"),
    "discover": Command("services.mesh.discover"),
    "config": Command("swarm.onboard.config"),
    "key": Command("swarm.onboard.key"),
}

SECTIONS: Sections = {
    "this robot and its swarm": {
        "balance": BALANCE,
        "drive": DRIVE,
        "commission": COMMISSION,
        "mesh": MESH,
        "measure": MEASURE,
        "app": CommandGroup("act on running apps", {"param": PARAM}),
        **TOOLS,
        "flash": Command("services.balancer.flash.flash", help="write new firmware to the Balboa, over its USB cable"),
    },
    "safety": {
        "estop": Command("swarm.onboard.halt", ("stop",), ESTOP),
        "stop": Command("swarm.onboard.halt", ("stop",), "the same as estop"),
        "arm": Command("swarm.onboard.halt", ("arm",), "take back all stops, and list the robots that confirmed"),
    },
}


def run() -> NoReturn:
    """Entry point of `swarm` on a robot."""
    main(SECTIONS)
