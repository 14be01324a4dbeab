"""Inside a machine: one end of an encrypted link. `inside_peer.py listen|advertise|dial-encrypted OWN OTHER` prints
what came; with `dial-plain` the caller does not want encryption.

The caller says something and the called one answers. Both print the security level of their socket, as the kernel has
it. The called one serves all callers until it is ended; its process id is in /tmp/peer. With `advertise` there is a
service record of the mesh meanwhile.

A call that meets the end of an earlier connection or session is refused or reset by the kernel, some calls before they
are accepted and some after. The mesh calls again then, and so does this program.
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
AGAIN = (errno.ECONNRESET, errno.ECONNABORTED, errno.ECONNREFUSED, errno.EBUSY, errno.EALREADY)
"""Errors of a call that meets the end of an earlier connection. Who is refused for good gets one of them, too."""
CALLS_S = 6.0
"""Seconds after which the caller gives up; an RFCOMM session ends 2 s after its last connection."""


def read(pipe: Pipe) -> bytes:
    """Return the next bytes, empty at the end of the connection."""
    while True:
        assert select.select([pipe], [], [], SECONDS)[0], "nothing comes"
        pipe.read(clock.now())
        if (data := pipe.take(clock.now())) is not None:
            return data


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def describe(pipe: Pipe, data: bytes) -> str:
    level, _ = struct.unpack("BB", pipe._sock.getsockopt(rfcomm.SOL_BLUETOOTH, rfcomm.BT_SECURITY, 2))
    return f"{data!r} level {level} robot {pipe.caller.robot}"


def call(radio: rfcomm.Radio, other: str) -> None:
    end = time.monotonic() + CALLS_S
    while True:
        try:
            pipe = rfcomm.dial(radio, other)
        except OSError as error:
            if error.errno not in AGAIN or time.monotonic() > end:
                sys.exit(f"refused: {error}")
        else:
            pipe.offer(b"encrypted")
            pipe.flush()
            if data := read(pipe):
                say(describe(pipe, data))
                return
            pipe.close()
            assert time.monotonic() < end, "all calls are reset"
        time.sleep(0.5)


def serve(listener: rfcomm.RfcommListener) -> None:
    say("listening")
    while True:
        select.select([listener], [], [])
        pipe = listener.accept()
        if data := read(pipe):
            say(describe(pipe, data))
            pipe.offer(b"and back")
            pipe.flush()
            read(pipe)  # until the caller has it and goes
        pipe.close()


def main() -> None:
    role, own, other = sys.argv[1:]
    radio = rfcomm.Radio(own, CHANNEL, encrypt=role != "dial-plain")
    if role.startswith("dial"):
        call(radio, other)
        return
    Path("/tmp/peer").write_text(str(os.getpid()))
    listener = rfcomm.RfcommListener(radio, {other: "r0"})
    # The record stays with its descriptor, which closes with this process.
    record = pybluez.Record(listener.fileno()) if role == "advertise" else None
    try:
        serve(listener)
    finally:
        if record is not None:
            record.close()


if __name__ == "__main__":
    main()
