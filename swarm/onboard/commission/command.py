"""`swarm commission ROBOT`: the shell around the procedure: one robot's bus, the person's keys, and the report's file.

It speaks to a robot of a simulation that runs here, else to this robot itself. With `--json` each line is a JSON
object: `say` for people, `so_far` with the report as it is after each step, `report` at the end; that is what a laptop
reads over ssh.
"""

import argparse
import contextlib
import json
import queue
import re
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from swarm import __version__, clock
from swarm.bus.zenoh_bus import Bus
from swarm.config import Config
from swarm.errors import LocalError, PayloadError
from swarm.files import atomic_write
from swarm.messages import Arm, ImuRequest, MeasureI2C, SetDisplay, SetMode, Stop, TryMotors, read
from swarm.messages.keys import STOP, key
from swarm.onboard import halt
from swarm.onboard.body.drive import one
from swarm.onboard.body.keyboard import Keyboard
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import PATIENCE
from swarm.onboard.commission.core.motor_steps import REASON
from swarm.onboard.commission.core.procedure import (
    PASSED,
    Action,
    Ask,
    Procedure,
    Say,
    SendCommand,
    StepResult,
    Subject,
)
from swarm.onboard.commission.core.steps import STEPS
from swarm.process.arguments import add_json
from swarm.process.simulations import config_for
from swarm.process.terminal import write_lines

TOPICS = (
    "balancer/state", "balancer/odometry", "balancer/imu", "balancer/buttons", "balancer/fault", "balancer/notice",
    "balancer/display", "balancer/i2c", "balancer/firmware", "dwm/ranges", "mesh/links", "mesh/stopped",
)  # fmt: skip
_KEYS: dict[type, str] = {
    SetMode: "balancer/set/mode",
    TryMotors: "balancer/set/motors",
    ImuRequest: "balancer/set/imu",
    MeasureI2C: "balancer/set/i2c",
    SetDisplay: "balancer/set/display",
    Arm: "mesh/set/arm",
}
_TICK_S = 0.05
_QUEUE = 4000
"""Messages that may wait: 20 s of all that a robot says."""
STOPPED = "stopped by the person: swarm arm takes the stop back"
YES, NO = ("enter", "a", "y"), ("n", "c")
ENDS = ("x", "escape")
RELEASE = Path("/opt/swarm/current")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name", nargs="?", metavar="ROBOT", help="a robot of the simulation, or over ssh (default: this robot)"
    )
    parser.add_argument("--out", type=_report, metavar="FILE", help="file for the report (commission-ROBOT-DATE.json)")
    add_json(parser)
    buses.add_arguments(parser)


def _report(text: str) -> Path:
    """Return the path of the report. What is wrong with it is said before all of the work."""
    path = Path(text)
    if path.is_dir() or not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r}: expected a file in a folder that is there")
    return path


def run(args: argparse.Namespace) -> int:
    """Lead through all steps; code 1 where not all of them have passed."""
    robot, directory = one(args)
    config = config_for(directory)
    procedure = Procedure(subject_of(config, robot), STEPS)
    ended = ""
    with Bus.of(directory) as bus:
        if not bus.wait_connected(PATIENCE):
            raise LocalError(f"{robot}: no bus is there ({directory}); is the robot switched on?")
        session = _Session(bus, robot, procedure, as_json=args.json)
        try:
            with session.keys.raw():
                ended = session.run()
        except KeyboardInterrupt:
            ended = "ended by Ctrl-C"
        finally:
            session.command(SetMode("rest"))
    try:
        if ended == STOPPED:
            ended = f"{STOPPED}; not all robots have confirmed the stop: swarm estop gives it again"
            rows = halt.stop_over_buses(args.run_dir, REASON)
            there = halt.reached(rows)
            missing = " ".join(row.robot for row in there or rows if not row.confirmed)
            ended = f"{STOPPED}; not confirmed by {missing}: swarm estop gives it again" if missing else STOPPED
            lines = halt.table(rows, stop=True)
            write_lines([json.dumps({"say": line}) for line in lines] if args.json else lines)
    finally:
        report = procedure.report() | ({"ended": ended} if ended else {})
        if args.json:
            write_lines([json.dumps({"report": report})])
        else:
            finish(report, args.out)
    return 0 if report["verdict"] == "passed" else 1


def subject_of(config: Config, robot: str) -> Subject:
    """Return what the procedure has to know of a robot."""
    date = datetime.now(tz=UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    release = RELEASE.resolve().name if RELEASE.is_symlink() else __version__
    anchors = {each.address: (each.x, each.y, each.z - config.dwm.height) for each in config.anchors}
    return Subject(robot, anchors, config.balancing_of(robot).battery_warning, date, release)


def finish(report: dict[str, Any], out: Path | None) -> None:
    """Write the report to its file and say how it ended. Where it cannot be written, it is shown, and `LocalError`
    raised."""
    path = out or Path(f"commission-{report['robot']}-{re.sub('[^0-9TZ]', '', str(report['date']))}.json")
    try:
        atomic_write(path, json.dumps(report, indent=2).encode() + b"\n")
    except OSError as error:
        write_lines([json.dumps(report)])
        raise LocalError(f"{path}: {error.strerror}; the report is the line above, keep it in a file") from None
    lines = [f"{row['name']:<10} {row['verdict']}" for row in report["steps"]]
    if report.get("ended"):
        lines.append(str(report["ended"]))
    write_lines([*lines, f"{report['robot']}: {report['verdict']}; report: {path}"])
    learned = [row for row in report["steps"] if row["name"] == "offset" and row["verdict"] == PASSED]
    if any("range_offset_m" in row.get("figures", {}) for row in learned):
        write_lines(
            [f"its UWB offset into its calibration: swarm calibrate offset {path} --robots {report['robot']} --write"]
        )


class _Session:
    """One procedure on one bus."""

    def __init__(self, bus: Bus, robot: str, procedure: Procedure, *, as_json: bool) -> None:
        self._bus, self._robot, self._procedure, self._as_json = bus, robot, procedure, as_json
        self._told: dict[str, StepResult] = {}
        self._heard: queue.Queue[tuple[str, bytes]] = queue.Queue(_QUEUE)
        self.keys = Keyboard(sys.stdin)
        for topic in TOPICS:
            bus.subscribe(key(robot, *topic.split("/")), self._take)

    def run(self) -> str:
        """Go on until the procedure is done; returns why it was ended before, or ""."""
        procedure = self._procedure
        self._say(
            "a or Enter: yes. n or c: no (also the robot's buttons A and C). Space: stop all robots and end. x: end."
        )
        while not procedure.done:
            for pressed in self.keys.read(_TICK_S):
                if pressed == " ":
                    self._bus.publish(STOP, Stop(clock.now(), self._robot, REASON), urgent=True)
                    self._say(STOPPED)  # a laptop then gives the stop to all robots by ssh, too
                    return STOPPED
                if pressed in ENDS:
                    return "ended by the person"
                if pressed in (*YES, *NO):
                    self._do(procedure.answer(pressed in YES, clock.now()))
            if self.keys.ended:
                return "the connection or the input has ended"
            self._read_all()
            self._do(procedure.handle_timer(clock.now()))
        return ""

    def command(self, message: object) -> None:
        """Send a command to the robot, or a stop to all."""
        if isinstance(message, Stop):
            self._bus.publish(STOP, message)
        else:
            self._bus.publish(key(self._robot, *_KEYS[type(message)].split("/")), message, urgent=True)

    def _take(self, name: str, payload: bytes) -> None:
        with contextlib.suppress(queue.Full):
            self._heard.put_nowait((name, payload))

    def _read_all(self) -> None:
        for _ in range(self._heard.qsize()):
            name, payload = self._heard.get_nowait()
            with contextlib.suppress(PayloadError):
                self._do(self._procedure.receive(read(name, payload), clock.now()))

    def _do(self, actions: list[Action]) -> None:
        for action in actions:
            match action:
                case Say(text):
                    self._say(text)
                case Ask(what, text):
                    self._say(text, what)
                case SendCommand(message):
                    self.command(message)
        if self._as_json and self._told != self._procedure.results:  # a laptop keeps it, should the connection break
            self._told = dict(self._procedure.results)
            self._write({"so_far": self._procedure.report()})

    def _say(self, text: str, what: str = "") -> None:
        said = {"say": text} | ({"ask": what} if what else {})
        self._write(said if self._as_json else f"  ? {text}" if what else text)

    def _write(self, line: dict[str, Any] | str) -> None:
        write_lines([line if isinstance(line, str) else json.dumps(line)])
        sys.stdout.flush()
