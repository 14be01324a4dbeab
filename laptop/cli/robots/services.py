"""`swarm services start|stop|restart`: systemd units of all robots."""

import argparse
from collections.abc import Mapping
from pathlib import Path

from laptop.cli import hand
from laptop.fleet import apps
from laptop.fleet.posture import add_force, refuse_standing
from laptop.fleet.ssh import everyone, robot_command
from laptop.fleet.ssh.ssh import Host
from laptop.fleet.units import SERVICES, units
from sim.control import app_requests
from swarm.errors import LocalError
from swarm.process.arguments import show


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `start|stop|restart [SERVICE...]`. The action is part of the command's name."""
    parser.add_argument("action", choices=("start", "stop", "restart"), help=argparse.SUPPRESS)
    parser.add_argument(
        "services", nargs="*", metavar="SERVICE", help="bus, mesh, balancer, dwm or an app (default: all services)"
    )
    robot_command.add_simulation(parser)
    add_force(parser)
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace) -> int:
    """Return 0 where it succeeded on every robot."""
    names = units(args.services)
    if (there := robot_command.simulated(args)) is not None:
        return _simulated(args, there)
    config, robots, ssh = everyone.recipients(args)
    everyone.refuse_robots(args.services, config.names, "a service or an app")
    ends_balancer = args.action != "start" and (not args.services or "balancer" in args.services)

    async def job(host: Host, _: everyone.ReportProgress) -> str:
        if ends_balancer and not args.force:
            await refuse_standing(ssh, host)
        return await apps.systemctl(ssh, host, args.action, names)

    return everyone.run(args, robots, job)


def _simulated(args: argparse.Namespace, there: Mapping[str, Path]) -> int:
    """Restart services of simulated robots, which the simulation does whenever one ends; start or stop their apps."""
    everyone.refuse_robots(args.services, there, "a service or an app")
    done: dict[str, str] = {}
    for name, runtime in there.items():
        said = []
        for service in args.services or SERVICES:
            if args.action == "restart":
                full = service if service in SERVICES else f"app/{service}"
                said.append(f"restart {hand.end_service(runtime, full, 'KILL')[0]}")
            elif service in SERVICES:
                raise LocalError(f"a simulation runs every service: restart {service}, or swarm hand reboot {name}")
            else:
                said.append(app_requests.request_app(runtime.parent, args.action, service, [name]))
        done[name] = ", ".join(said)
    show(args, {"robots": done}, [f"{name}: {text}" for name, text in done.items()])
    return 0
