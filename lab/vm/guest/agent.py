"""Inside a lab machine: runs what the host asks for, over a serial line; Debian's Python, nothing else.

A request is a line of JSON {"id", "command", "seconds"}, its answer {"id", "code", "output"}; many may be on their way.
The host's folder comes in at /share.
"""

import contextlib
import json
import os
import signal
import subprocess
import tempfile
import threading
import tty
from pathlib import Path
from typing import Any

AGENT, RADIO = "/dev/ttyS1", "/dev/ttyS2"
"""Serial lines to the host; the first one is the robot's."""

OUTPUT_LIMIT = 200_000
"""Characters of a command's output that are kept: its end."""


def line(device: str) -> int:
    """That serial line, for bytes as they are."""
    made = os.open(device, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(made)
    return made


def word(name: str) -> str:
    """What the host has said with that name when it switched this machine on."""
    words = dict(each.partition("=")[::2] for each in Path("/proc/cmdline").read_text().split())
    return words[f"lab.{name}"]


def run(command: str, seconds: float) -> tuple[int, str]:
    """A shell command, its exit code (124: it took too long) and what it said; its children may live on."""
    with tempfile.TemporaryFile() as said:
        # A file and no pipe: a daemon that keeps its output open must not keep us.
        process = subprocess.Popen(
            ["/bin/sh", "-c", command], stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True
        )
        late = threading.Event()

        def end() -> None:
            late.set()
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)

        # Popen.wait with a time-out would look twenty times a second.
        timer = threading.Timer(seconds, end)
        timer.start()
        code = process.wait()
        timer.cancel()
        code = 124 if late.is_set() else code
        said.seek(0)
        return code, said.read().decode(errors="replace")[-OUTPUT_LIMIT:]


def serve(stream: int) -> None:
    """Until the machine goes off."""
    lock = threading.Lock()

    def answer(request: dict[str, Any]) -> None:
        code, output = run(request["command"], request["seconds"])
        line = json.dumps({"id": request["id"], "code": code, "output": output}).encode() + b"\n"
        with lock:
            while line:
                line = line[os.write(stream, line) :]

    with lock:
        os.write(stream, b'{"id": 0, "code": 0, "output": "up"}\n')
    rest = b""
    while True:
        data = os.read(stream, 65536)
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            threading.Thread(target=answer, args=(json.loads(line),), daemon=True).start()


def main() -> None:
    """Serve the host until the machine goes off."""
    Path("/share").mkdir(exist_ok=True)
    # What is written there the host sees at once.
    subprocess.run(["mount", "-t", "hostfs", "-o", f"sync,hostfs={word('share')}", "share", "/share"], check=True)
    for command in (f"ip address replace {word('address')}/30 dev vec0", "ip link set vec0 up"):
        subprocess.run(command.split(), check=True)
    serve(line(AGENT))


if __name__ == "__main__":
    main()
