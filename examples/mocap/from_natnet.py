"""Gives robots the poses that OptiTrack streams: `[dwm] source = "bus:swarm/{robot}/dwm/set/report"` in swarm.toml.

    python from_natnet.py 239.255.42.99 1=r0:/run/swarm/bus.sock [2=r1:/tmp/r1.sock ...]

The first argument is the multicast address of the stream. The others name, for each streaming id of a rigid body, the
robot and the socket of its bus. Motive must stream rigid bodies with the Z axis up. Of each packet only the rigid
bodies are read. The format is that of NatNet 3.0 and 4.0: little endian, frame of mocap data (message 7), frame number,
marker sets, other markers, then the rigid bodies: id, x, y, z (m), qx, qy, qz, qw, mean error, parameters.
Since NatNet 4.1 each of the three sections has its size in bytes behind its count: name such a stream with `--sizes`.
"""

import math
import socket
import struct
import sys

from from_csv import report, session

PORT = 1511
FRAME = 7
"""The message that holds a frame of mocap data."""
BODY = struct.Struct("<i7ffh")
"""A rigid body: id, place, quaternion, mean error, parameters (bit 0: it is tracked)."""


class Reader:
    """Reads a packet from its beginning; `ValueError` where it ends too early."""

    def __init__(self, data):
        self.data = data
        self.at = 0

    def take(self, size):
        """The next bytes."""
        if size < 0 or self.at + size > len(self.data):
            raise ValueError(f"the packet of {len(self.data)} bytes ends within {size} bytes at {self.at}")
        self.at += size
        return self.data[self.at - size : self.at]

    def integer(self):
        """The next signed number of 32 bits."""
        return int.from_bytes(self.take(4), "little", signed=True)

    def text(self):
        """The bytes up to the next zero."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise ValueError("a name in the packet has no end")
        return self.take(end + 1 - self.at)[:-1]


def rigid_bodies(packet, sizes=False):
    """(id, x, y, heading) of each rigid body that is tracked: m, and rad counter-clockwise from x."""
    reader = Reader(packet)
    message, _ = struct.unpack("<HH", reader.take(4))
    if message != FRAME:
        return []
    reader.integer()  # the number of the frame
    sets = reader.integer()
    if sizes:
        reader.take(reader.integer())
    else:
        for _ in range(sets):
            reader.text()
            reader.take(12 * reader.integer())
    others = reader.integer()
    reader.take(reader.integer() if sizes else 12 * others)
    count = reader.integer()
    if sizes:
        reader.integer()
    found = []
    for _ in range(count):
        name, x, y, _, qx, qy, qz, qw, _, parameters = BODY.unpack(reader.take(BODY.size))
        if parameters & 1:
            found.append((name, x, y, math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))))
    return found


def main():
    """Translate the stream until interrupted."""
    sizes = "--sizes" in sys.argv
    group, *bodies = [word for word in sys.argv[1:] if word != "--sizes"]
    robots = {}
    for each in bodies:
        number, _, rest = each.partition("=")
        robot, _, path = rest.partition(":")
        robots[int(number)] = (robot, session(path))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stream:
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        stream.bind(("", PORT))
        if group.startswith(("224.", "239.")):
            membership = socket.inet_aton(group) + struct.pack("!I", socket.INADDR_ANY)
            stream.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        while True:
            try:
                found = rigid_bodies(stream.recv(65536), sizes)
            except ValueError as error:
                print(f"a packet is left out: {error}", file=sys.stderr)
                continue
            for number, x, y, heading in found:
                if number in robots:
                    robot, bus = robots[number]
                    bus.put(f"swarm/{robot}/dwm/set/report", report(x, y, heading))


if __name__ == "__main__":
    main()
