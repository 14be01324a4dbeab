"""Inside a machine that is one robot: its bus, mesh and one app over its own adapter.

`inside_robot_mesh.py NAME CONFIG[,CONFIG]... APP [WORDS...]`: a run for each configuration, one after the other, since
starting Python is most of what it costs. It says how far the app is, a line of JSON each time, until the file
/share/go-on-CONFIG is removed. Recordings are in /share/records-CONFIG, also those of a machine that loses its power.
"""

import json
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from conftest import Processes
from inside_swarm import APPS, SHARE, Swarm

from lab.waiting import until
from swarm.messages import AppEpoch, read

STATE = Path("/var/lib/lab-robot")
EVERY_S = 0.2


def bring_up() -> None:
    """The adapter answers calls; without bluetoothd nobody else sees to that."""
    words = ["hciconfig", "hci0", "up"]
    until("the adapter is up", lambda: subprocess.run(words, capture_output=True, check=False).returncode == 0)
    for words in (("sspmode", "0"), ("piscan",)):
        subprocess.run(["hciconfig", "hci0", *words], check=True)


def main() -> None:
    name, configs, app, *words = sys.argv[1:]
    bring_up()
    with tempfile.TemporaryDirectory(prefix="sw", dir="/tmp") as folder:
        swarm = Swarm(Processes(Path(folder)), "", [name], state=STATE)
        epochs: list[AppEpoch] = []
        key = f"swarm/{name}/app/{Path(app).stem}/epoch"
        swarm.buses[name].subscribe(key, lambda key, payload: epochs.append(read(key, payload)))
        try:
            for number, swarm.config in enumerate(configs.split(",")):
                swarm.records = SHARE / f"records-{swarm.config}"
                swarm.records.mkdir(exist_ok=True)
                swarm.reached[name] = -1
                epochs.clear()
                swarm.start_meshes()
                swarm.start(APPS, name, app, *words, "--run", f"{number}ab")
                tell(swarm, name, epochs)
                swarm.end_services()
            swarm.end()
        finally:
            sys.stderr.write(swarm.logs())
            swarm.close()


def tell(swarm: Swarm, name: str, epochs: list[AppEpoch]) -> None:
    """Say how far it is until this run shall end."""
    pause, told = threading.Event(), None
    while (SHARE / f"go-on-{swarm.config}").exists():
        number, members = (epochs[-1].epoch, epochs[-1].members) if epochs else (0, ())
        now = {"config": swarm.config, "k": swarm.reached[name], "epoch": number, "members": members}
        if now != told:
            sys.stdout.write(json.dumps(now) + "\n")
            sys.stdout.flush()
        told = now
        pause.wait(EVERY_S)


if __name__ == "__main__":
    main()
