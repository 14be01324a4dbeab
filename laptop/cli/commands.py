"""The commands of `swarm` on a laptop: those of a robot (`swarm.onboard.commands`), and what a robot does not carry."""

from swarm.onboard import commands as robot
from swarm.onboard.command_line import Command, CommandGroup, Sections

SECTIONS: Sections = {
    "write an app, simulate it, look at runs": {
        "new": Command("sim.rehearsal.new", help="write a commented app and its test"),
        "check": Command("sim.rehearsal.check", help="examine an app before any robot moves: size, time, convergence"),
        "sim": Command("laptop.cli.runs.sim", help="simulate a swarm of real service processes, or in virtual time"),
        "demo": Command("laptop.cli.runs.sim", ("--demo",), "three simulated robots find a target, in under a minute"),
        "sweep": Command("laptop.cli.runs.sweep", help="run an app over parameters, topologies and seeds"),
        "plot": Command("laptop.cli.runs.plot"),
        "view": Command("laptop.cli.runs.view"),
        "film": Command("laptop.cli.runs.film"),
        "replay": Command("laptop.cli.runs.replay"),
        "export": Command("laptop.cli.runs.export"),
        "import": Command("laptop.cli.runs.import_csv"),
    },
    "a running swarm": {
        "hand": CommandGroup(
            "act on simulated robots",
            {
                "press": Command("laptop.cli.hand", ("press",), "press a button of a simulated robot"),
                "push": Command("laptop.cli.hand", ("push",), "push a simulated robot"),
                "lay": Command("laptop.cli.hand", ("lay",), "lay a simulated robot on its back or front"),
                "place": Command("laptop.cli.hand", ("place",), "put a simulated robot somewhere else, lying"),
                "unplug": Command("laptop.cli.hand", ("unplug",), "take a device off a simulated robot's I2C bus"),
                "kill": Command("laptop.cli.hand", ("kill",), "end one service; the simulation starts it again"),
                "cut": Command("laptop.cli.hand", ("cut",), "cut the radio link between two simulated robots"),
                "reboot": Command("laptop.cli.hand", ("reboot",), "switch a simulated robot off and on again"),
            },
        ),
        "mesh": robot.MESH._replace(commands={**robot.MESH.commands, "show": Command("laptop.cli.mesh")}),
        "measure": robot.MEASURE._replace(
            commands={
                **robot.MEASURE.commands,
                "rtt": Command("laptop.cli.measure", ("rtt",), robot.MEASURE.commands["rtt"].help),
                "throughput": Command("laptop.cli.measure", ("throughput",), robot.MEASURE.commands["throughput"].help),
                "radio": Command("laptop.cli.radio"),
            }
        ),
        "app": CommandGroup(
            "apps while they run",
            {
                "start": Command("laptop.cli.app", ("start",), "start an app beside those that run"),
                "stop": Command("laptop.cli.app", ("stop",), "stop an app"),
                "param": Command("laptop.cli.param"),
            },
        ),
        **robot.TOOLS,
    },
    "real robots, over ssh": {
        "provision": Command("laptop.cli.robots.provision"),
        "pair": Command("laptop.cli.robots.pair"),
        "bundle": Command("laptop.cli.robots.bundle"),
        "deploy": Command("laptop.cli.robots.deploy"),
        "run": Command("laptop.cli.robots.run"),
        "status": Command("laptop.cli.robots.status"),
        "logs": Command("laptop.cli.robots.logs"),
        "fetch": Command("laptop.cli.robots.fetch"),
        "flash": Command("laptop.cli.robots.flash"),
        "doctor": Command("laptop.cli.robots.doctor"),
        "command": Command("laptop.cli.robots.command"),
        "services": CommandGroup(
            "services and apps",
            {
                "start": Command("laptop.cli.robots.services", ("start",), "start services or apps of all robots"),
                "stop": Command("laptop.cli.robots.services", ("stop",), "stop services or apps of all robots"),
                "restart": Command(
                    "laptop.cli.robots.services", ("restart",), "restart services or apps of all robots"
                ),
            },
        ),
    },
    "safety": {
        "estop": Command("laptop.cli.halt", ("stop",), "stop every robot, and say who has obeyed"),
        "stop": Command("laptop.cli.halt", ("stop",), "the same as estop"),
        "arm": Command("laptop.cli.halt", ("arm",), "take every stop back, and say who has heard it"),
    },
    "this shell": {
        "completion": Command("laptop.cli.completion"),
    },
}
