"""`./run bench AREA [--json]`: prints what it measured; exits with 1 when a goal was missed."""

import argparse
import importlib
import sys

AREAS = {
    "lockstep": "time of a lockstep iteration and of a start, beside the links' latency",
    "outage": "lockstep over links that are cut again and again: time, and the trajectory bit for bit",
    "cpu": "CPU time of one robot's bus, mesh and app for 100 lockstep iterations",
    "virtual": "swarms of all sizes under virtual time, beside the time they may take",
    "start": "all robots at once until all links are up, beside the time a radio takes to connect",
    "mesh": "flood and unicast between real processes, beside the links' latency; a lost link",
    "transfer": "a megabyte over three hops of 78 kB/s, by unicast and by flood, beside lockstep",
    "balancer": "lateness of the 100 Hz loop under load, beside cyclictest (needs the package rt-tests)",
    "session": "what authentication costs a link: bytes and CPU time of a frame",
    "localization": "the pose of a moving robot beside moving averages and multilateration, and what it costs",
    "apps": "consensus and localization beside the thesis: table 4.1, rounds, errors, lines an author writes",
    "recording": "what a recording costs an app's process, and what a kill -9 takes from it",
    "footprint": "proportional memory of one robot's processes",
    "i2c": "time on the I2C bus at 100 kHz: a control step, a whole tick, rates",
    "dwm": "the UWB service: memory, and CPU time and allocations of an update",
    "teamwork": "apps that blink, stand and drive together: LED phases, stand-up, formation, crossings",
    "deploy": "a release to 8 robots beside one, and the second time; over real ssh servers",
    "steady": "CPU time of each process of a robot, for a second of a run",
    "lab": "an iteration over a real kernel's RFCOMM beside plain sockets on the same links (boots a machine)",
    "view": "the live page: frames, CPU of browser and server, robot to screen; what watching costs the swarm",
    "decoders": "every decoder fed with 100 000 random inputs in bounded memory",
    "faults": "a killed or stopped service in mid-run: same trajectory, and how long it took; 1000 random faults",
}


def main() -> int:
    """Run one area and print its rows as they are measured."""
    listing = "\n".join(f"  {name:<10} {what}" for name, what in AREAS.items())
    parser = argparse.ArgumentParser(
        prog="./run bench",
        description="Measurements, each beside its limit.",
        epilog=f"areas:\n{listing}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("area", choices=AREAS, metavar="AREA")
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    arguments = parser.parse_args()
    missed = 0
    for row in importlib.import_module(f"bench.{arguments.area}").rows():
        print(row.json() if arguments.json else row.text(), flush=True)
        missed += not row.ok
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
