"""Inside a lab machine: runs what the host asks for, over a virtio-serial port; Debian's Python, nothing else.

A request is a line of JSON {"id", "command", "seconds"}, its answer {"id", "code", "output"}; many may be on their way.
The host's folder comes in at /share. A machine may be one that another has saved (lab.vm.saved): then its host tells it
first what is its own, {"id", "resumed"}.
"""

import contextlib
import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

PORTS = Path("/sys/class/virtio-ports")
OUTPUT_LIMIT = 200_000
"""Characters of a command's output that are kept: its end."""
MIX_ANEW = 0x5207
"""RNDRESEEDCRNG: random numbers follow from what has been mixed in by now."""


def port(name: str) -> Path:
    """The device of the virtio-serial port with that name, once it is there."""
    while True:
        for found in PORTS.glob("*/name"):
            if found.read_text().strip() == name:
                return Path("/dev") / found.parent.name
        time.sleep(0.05)


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


def mount_share() -> None:
    """The host's folder."""
    options = "trans=virtio,version=9p2000.L,msize=262144,cache=none"
    subprocess.run(["mount", "-t", "9p", "-o", options, "share", "/share"], check=False)


def resume(name: str, now: float, seed: str, radio: bool) -> None:
    """Be a machine of that name at that time: what many have from one is the same in all of them."""
    socket.sethostname(name)
    time.clock_settime(time.CLOCK_REALTIME, now)
    with Path("/dev/urandom").open("wb", 0) as pool:
        pool.write(bytes.fromhex(seed))
        fcntl.ioctl(pool, MIX_ANEW)
    mount_share()
    if radio:
        subprocess.Popen([sys.executable, str(Path(__file__).with_name("radio.py"))], start_new_session=True)


def serve(stream: int) -> None:
    """Until the machine goes off."""
    lock = threading.Lock()

    def answer(request: dict[str, Any]) -> None:
        if "resumed" in request:
            code, output = 0, "up"
            resume(**request["resumed"])
        else:
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
        if not data:
            time.sleep(0.02)  # no host, until this machine is saved and another one has it
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            threading.Thread(target=answer, args=(json.loads(line),), daemon=True).start()


def main() -> None:
    """Serve the host until the machine goes off."""
    subprocess.run(["modprobe", "-a", "virtio_console", "virtio_net", "9p", "9pnet_virtio"], check=False)
    Path("/share").mkdir(exist_ok=True)
    mount_share()
    # Where QEMU's user network expects us, so that the host reaches our ssh.
    for command in ("ip link set eth0 up", "ip address replace 10.0.2.15/24 dev eth0"):
        subprocess.run(command.split(), check=False)
    serve(os.open(port("lab"), os.O_RDWR))


if __name__ == "__main__":
    main()
