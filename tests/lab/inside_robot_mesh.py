"""Inside a machine that is one robot: its bus, mesh and one app over its own adapter.

`inside_robot_mesh.py NAME CONFIG APP [WORDS...]` says how far the app is, a line of JSON each time, until /share/go-on
is removed. Recordings are in /share/records-CONFIG, also those of a machine that loses its power.
"""

import json
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from conftest import Processes, wait_until
from inside_swarm import APPS, SHARE, Swarm

from swarm.messages import AppEpoch, read

GO_ON = SHARE / "go-on"
STATE = Path("/var/lib/lab-robot")
EVERY_S = 0.2


def bring_up() -> None:
    """The adapter answers calls; without bluetoothd nobody else sees to that."""
    wait_until(lambda: subprocess.run(["hciconfig", "hci0", "up"], capture_output=True, check=False).returncode == 0)
    for words in (("sspmode", "0"), ("piscan",)):
        subprocess.run(["hciconfig", "hci0", *words], check=True)


def main() -> None:
    name, config, app, *words = sys.argv[1:]
    bring_up()
    with tempfile.TemporaryDirectory(prefix="sw", dir="/tmp") as folder:
        processes = Processes(Path(folder))
        swarm = Swarm(processes, config, [name], records=SHARE / f"records-{config}", state=STATE)
        epochs: list[AppEpoch] = []
        key = f"swarm/{name}/app/{Path(app).stem}/epoch"
        swarm.buses[name].subscribe(key, lambda key, payload: epochs.append(read(key, payload)))
        pause, told = threading.Event(), None
        try:
            swarm.start_meshes()
            swarm.start(APPS, name, app, *words)
            while GO_ON.exists():
                epoch = epochs[-1] if epochs else None
                number, members = (epoch.epoch, epoch.members) if epoch else (0, ())
                now = {"k": swarm.reached[name], "epoch": number, "members": members}
                if now != told:
                    sys.stdout.write(json.dumps(now) + "\n")
                    sys.stdout.flush()
                told = now
                pause.wait(EVERY_S)
            swarm.end()
        finally:
            sys.stderr.write(swarm.logs())
            swarm.close()


if __name__ == "__main__":
    main()
