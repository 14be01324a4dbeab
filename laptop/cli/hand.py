"""`swarm hand ACT ROBOT ...`: what a person can do to the robots of a running simulation."""

import argparse
import math
import os
import signal
from pathlib import Path

from laptop.fleet.units import SERVICES
from sim.control import datagrams, link_cuts, power_switch
from sim.core import actions
from sim.core.actions import Carry, Lay, Lift, Miswire, Press, Push, Roll, SimulationAction, Unplug
from swarm.errors import LocalError
from swarm.messages.keys import is_name
from swarm.process.arguments import add_json, add_run_dir, number, show
from swarm.process.simulations import pid_of, runtime_of

BOOT_S = 3.0
MAX_CUT_S = 600.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare each act with its arguments. The act is part of the command's name."""
    acts = parser.add_subparsers(dest="act", required=True, prog=parser.prog)

    def act(name: str) -> argparse.ArgumentParser:
        found = acts.add_parser(name, prog=parser.prog, description=parser.description)
        found.add_argument("robot", metavar="ROBOT", help="name of a simulated robot, e.g. r0")
        add_run_dir(found)
        add_json(found)
        return found

    press = act("press")
    press.add_argument("button", choices=actions.BUTTONS, help="button on the robot's board")
    press.add_argument("--hold", type=float, default=0.2, metavar="S", help="seconds that the button is held (0.2)")
    push = act("push")
    text = "N s, negative from the front (0.1; 0.5 topples the robot)"
    push.add_argument("--impulse", type=float, default=0.1, metavar="NS", help=text)
    act("lay").add_argument("side", choices=actions.SIDES, help="side on which the robot lies then")
    place = act("place")
    for axis in ("x", "y"):
        text = f"{axis} of the robot's new place, m"
        place.add_argument(axis, metavar=axis.upper(), type=number(-1e3, 1e3), help=text)
    place.add_argument(
        "--heading", type=number(-10, 10, "rad"), default=0.0, metavar="RAD", help="new heading, 0 = along x (0)"
    )
    lift = act("lift")
    lift.add_argument(
        "--tilt", type=number(-180, 180, "deg"), default=0.0, metavar="DEG", help="angle from upright (0)"
    )
    lift.add_argument("--turn", type=number(-720, 720, "deg"), default=0.0, metavar="DEG", help="turn to the left (0)")
    lift.add_argument("--down", action="store_true", help="put it down upright, and hold it until its motors run")
    roll = act("roll")
    roll.add_argument("wheel", choices=actions.WHEELS, help="wheel to turn")
    roll.add_argument(
        "--degrees",
        type=number(-1440, 1440, "deg"),
        default=360.0,
        metavar="DEG",
        help="turn forward, negative: backward (360)",
    )
    miswire = act("miswire")
    miswire.add_argument("part", metavar="PART", choices=actions.MISWIRINGS, help=", ".join(actions.MISWIRINGS))
    miswire.add_argument("--back", action="store_true", help="mount the part correctly again")
    unplug = act("unplug")
    unplug.add_argument("device", choices=actions.DEVICES, help="device to disconnect")
    unplug.add_argument("--back", action="store_true", help="connect the device again")
    kill = act("kill")
    kill.add_argument("service", metavar="SERVICE", help=f"{', '.join(SERVICES)}, app or app/NAME")
    text = "KILL (default): ends at once; TERM: stops cleanly; STOP and CONT: freezes and continues"
    kill.add_argument("--signal", choices=SIGNALS, default="KILL", help=text)
    cut = act("cut")
    cut.add_argument("peer", metavar="PEER", help="the robot at the other end")
    text = f"length of the cut, at most {MAX_CUT_S:g} (10)"
    cut.add_argument("--seconds", type=number(0, MAX_CUT_S, "s"), default=10.0, metavar="S", help=text)
    cut.add_argument("--mend", dest="seconds", action="store_const", const=0.0, help="end the cut now")
    reboot = act("reboot")
    text = f"seconds until its services start again ({BOOT_S:g})"
    reboot.add_argument("--off", type=float, default=BOOT_S, metavar="S", help=text)


def run(args: argparse.Namespace) -> int:
    """Do one act. Raises `LocalError` where there is no such simulation, robot or service."""
    done = do(runtime_of(args.run_dir, args.robot), args)
    show(args, {"robot": args.robot, "act": args.act, "done": done}, [f"{args.robot}: {done}"])
    return 0


def do(runtime: Path, args: argparse.Namespace) -> str:
    """Do what the arguments say to the robot with this runtime directory, and return in words what was done."""
    match args.act:
        case "kill":
            service, pid = end_service(runtime, args.service, args.signal)
            return f"{service} (pid {pid}): SIG{args.signal}"
        case "cut":
            link_cuts.cut_link(runtime.parent, args.robot, args.peer, args.seconds)
            return f"link to {args.peer} " + (f"cut for {args.seconds:g} s" if args.seconds else "mended")
        case "reboot":
            power_switch.reboot(runtime.parent, args.robot, args.off)
            return f"off, and on again in {args.off:g} s"
    action, done = _action(args)
    datagrams.send_action(runtime, action)
    return done


def _action(args: argparse.Namespace) -> tuple[SimulationAction, str]:
    """Return the action on a robot's body or devices, and in words what it does."""
    match args.act:
        case "press":
            return Press(args.button, args.hold), f"button {args.button} held for {args.hold:g} s"
        case "push":
            return Push(args.impulse), f"pushed with {args.impulse:g} N s"
        case "lay":
            return Lay(args.side), f"laid on its {args.side}"
        case "place":
            return Carry(args.x, args.y, args.heading), f"lies on its back at ({args.x:g}, {args.y:g}) m"
        case "lift":
            text = "stands upright, held by a hand" if args.down else f"in the hand, {args.tilt:g} degrees from upright"
            return Lift(math.radians(args.tilt), math.radians(args.turn), down=args.down), text
        case "roll":
            text = f"{args.wheel} wheel turned by {args.degrees:g} degrees"
            return Roll(args.wheel, math.radians(args.degrees)), text
        case "miswire":
            text = f"{args.part} is mounted the {'right' if args.back else 'wrong'} way"
            return Miswire(args.part, back=args.back), text
        case _:
            return Unplug(args.device, back=args.back), f"{args.device} is {'back on' if args.back else 'off'} its bus"


SIGNALS = ("KILL", "TERM", "STOP", "CONT")


def end_service(runtime: Path, wanted: str, name: str) -> tuple[str, int]:
    """Send the signal `name` to a service of the robot with this runtime directory; the service's full name, and its
    pid. Raises `LocalError` where there is none."""
    service = _service(runtime, wanted)
    pid = pid_of(runtime.parent, runtime.name, service)
    if pid is None or not _send(pid, runtime, getattr(signal, f"SIG{name}")):
        raise LocalError(f"{service} of {runtime.name} is not running at this moment")
    return service, pid


def _service(runtime: Path, wanted: str) -> str:
    """Return the full name of a service. A robot runs one app as a rule, and `app` then stands for its name."""
    name = wanted.removeprefix("app/")
    if wanted in SERVICES or (wanted.startswith("app/") and is_name(name)):
        return wanted
    apps = sorted(path.name.removesuffix(".pid").replace(".", "/", 1) for path in runtime.glob("app.*.pid"))
    if wanted != "app":
        raise LocalError(f"no service {wanted!r}; there are {', '.join([*SERVICES, *apps])}")
    if len(apps) != 1:
        raise LocalError(f"expected app/NAME: {runtime.name} runs {', '.join(apps) or 'no app'}")
    return apps[0]


def _send(pid: int, runtime: Path, number: signal.Signals) -> bool:
    """Send the signal if `pid` is still that robot's process. The descriptor holds on to it while we look."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return False
    try:
        if not _belongs_to(pid, runtime):
            return False
        signal.pidfd_send_signal(descriptor, number)
    except ProcessLookupError:
        return False
    finally:
        os.close(descriptor)
    return True


def _belongs_to(pid: int, runtime: Path) -> bool:
    """Return whether the process was started as a service of the robot with this runtime directory."""
    try:
        variables = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return False
    own = {os.fsencode(f"SWARM_RUNTIME={path}") for path in (runtime, runtime.resolve())}
    return not own.isdisjoint(variables)
