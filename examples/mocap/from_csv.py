"""Gives robots poses out of a CSV file; swarm.toml has `[dwm] source = "bus:swarm/{robot}/dwm/set/report"`.

    python from_csv.py poses.csv r0=/run/swarm/bus.sock [r1=/tmp/r1.sock ...]

Lines of the file: time in s, name of the robot, x and y in m, heading in rad (may be left out).
"""

import csv
import sys
import time
from pathlib import Path

import msgpack
import zenoh


def session(socket):
    """A Zenoh client of one robot's bus."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["unixsock-stream/{socket}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def report(x, y, heading=None):
    """The message that the dwm service takes: docs/reference/keys.md, ExternalReport."""
    fields = {"x": x, "y": y}
    return msgpack.packb(fields if heading is None else {**fields, "heading": heading})


def main():
    """Publish each line at its time, counted from the first one."""
    path, *robots = sys.argv[1:]
    sessions = {name: session(socket) for name, socket in (each.split("=", 1) for each in robots)}
    with Path(path).open(newline="") as file:
        rows = [row for row in csv.reader(file) if row]
    began = time.monotonic() - float(rows[0][0])
    for t, robot, x, y, *heading in rows:
        time.sleep(max(0.0, began + float(t) - time.monotonic()))
        if robot in sessions:
            sessions[robot].put(f"swarm/{robot}/dwm/set/report", report(float(x), float(y), *map(float, heading)))
    for each in sessions.values():
        each.close()


if __name__ == "__main__":
    main()
