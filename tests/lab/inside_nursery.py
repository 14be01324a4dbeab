"""Inside a machine: services whose modules are imported once for all of them, since importing is most of what starting
a dozen of them costs an emulated processor.

Reads lines of JSON {"environment", "module", "words"} from its standard input; for each it forks the service and prints
its process id. They are its children and end with it.
"""

import ctypes
import json
import os
import runpy
import signal
import sys
import threading
from pathlib import Path

import services.apps.__main__
import services.mesh.__main__  # noqa: F401  imported for those to come


def main() -> None:
    """Until standard input ends."""
    # Whole processes are copied, and of threads only this one would be.
    assert threading.active_count() == 1
    assert len(list(Path("/proc/self/task").iterdir())) == 1
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    for line in sys.stdin:
        order = json.loads(line)
        if (child := os.fork()) == 0:
            ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            os.environ.update(order["environment"])
            log = os.open(Path(os.environ["SWARM_RUNTIME"]) / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(log, 2)  # a pipe that nobody reads would fill
            sys.argv = [order["module"], *order["words"]]
            sys.modules.pop(f"{order['module']}.__main__")
            runpy.run_module(order["module"], run_name="__main__")
            return
        sys.stdout.write(f"{child}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
