"""`swarm status [--watch]`: one row a robot: services, battery, links, pose, app, recordings, release, firmware."""

import argparse
import json
import re
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from laptop.fleet.core.checkup import STAND, recovery
from laptop.fleet.core.collect import RUNS
from laptop.fleet.ssh import everyone, robot_command, sections
from laptop.fleet.ssh.ssh import CURRENT, Host, Ssh
from laptop.fleet.units import SERVICES
from swarm.config import load
from swarm.errors import PayloadError
from swarm.frozen import frozen
from swarm.messages import type_of
from swarm.messages.fields import check_fields
from swarm.messages.json_input import read_json
from swarm.onboard.listen import newest_messages
from swarm.process.simulations import CONFIG
from swarm.process.terminal import columns, steer, write_lines
from swarm.recording.budget import shown

HELP = "show services, battery, links, pose, apps and versions of all robots"

WATCH_EVERY_S = 2.0
LISTEN_S = 1.3
"""Seconds of listening to each robot's bus: long enough for messages that are sent once a second."""

_BYTES = re.compile(r"[0-9]{1,18}")


@frozen
class StatusRow:
    """One robot's report of itself; None where it reports nothing."""

    release: str
    firmware: str | None
    """The firmware of the ATmega."""
    failed: list[str]
    """Services and apps that do not run."""
    battery_v: float | None
    battery_left_s: float | None
    mode: str | None
    fault: str | None
    next: str | None
    """The command that makes the robot stand, or what must be done before; None while it stands or is about to."""
    links: dict[str, str]
    """The state of each link, by neighbour."""
    clashes: list[str]
    """Names that two robots have, as the robot's mesh reports."""
    pose: list[float] | None
    """Place of the robot: x and y in m."""
    apps: dict[str, dict[str, Any]]
    """Phase and iteration of each app, by name."""
    recorded: int | None
    """Bytes that recordings take on the robot's disk."""
    misunderstood: list[str]
    """Topics whose messages have other types than they should; they are left out."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--watch", action="store_true", help=f"repeat every {WATCH_EVERY_S:g} s, until Ctrl-C")
    robot_command.add_simulation(parser)
    everyone.add_arguments(parser, timeout_s=20)


def run(args: argparse.Namespace) -> int:
    """Print the table. Return 0 where every robot answers and all of its services run."""
    there = robot_command.simulated(args)
    if there is None:
        config, robots, ssh = everyone.recipients(args)
    else:
        config = load(next(iter(there.values())).parent / CONFIG)
    while True:
        if there is None:
            outcomes, rows = everyone.gather(robots, partial(_look, ssh), args.timeout)
        else:
            rows = _simulated(there)
            outcomes = [everyone.RobotOutcome(name, True, "", 0.0) for name in there]
        if args.json:
            answer = {o.robot: asdict(rows[o.robot]) if o.robot in rows else {"problem": o.text} for o in outcomes}
            sys.stdout.write(json.dumps({"robots": answer}) + "\n")
        else:
            if args.watch:
                steer(sys.stdout, "\x1b[2J\x1b[H")
            write_lines(table(outcomes, rows, config.recordings.budget))
        sys.stdout.flush()
        if not args.watch:
            return 0 if all(o.ok and not rows[o.robot].failed for o in outcomes) else 1
        time.sleep(WATCH_EVERY_S)


def _simulated(there: Mapping[str, Path]) -> dict[str, StatusRow]:
    """Return the rows of simulated robots, by what their services say."""
    rows = {}
    for name, said in newest_messages(there).items():
        runs = [each for each in SERVICES if (said.get("bus") if each == "bus" else f"{each}/status" in said)]
        units = "".join(f"swarm-{each}.service loaded active running\n" for each in runs)
        samples = (
            json.dumps({"key": f"swarm/{name}/{topic}", "value": value}, default=str)
            for topic, value in said.items()
            if isinstance(value, dict)
        )
        rows[name] = _row(name, {"release": "simulated", "units": units, "bus": "\n".join(samples)})
    return rows


async def _look(ssh: Ssh, host: Host) -> StatusRow:
    return parse(host.robot, await ssh.check(host, question(host.robot)))


def question(robot: str) -> str:
    """Return the command for the robot's shell; `parse` reads its answer."""
    units = " ".join(
        f"swarm-{name}.service" for name in SERVICES
    )  # systemctl takes a pattern here, so the ending is needed
    return sections.ask(
        {
            "release": f"readlink {CURRENT}",
            "units": f"systemctl list-units --all --plain --no-legend {units} 'swarm-app@*'",
            "runs": f"sudo -n du -s -B1 {RUNS} 2>/dev/null",
            "bus": f"sudo -n {CURRENT}/bin/z_sub 'swarm/{robot}/**' --seconds {LISTEN_S} --json",
        }
    )


def parse(robot: str, text: str) -> StatusRow:
    """Return the row of a robot by its answer. What the robot does not say, or its release says in another way than
    this one, stays empty."""
    return _row(robot, sections.read(text))


def _row(robot: str, parts: Mapping[str, str]) -> StatusRow:
    newest: dict[str, Any] = {}
    wrong: set[str] = set()
    for line in parts.get("bus", "").splitlines():
        try:
            sample = read_json(line)
            name, value = str(sample["key"]), sample["value"]
            kind = type_of(name)
        except (PayloadError, LookupError, TypeError):
            continue  # raw bytes of an app, or a line cut by the end of the watch
        if kind is None:
            continue
        topic = name.removeprefix(f"swarm/{robot}/")
        try:
            check_fields(kind, value)
        except PayloadError:
            wrong.add(topic)
        else:
            newest[topic] = value
    running, failed = set(), []
    for line in parts.get("units", "").splitlines():
        name, _, state, *_ = [*line.split(), "", "", ""]
        short = name.removeprefix("swarm-").removesuffix(".service")
        running.add(short)
        if state != "active":
            failed.append(short)
    failed += [name for name in SERVICES if name not in running]
    body, atmega, pose, links = (
        newest.get(topic, {}) for topic in ("balancer/state", "balancer/firmware", "dwm/pose", "mesh/links")
    )
    runs = parts.get("runs", "").partition("\t")[0]
    progress = {
        key.split("/")[1]: value
        for key, value in newest.items()
        if key.startswith("app/") and value.keys() >= {"phase", "k"}
    }
    # Fields that are there have the types of their message; some may be missing.
    return StatusRow(
        release=parts.get("release", "").rpartition("/")[2],
        firmware=f"{atmega['layout']}.{atmega['revision']}" if atmega.keys() >= {"layout", "revision"} else None,
        failed=sorted(failed),
        battery_v=body.get("battery"),
        battery_left_s=body.get("battery_left"),
        mode=body.get("mode") or None,
        fault=body.get("fault") or None,
        next=_next(body, newest.get("balancer/fault", {}), newest.get("mesh/stopped", {})),
        links={link["peer"]: link["state"] for link in links.get("links", ()) if link.keys() >= {"peer", "state"}},
        clashes=sorted(links.get("clashes", ())),
        pose=[pose["x"], pose["y"]] if pose.get("quality") and pose.keys() >= {"x", "y"} else None,
        apps={app: {"phase": value["phase"], "k": value["k"]} for app, value in progress.items()},
        recorded=int(runs) if _BYTES.fullmatch(runs) else None,
        misunderstood=sorted(wrong),
    )


def _next(body: dict[str, Any], fault: dict[str, Any], stopped: dict[str, Any]) -> str | None:
    """Return what a person does to have the robot stand, by its messages."""
    return STAND if body.get("mode") == "idle" else recovery(fault, stopped) or None


def _body(row: StatusRow) -> str:
    if row.mode == "idle" and not row.fault:
        return f"idle, no fault: {row.next}"
    told = row.fault or row.mode or "-"
    return f"{told}: {row.next}" if row.next else told


def _time(seconds: float) -> str:
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min"


def table(outcomes: list[everyone.RobotOutcome], rows: dict[str, StatusRow], budget: float) -> list[str]:
    """Return the lines for a terminal; `budget`: bytes that recordings may take."""
    cells: list[tuple[str, ...]] = [
        ("robot", "services", "battery", "body", "links", "pose", "apps", "recordings", "release", "firmware")
    ]
    for outcome in outcomes:
        row = rows.get(outcome.robot)
        if row is None:
            cells.append((outcome.robot, outcome.text, *[""] * (len(cells[0]) - 2)))
            continue
        left = "" if row.battery_left_s is None else f" {_time(row.battery_left_s)}"
        up = sum(state == "up" for state in row.links.values())
        cells.append(
            (
                outcome.robot,
                (f"not running: {' '.join(row.failed)}" if row.failed else "all run")
                + (f"; not understood: {' '.join(row.misunderstood)}" if row.misunderstood else ""),
                "-" if row.battery_v is None else f"{row.battery_v:.1f} V{left}",
                _body(row),
                f"{up} of {len(row.links)}" + "".join(f", two robots are called {name}" for name in row.clashes),
                "-" if row.pose is None else f"{row.pose[0]:.2f} {row.pose[1]:.2f}",
                " ".join(f"{app}:{value['phase']}@{value['k']}" for app, value in row.apps.items()) or "-",
                "-" if row.recorded is None else f"{shown(row.recorded)} of {shown(budget)}",
                row.release or "-",
                row.firmware or "-",
            )
        )
    # A robot that cannot be asked has one long text, which would make its column as wide.
    lines = columns([row if any(row[2:]) else (row[0], *[""] * (len(row) - 1)) for row in cells])
    at = lines[0].index(cells[0][1])
    return [line if any(row[2:]) else f"{row[0]:<{at}}{row[1]}" for line, row in zip(lines, cells, strict=True)]
