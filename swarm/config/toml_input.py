"""TOML that comes from elsewhere: a configuration, the notes of a run that a robot has written."""

import tomllib
from typing import Any

from swarm.errors import PayloadError


def read_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text. Raises `PayloadError`."""
    try:
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or int() refusing thousands of digits
        raise PayloadError(f"not valid TOML: {error}") from None
    except RecursionError:
        raise PayloadError("not valid TOML: nested too deeply") from None
