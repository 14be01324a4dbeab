"""Inside a machine: one end of an encrypted mesh link. `inside_peer.py listen|dial OWN OTHER` prints what came."""

import select
import struct
import sys

from services.mesh.links import pybluez, rfcomm

CHANNEL = 4


def main() -> None:
    role, own, other = sys.argv[1:]
    radio = rfcomm.Radio(own, CHANNEL, encrypt=True)
    if role == "listen":
        listener = rfcomm.Listener(radio, {other: "r0"})
        record = pybluez.Record(listener.fileno())
        sys.stdout.write("listening\n")
        sys.stdout.flush()
        assert select.select([listener], [], [], 120)[0], "nobody calls"
        pipe = listener.accept()
        record.close()
    else:
        pipe = rfcomm.dial(radio, other)
        pipe.offer(b"encrypted")
        pipe.flush()
    level, size = struct.unpack("BB", pipe._sock.getsockopt(rfcomm.SOL_BLUETOOTH, rfcomm.BT_SECURITY, 2))
    assert select.select([pipe], [], [], 60)[0]
    pipe.read(0.0)
    data = pipe.take(0.0)
    if role == "listen":
        pipe.offer(b"and back")
        pipe.flush()
        select.select([pipe], [], [], 60)
    sys.stdout.write(f"{data!r} level {level} key {size} robot {pipe.caller.robot}\n")


if __name__ == "__main__":
    main()
