"""The commands of `swarm` on a laptop: those of a robot (`swarm.onboard.commands`), and what a robot does not carry."""

from swarm.onboard import commands as robot
from swarm.onboard.command_line import MORE, Command, CommandGroup, Sections

FAR = "laptop.cli.far"

SECTIONS: Sections = {
    "write an app, simulate it, look at runs": {
        "new": Command("sim.rehearsal.new"),
        "check": Command("sim.rehearsal.check"),
        "sim": Command("laptop.cli.runs.sim", help="simulate a swarm of real service processes, or in virtual time"),
        "demo": Command("laptop.cli.runs.demo", help="let three simulated robots find a target, in under a minute"),
        "sweep": Command("laptop.cli.runs.sweep", help="run an app over parameters, topologies and seeds"),
        "plot": Command("laptop.cli.runs.plot"),
        "view": Command("laptop.cli.runs.view"),
        "film": Command("laptop.cli.runs.film"),
        "export": Command("laptop.cli.runs.export"),
    },
    "a running swarm, simulated or real": {
        "status": Command("laptop.cli.robots.status"),
        "logs": Command("laptop.cli.robots.logs"),
        "doctor": Command("laptop.cli.robots.doctor"),
        "hand": CommandGroup(
            "act on a simulated robot",
            {
                "press": Command("laptop.cli.hand", ("press",), "press a button of a simulated robot"),
                "push": Command("laptop.cli.hand", ("push",), "push a simulated robot"),
                "lay": Command("laptop.cli.hand", ("lay",), "lay a simulated robot on its back or front"),
                "place": Command("laptop.cli.hand", ("place",), "put a simulated robot at another place, lying"),
                "lift": Command("laptop.cli.hand", ("lift",), "lift a simulated robot, or put it down"),
                "roll": Command("laptop.cli.hand", ("roll",), "turn a wheel of a simulated robot by hand"),
                "miswire": Command("laptop.cli.hand", ("miswire",), "mount a part of a simulated robot the wrong way"),
                "unplug": Command(
                    "laptop.cli.hand", ("unplug",), "disconnect a device from a simulated robot's I2C bus"
                ),
                "kill": Command("laptop.cli.hand", ("kill",), "end one service; the simulation restarts it"),
                "cut": Command("laptop.cli.hand", ("cut",), "cut the radio link between two simulated robots"),
                "reboot": Command("laptop.cli.hand", ("reboot",), "switch a simulated robot off and on again"),
            },
        ),
        "balance": robot.BALANCE._replace(
            commands={
                name: each._replace(module="laptop.cli.robots.body.balance")
                for name, each in robot.BALANCE.commands.items()
            }
        ),
        "drive": robot.DRIVE._replace(module="laptop.cli.robots.body.drive"),
        "commission": robot.COMMISSION._replace(module="laptop.cli.robots.body.commission"),
        "mesh": robot.MESH._replace(
            commands={name: each._replace(far=FAR) for name, each in robot.MESH.commands.items()}
            | {"show": robot.MESH.commands["show"]._replace(module="laptop.cli.mesh", far=FAR)}
        ),
        "measure": robot.MEASURE._replace(
            commands={
                "rtt": robot.MEASURE.commands["rtt"]._replace(module="laptop.cli.measure.links", far=FAR),
                "throughput": robot.MEASURE.commands["throughput"]._replace(module="laptop.cli.measure.links", far=FAR),
                "rssi": robot.MEASURE.commands["rssi"]._replace(module="laptop.cli.measure.rssi", far=FAR),
                "radio": Command("laptop.cli.measure.radio"),
                "i2c": robot.MEASURE.commands["i2c"]._replace(far=FAR),
            }
        ),
        "app": CommandGroup(
            "act on running apps",
            {
                "start": Command("laptop.cli.app", ("start",), "start a further app"),
                "stop": Command("laptop.cli.app", ("stop",), "stop an app"),
                "param": robot.PARAM._replace(module="laptop.cli.param"),
            },
        ),
        "services": CommandGroup(
            "act on services and apps",
            {
                "start": Command("laptop.cli.robots.services", ("start",), "start services or apps of all robots"),
                "stop": Command("laptop.cli.robots.services", ("stop",), "stop services or apps of all robots"),
                "restart": Command(
                    "laptop.cli.robots.services", ("restart",), "restart services or apps of all robots"
                ),
            },
        ),
        **robot.TOOLS,
        "dwm": robot.TOOLS["dwm"]._replace(far=FAR),
        "calibrate": robot.TOOLS["calibrate"]._replace(module="laptop.cli.calibrate"),
    },
    "real robots, over ssh": {
        "provision": Command("laptop.cli.robots.provision"),
        "pair": Command("laptop.cli.robots.pair"),
        "deploy": Command("laptop.cli.robots.deploy"),
        "run": Command("laptop.cli.robots.run"),
        "fetch": Command("laptop.cli.robots.fetch"),
        "flash": Command("laptop.cli.robots.body.flash"),
        "command": Command("laptop.cli.robots.command"),
    },
    "safety": {
        "estop": Command("laptop.cli.halt", ("stop",), robot.ESTOP),
        "arm": Command("laptop.cli.halt", ("arm",), "take back all stops, and list the robots that confirmed"),
    },
    MORE: {
        "stop": Command("laptop.cli.halt", ("stop",), "the same as estop"),
        "replay": Command("laptop.cli.runs.replay"),
        "pad": Command("laptop.cli.robots.body.pad"),
        "foxglove": Command("laptop.cli.runs.foxglove"),
        "import": Command("laptop.cli.runs.import_csv"),
        "bundle": Command("laptop.cli.robots.bundle"),
        "completion": Command("laptop.cli.completion"),
    },
}
