"""Orders faults of the lab's I2C bus, and prints how the robot is, both JSON: `python3 order.py SOCKET [FAULTS]`.

Debian's Python alone: a test asks often, and starting it is what takes the time.
"""

import json
import os
import socket
import sys
from pathlib import Path
from typing import Any

ANSWER_S = 10.0


def order(at: str, faults: dict[str, Any]) -> dict[str, Any]:
    """The report of the robot behind the bus; TimeoutError where there is none."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as own:
        own.settimeout(ANSWER_S)
        path = f"{at}.{os.getpid()}"
        own.bind(path)
        try:
            own.sendto(json.dumps(faults).encode(), at)
            return dict(json.loads(own.recv(4096)))
        finally:
            Path(path).unlink()


if __name__ == "__main__":
    sys.stdout.write(json.dumps(order(sys.argv[1], json.loads(sys.argv[2]) if sys.argv[2:] else {})) + "\n")
