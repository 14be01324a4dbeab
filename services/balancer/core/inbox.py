"""Commands that wait in the bridge until the loop takes them: bounded, in order, of a velocity only the newest.

A flood of commands costs its sender's later commands, never a stop: stops do not pass through here.
"""

from typing import NamedTuple

ROOM_EACH = 16
"""The most commands of one key that may wait."""
ROOM_BYTES = 256 * 1024
"""The most bytes of all waiting payloads together."""


class WaitingCommand(NamedTuple):
    """A command as it came from the bus."""

    name: str
    """Key of the command."""
    payload: bytes
    heard: float
    """The time at which the bridge heard it, s of the robot's monotonic clock."""


class Inbox:
    """Takes commands as fast as they come, and gives them away a few at a time."""

    def __init__(self, newest_only: str) -> None:
        """`newest_only`: the key of which a new command replaces the one that waits."""
        self._newest_only = newest_only
        self._number = 0
        self._waiting: dict[int, WaitingCommand] = {}
        """The commands that wait, in the order in which they came."""
        self._numbers: dict[str, list[int]] = {}
        """The numbers of the commands that wait, by key."""
        self._bytes = 0
        self._dropped: dict[str, int] = {}

    def __bool__(self) -> bool:
        """Return whether there is something to take, or a loss to tell of."""
        return bool(self._waiting or self._dropped)

    def put(self, command: WaitingCommand) -> None:
        """Keep a command, or count it as dropped where there is no room for it."""
        numbers = self._numbers.setdefault(command.name, [])
        if numbers and command.name == self._newest_only:
            self._bytes -= len(self._waiting.pop(numbers.pop()).payload)
        if len(numbers) >= ROOM_EACH or self._bytes + len(command.payload) > ROOM_BYTES:
            self._dropped[command.name] = self._dropped.get(command.name, 0) + 1
            return
        self._number += 1
        self._waiting[self._number] = command
        self._bytes += len(command.payload)
        numbers.append(self._number)

    def take(self, most: int) -> list[WaitingCommand]:
        """Return the `most` commands that have waited longest, or fewer, the oldest first."""
        taken: list[WaitingCommand] = []
        while self._waiting and len(taken) < most:
            command = self._waiting.pop(next(iter(self._waiting)))
            self._numbers[command.name].pop(0)
            self._bytes -= len(command.payload)
            taken.append(command)
        return taken

    def dropped(self) -> dict[str, int]:
        """Return how many commands of each key found no room since the last call."""
        dropped, self._dropped = self._dropped, {}
        return dropped
