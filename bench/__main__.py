"""`./run bench AREA|all [--json] [--smoke] [--write]`: prints what it measured.

It exits with 1 when a goal was missed, and with 2 when an area could not be measured."""

import argparse
import dataclasses
import importlib
import sys
import time
import traceback
from collections.abc import Iterator
from types import ModuleType

from bench import page
from bench.rows import Row
from swarm.errors import SwarmError

FOLDERS = {
    "lockstep": {
        "lockstep": "time of a lockstep iteration and of a start, beside the links' latency",
        "outage": "lockstep over links that are cut again and again: time, and the trajectory bit for bit",
        "lab": "an iteration over a real kernel's RFCOMM beside plain sockets on the same links (boots a machine)",
    },
    "costs": {
        "cpu": "CPU time of one robot's bus, mesh and app for 100 lockstep iterations",
        "virtual": "swarms of all sizes under virtual time, beside the time they may take",
        "recording": "what a recording costs an app's process, and what a kill -9 takes from it",
        "footprint": "proportional memory of one robot's processes",
        "memory": "growth of two robots' processes and of the simulation, MB an hour, after a warm-up (--seconds)",
        "steady": "CPU time of each process of a robot, for a second of a run",
    },
    "mesh": {
        "start": "all robots at once until all links are up, beside the time a radio takes to connect",
        "mesh": "flood and unicast between real processes, beside the links' latency; a lost link",
        "transfer": "a megabyte over three hops of 78 kB/s, by unicast and by flood, beside lockstep",
        "session": "what authentication costs a link: bytes and CPU time of a frame",
    },
    "balancer": {
        "balancer": "lateness of the 100 Hz loop under load, beside cyclictest (needs the package rt-tests)",
        "i2c": "time on the I2C bus at 100 kHz: a control step, a whole tick, rates; UWB reports at other clocks",
        "power": "watts of a robot by state and its autonomy, by our model, beside table 2.5 of the thesis",
    },
    "stop": {
        "stop": "time from a stop to motors off, by each way it can take, quiet and under load",
    },
    "dwm": {
        "localization": "the pose of a moving robot beside moving averages and multilateration, and what it costs",
        "dwm": "the UWB service: memory, and CPU time and allocations of an update",
    },
    "apps": {
        "apps": "consensus and localization beside the thesis: table 4.1, rounds, errors, lines an author writes",
        "teamwork": "apps that blink, stand and drive together: LED phases, stand-up, formation, crossings",
    },
    "laptop": {
        "deploy": "a release to 8 robots beside one, and the second time; over real ssh servers",
        "view": "the live page: frames, CPU of browser and server, robot to screen; what watching costs the swarm",
    },
    "radio": {
        "radio": "a Bluetooth radio in slots beside recordings; lockstep over it, starts, and their bounds",
    },
    "faults": {
        "faults": "1000 faults of all kinds mixed, drawn from a seed: same trajectory, and how long it took",
        "random_faults": "1000 faults, power cuts among them, against the rule alone: values, epochs, memory",
    },
    "decoders": {
        "decoders": "every decoder fed with 100 000 random inputs in bounded memory",
    },
}
"""Each area is a module of its folder with a frozen dataclass `Sizes`, two of them, `FULL` (the figures') and `SMOKE`
(seconds of work), and `rows(sizes)`."""
AREAS = {area: (folder, what) for folder, areas in FOLDERS.items() for area, what in areas.items()}
FAILED = 2
"""Exit code where an area could not be measured to its end."""

IN_VIRTUAL_TIME = ("power", "radio")
"""Areas whose figures are the same on every machine."""


def area_module(area: str) -> ModuleType:
    """Import the module that measures an area."""
    return importlib.import_module(f"bench.{AREAS[area][0]}.{area}")


def measure(area: str, *, smoke: bool = False, **changed: float) -> Iterator[Row]:
    """Measure an area; in a smoke run nothing is judged. `changed` replaces fields of the area's sizes."""
    module = area_module(area)
    sizes = dataclasses.replace(module.SMOKE if smoke else module.FULL, **changed)
    for row in module.rows(sizes):
        yield dataclasses.replace(row, goal=None) if smoke else row


def main() -> int:
    """Run one area, or all of them, and print the rows as they are measured."""
    listing = "\n".join(f"  {name:<13} {what}" for name, (_, what) in AREAS.items())
    parser = argparse.ArgumentParser(
        prog="./run bench",
        description="Measurements, each beside its limit.",
        epilog=f"areas:\n{listing}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("area", choices=[*AREAS, "all"], metavar="AREA", help="one of those below, or `all`")
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--smoke", action="store_true", help="small sizes and no goals: only whether the area works")
    parser.add_argument("--write", action="store_true", help="also write the area's table into the page of results")
    parser.add_argument("--seed", type=int, help="of the schedule of faults")
    parser.add_argument("--count", type=int, help="how many faults")
    parser.add_argument("--seconds", type=float, metavar="S", help="how long is measured (memory)")
    arguments = parser.parse_args()
    changed = {name: value for name in ("seed", "count", "seconds") if (value := getattr(arguments, name)) is not None}
    areas = list(AREAS) if arguments.area == "all" else [arguments.area]
    if arguments.write and arguments.smoke:
        parser.error("--write takes the figures of full sizes, not those of --smoke")
    for area in areas if changed else ():
        sizes = area_module(area).FULL
        if unknown := changed.keys() - {field.name for field in dataclasses.fields(sizes)}:
            parser.error(f"{area} has no --{min(unknown)}")
    return max(_run(area, arguments, changed) for area in areas)


def _run(area: str, arguments: argparse.Namespace, changed: dict[str, float]) -> int:
    """Measure one area; returns the exit code."""
    rows = []
    try:
        for row in measure(area, smoke=arguments.smoke, **changed):
            print(row.json() if arguments.json else row.text(), flush=True)
            rows.append(row)
        if arguments.write:
            write(area, rows, changed)
    except SwarmError as error:
        sys.stderr.write(f"bench {area}: {error}\n")
        return FAILED
    except Exception:  # noqa: BLE001 - the other areas' figures are not lost by it
        sys.stderr.write(f"bench {area}: it failed\n{traceback.format_exc()}")
        return FAILED
    return 0 if all(row.ok for row in rows) else 1


def write(area: str, rows: list[Row], changed: dict[str, float]) -> None:
    """Replace the area's table on the page of results."""
    command = " ".join(["./run bench", area, *(f"--{name} {value:g}" for name, value in changed.items())])
    machine = page.ANY_MACHINE if area in IN_VIRTUAL_TIME else page.machine()
    part = page.table(area, rows, command=command, machine=machine, date=time.strftime("%Y-%m-%d"))
    text = page.PAGE.read_text(encoding="utf-8")
    page.PAGE.write_text(page.replaced(text, area, part), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
