"""Inside a lab machine: its Bluetooth controller is on the host. Joins /dev/vhci to a serial line.

The kernel gives and takes whole HCI packets at /dev/vhci; on the serial line they follow one another (H4).
"""

import errno
import os
import select
import sys

from agent import RADIO, line

COMMAND, ACL, EVENT, VENDOR = 1, 2, 4, 0xFF
HEADERS = {COMMAND: (4, 3, 1), ACL: (5, 3, 2), EVENT: (3, 2, 1)}
"""Of each packet type: length of its header, where the length of the rest is, in how many bytes."""


def packets(rest: bytes) -> tuple[list[bytes], bytes]:
    """The whole packets at the beginning of these bytes, and what is left."""
    found = []
    while rest:
        header, at, width = HEADERS[rest[0]]
        size = header + int.from_bytes(rest[at : at + width], "little")
        if len(rest) < max(header, size):
            break
        found.append(rest[:size])
        rest = rest[size:]
    return found, rest


def deliver(vhci: int, packet: bytes) -> None:
    """Give the kernel a packet; what an adapter hears that has just been switched off is nobody's, as on a real one."""
    try:
        os.write(vhci, packet)
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise


def main() -> None:
    """Until the host's radio has gone."""
    serial, vhci = line(RADIO), os.open("/dev/vhci", os.O_RDWR)
    os.write(vhci, bytes((VENDOR, 0)))
    rest = b""
    while True:
        ready, _, _ = select.select([serial, vhci], [], [])
        if vhci in ready:
            packet = os.read(vhci, 4096)
            if packet and packet[0] != VENDOR:
                while packet:  # the serial line takes a part where it has no room for all
                    packet = packet[os.write(serial, packet) :]
        if serial in ready:
            data = os.read(serial, 65536)
            if not data:
                sys.exit("the host's radio has gone")
            found, rest = packets(rest + data)
            for packet in found:
                deliver(vhci, packet)


if __name__ == "__main__":
    main()
