"""Inside a machine: one end of an encrypted link. `inside_peer.py listen|advertise|dial-encrypted OWN OTHER` prints
what came; with `dial-plain` the caller does not want encryption.

The caller says something, the called one answers; both tell the security level of their socket, as the kernel has it.
With `advertise` it listens, too, and there is a service record of the mesh. Its process id is in /tmp/peer.
"""

import errno
import os
import select
import struct
import sys
import time
from pathlib import Path

from services.mesh.links import pybluez, rfcomm
from services.mesh.links.pipe import Pipe
from swarm import clock

CHANNEL = 4
SECONDS = 120


def call(radio: rfcomm.Radio, other: str) -> Pipe:
    """As the mesh does it: again where it met the end of an earlier link."""
    end = time.monotonic() + 20
    while True:
        try:
            return rfcomm.dial(radio, other)
        except OSError as error:
            if error.errno != errno.ECONNRESET or time.monotonic() > end:
                sys.exit(f"refused: {error}")
        time.sleep(0.5)


def main() -> None:
    role, own, other = sys.argv[1:]
    radio = rfcomm.Radio(own, CHANNEL, encrypt=role != "dial-plain")
    record = None
    Path("/tmp/peer").write_text(str(os.getpid()))
    if not role.startswith("dial"):
        listener = rfcomm.Listener(radio, {other: "r0"})
        if role == "advertise":
            record = pybluez.Record(listener.fileno())
        sys.stdout.write("listening\n")
        sys.stdout.flush()
        assert select.select([listener], [], [], SECONDS)[0], "nobody calls"
        pipe = listener.accept()
    else:
        pipe = call(radio, other)
        pipe.offer(b"encrypted")
        pipe.flush()
    data = None
    while data is None:
        assert select.select([pipe], [], [], SECONDS)[0], "nothing comes"
        pipe.read(clock.now())
        data = pipe.take(clock.now())
    level, _ = struct.unpack("BB", pipe._sock.getsockopt(rfcomm.SOL_BLUETOOTH, rfcomm.BT_SECURITY, 2))
    sys.stdout.write(f"{data!r} level {level} robot {pipe.caller.robot}\n")
    sys.stdout.flush()
    if not role.startswith("dial"):
        pipe.offer(b"and back")
        pipe.flush()
        select.select([pipe], [], [], SECONDS)  # until the caller has it and goes
    if record is not None:
        record.close()


if __name__ == "__main__":
    main()
