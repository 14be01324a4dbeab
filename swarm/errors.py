"""Errors of the whole project: who was wrong decides what to do.

`LocalError`: our side misused something (a wrong config, a wrong argument); the message says what, where and
how to mend it; a command ends with it. `RemoteError`: bytes from elsewhere were wrong (a frame, a payload);
the receiver drops and counts them and goes on.
"""

import re

LONGEST_SHOWN = 60
"""Letters of a value within an error."""


class SwarmError(Exception):
    """Base of all errors a caller may want to catch; never raised itself."""


class LocalError(SwarmError):
    """We did something wrong: mend the call, the config or the command."""


class RemoteError(SwarmError):
    """The other side sent something wrong: drop it, count it, go on."""


def shown(value: object) -> str:
    """Return a value as one short line for an error. A value whose `repr` raises is named by its type: an author's own
    may do so, and an int of too many digits does."""
    try:
        text = repr(value)
    except Exception:  # noqa: BLE001 - whatever an author's `__repr__` raises
        return f"a {type(value).__name__}"
    # An address in memory would make each text another one.
    return cut(" ".join(re.sub(" at 0x[0-9A-Fa-f]+", "", text).split()), LONGEST_SHOWN)


def cut(text: str, longest: int) -> str:
    """Return a text, or its first letters and "..." where it is longer than `longest` letters."""
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


class MissingPackageError(LocalError):
    """A package is not installed; the message names the extra of pyproject.toml that installs it."""

    def __init__(self, what: str, package: str, extra: str, robot: str = "") -> None:
        """Say that `what` needs `package`: the extra `extra` has it, and the extra `robot` where this is a robot."""
        on_a_robot = f' (on a robot: "balboa-swarm[{robot}]")' if robot else ""
        super().__init__(f'{what} needs {package}: pip install "balboa-swarm[{extra}]"{on_a_robot}')


class ConfigError(LocalError):
    """An entry of swarm.toml is wrong; names file, table, key and what was expected."""


class AppError(LocalError):
    """An application file is wrong: no app class, a state of a wrong type, a state too large."""


class BusError(LocalError):
    """The local bus cannot be used: no socket, path too long, socket held by another process."""


class PayloadError(RemoteError):
    """A bus payload is not what its key demands; names key and field."""


class FrameError(RemoteError):
    """Bytes from a mesh peer are not a valid frame."""


class RecordingError(LocalError):
    """A recording is missing, truncated or not numeric; names file and line."""
