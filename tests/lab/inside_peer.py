"""Inside a machine: one end of an encrypted link. `inside_peer.py listen|dial OWN OTHER` prints what came.

The caller says something, the called one answers; both tell the security level of their socket, as the kernel has it.
With `listen` there is a service record of the mesh, too. Its process id is in /tmp/peer.
"""

import os
import select
import struct
import sys
from pathlib import Path

from services.mesh.links import pybluez, rfcomm
from swarm import clock

CHANNEL = 4
SECONDS = 120


def main() -> None:
    role, own, other = sys.argv[1:]
    radio = rfcomm.Radio(own, CHANNEL, encrypt=True)
    record = None
    Path("/tmp/peer").write_text(str(os.getpid()))
    if role == "listen":
        listener = rfcomm.Listener(radio, {other: "r0"})
        record = pybluez.Record(listener.fileno())
        sys.stdout.write("listening\n")
        sys.stdout.flush()
        assert select.select([listener], [], [], SECONDS)[0], "nobody calls"
        pipe = listener.accept()
    else:
        try:
            pipe = rfcomm.dial(radio, other)
        except OSError as error:
            sys.exit(f"refused: {error}")
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
    if role == "listen":
        pipe.offer(b"and back")
        pipe.flush()
        select.select([pipe], [], [], SECONDS)  # until the caller has it and goes
    if record is not None:
        record.close()


if __name__ == "__main__":
    main()
