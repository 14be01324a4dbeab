"""A Bluetooth adapter of this robot, over a raw HCI socket, for requests that the kernel has no other call for."""

import socket
from collections.abc import Callable
from typing import Any, TypeVar

from swarm import clock
from swarm.bluetooth import hci
from swarm.errors import FrameError, LocalError

TIMEOUT = 1.0
"""Seconds for an answer of the adapter."""

SWITCH_TIMEOUT = 6.0
"""Seconds for a switch of roles. Both adapters must hear each other, and one that pages an absent robot hears nobody
for 5 s."""

Open = Callable[[], socket.socket]
Ioctl = Callable[[Any, int, bytearray], object]
Answer = TypeVar("Answer")


def kernel_ioctl(sock: Any, request: int, data: bytearray) -> object:
    """Call the kernel's ioctl with `data`, which it fills."""
    import fcntl  # here, since simulations on Windows import this module and have no adapter

    return fcntl.ioctl(sock, request, data)


def open_socket() -> socket.socket:
    """Open a raw HCI socket. Raises `LocalError` where Python was built without Bluetooth."""
    if not hasattr(socket, "AF_BLUETOOTH"):
        raise LocalError("this Python was built without Bluetooth sockets; Debian's python3 has them")
    return socket.socket(socket.AF_BLUETOOTH, socket.SOCK_RAW, socket.BTPROTO_HCI)


def check(status: int) -> None:
    """Raises `LocalError` where an answer's status says that the adapter has not done it."""
    if status:
        raise LocalError(f"the adapter refuses: HCI status {status:#04x}")


class Adapter:
    """The adapter with an address. Errors of the kernel are OSError, of which `hci` says what they mean."""

    def __init__(self, address: str, *, open_socket: Open = open_socket, ioctl: Ioctl = kernel_ioctl) -> None:
        """Raises `LocalError` where no adapter here has that address."""
        self._ioctl = ioctl
        self._socket = open_socket()
        try:
            self._socket.settimeout(TIMEOUT)
            self._socket.bind((self._number(hci.packed_address(address), address),))
            self._socket.setsockopt(hci.SOL_HCI, hci.HCI_FILTER, hci.FILTER)
        except BaseException:
            self._socket.close()
            raise

    def close(self) -> None:
        self._socket.close()

    def handle(self, peer: str) -> int:
        """Return the handle of the connection with the Bluetooth address `peer`. Raises `LocalError` where there is
        none."""
        return hci.connection_handle(self._connection(peer))

    def is_central(self, peer: str) -> bool:
        """Return whether this adapter is the central of that connection; `LocalError` where there is none."""
        return hci.is_central(self._connection(peer))

    def is_connected(self, peer: str) -> bool:
        """Return whether there is a connection to that address, not only a page."""
        try:
            return hci.is_connected(self._connection(peer))
        except LocalError:
            return False

    def be_central(self, peer: str) -> None:
        """Ask for a switch of roles and wait for its end; `LocalError` where the other adapter or this one refuses."""
        address = hci.packed_address(peer)
        command = hci.switch_role(address, hci.CENTRAL)
        check(self.ask(command, lambda packet: hci.switched_role(packet, address), SWITCH_TIMEOUT))

    def read(self, what: int, peer: str) -> int | None:
        """Read a status parameter of the connection with `peer` by its opcode; None where the adapter does not know
        the command. Raises `LocalError` without a connection or an answer."""
        handle = self.handle(peer)

        def answer(packet: bytes) -> hci.Reading | None:
            found = hci.reading(packet, what)
            return None if found is not None and found.status == 0 and found.handle != handle else found

        found = self.ask(hci.read(what, handle), answer)
        if found.status == hci.UNKNOWN_COMMAND:
            return None
        if found.status == hci.NO_CONNECTION:
            raise LocalError(f"there is no connection to {peer} any more")
        check(found.status)
        return found.value

    def _connection(self, peer: str) -> bytearray:
        info = hci.connection_info(hci.packed_address(peer))
        try:
            self._ioctl(self._socket, hci.CONNECTION_INFO, info)
        except FileNotFoundError:
            raise LocalError(f"there is no Bluetooth connection to {peer}") from None
        return info

    def ask(self, command: bytes, answer: Callable[[bytes], Answer | None], timeout: float | None = None) -> Answer:
        """Send a command; the first packet that `answer` makes something of. `LocalError` where none comes within
        `timeout` s, by default `TIMEOUT`: others ask the adapter, too, and hear our answers as we hear theirs."""
        timeout = TIMEOUT if timeout is None else timeout
        self._socket.send(command)
        end = clock.now() + timeout
        while (left := end - clock.now()) > 0:
            self._socket.settimeout(left)
            try:
                found = answer(self._socket.recv(260))
            except TimeoutError:
                break
            except FrameError:
                continue
            if found is not None:
                return found
        raise LocalError(f"the adapter does not answer ({timeout:g} s)")

    def _number(self, address: bytes, text: str) -> int:
        listed = hci.device_list()
        self._ioctl(self._socket, hci.DEVICE_LIST, listed)
        for number in hci.devices(listed):
            info = hci.device_info(number)
            self._ioctl(self._socket, hci.DEVICE_INFO, info)
            if hci.device_address(info) == address:
                return number
        raise LocalError(f"no Bluetooth adapter here has the address {text}: is this the robot?")
