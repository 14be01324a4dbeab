"""Inside a machine that is one robot: its bus, mesh and app over its own adapter.

`inside_robot_mesh.py NAME ITERATIONS` says `reached` when its app has reached that; it ends, and leaves its recording
in the shared folder, when /tmp/go-on is removed.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from conftest import Processes, wait_until
from inside_swarm import SHARE, Swarm

GO_ON = Path("/tmp/go-on")


def bring_up() -> None:
    """The adapter answers calls; without bluetoothd nobody else sees to that."""
    wait_until(lambda: subprocess.run(["hciconfig", "hci0", "up"], capture_output=True, check=False).returncode == 0)
    for words in (("sspmode", "0"), ("piscan",)):
        subprocess.run(["hciconfig", "hci0", *words], check=True)


def main() -> None:
    name, iterations = sys.argv[1], int(sys.argv[2])
    bring_up()
    with tempfile.TemporaryDirectory(prefix="sw", dir="/tmp") as folder:
        processes = Processes(Path(folder))
        swarm = Swarm(processes, "swarm", [name])
        try:
            swarm.run(iterations)
            wait_until(lambda: swarm.reached[name] >= iterations, 40, f"{swarm.reached}: {swarm.logs()}")
            sys.stdout.write("reached\n")
            sys.stdout.flush()
            # Neighbours may still need what we have sent last.
            while GO_ON.exists():
                time.sleep(0.2)
            swarm.end()
            subprocess.run(["cp", "-r", str(swarm.records), str(SHARE)], check=True)
        finally:
            swarm.close()


if __name__ == "__main__":
    main()
