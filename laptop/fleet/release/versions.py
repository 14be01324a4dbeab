"""The versions on robots and their differences: release, configuration and the ATmega's firmware."""

import re
from collections.abc import Mapping

from laptop.fleet.ssh import sections
from laptop.fleet.ssh.ssh import CURRENT, NOT_INSTALLED, OWN_NAME
from swarm.errors import PayloadError, RemoteError
from swarm.frozen import frozen
from swarm.messages.json_input import read_json

_SUM = re.compile(r"[0-9a-f]{64}")


@frozen
class Versions:
    """The versions on one robot; None where it does not tell."""

    release: str | None
    config: str | None
    """SHA-256 of its swarm.toml."""
    firmware: str | None
    """`revision R (layout L)`."""
    name: str | None = None
    """The name under which the robot was installed."""


def question(robot: str) -> str:
    """Return the command for the robot's shell; `parse` reads its answer."""
    key = f"swarm/{robot}/balancer/firmware"
    return sections.ask(
        {
            "release": f"readlink {CURRENT}",
            "name": OWN_NAME,
            "config": "sha256sum /etc/swarm/swarm.toml",
            "firmware": f"sudo -n {CURRENT}/bin/z_sub {key} --count 1 --seconds 2.5 --json",
        }
    )


def parse(text: str) -> Versions:
    """Return the versions by the answer of a robot. Raises `RemoteError` where the robot has no release at all."""
    parts = sections.read(text)
    release = parts.get("release", "").rpartition("/")[2]
    if not release:
        raise RemoteError(NOT_INSTALLED)
    found = _SUM.match(parts.get("config", ""))
    return Versions(
        release, found[0] if found else None, firmware(parts.get("firmware", "")), parts.get("name") or None
    )


def firmware(line: str) -> str | None:
    """Return the firmware's version from a line of z_sub."""
    try:
        value = read_json(line)["value"]
        return f"revision {int(value['revision'])} (layout {int(value['layout'])})"
    except (PayloadError, ValueError, LookupError, TypeError):
        return None


def differences(robots: Mapping[str, Versions], config: str) -> list[str]:
    """Explain in words what differs between robots; `config` is the SHA-256 of the swarm.toml here.

    A robot that does not tell its firmware is no difference: its balancer may be stopped.
    """
    found = []
    if strange := {name: own for name, versions in robots.items() if (own := versions.name) not in (None, name)}:
        found.append(f"other names than in swarm.toml ({_each(strange)}): mend `host` there")
    releases = {name: versions.release for name, versions in robots.items()}
    if len(set(releases.values())) > 1:
        found.append(f"different releases ({_each(releases)}): swarm deploy the same to all of them")
    if others := sorted(name for name, versions in robots.items() if versions.config != config):
        found.append(f"another swarm.toml than here ({' '.join(others)}): swarm deploy brings this one")
    known = {name: versions.firmware for name, versions in robots.items() if versions.firmware is not None}
    if len(set(known.values())) > 1:
        found.append(f"different firmware ({_each(known)}): swarm flash the same to all of them")
    return found


def _each(versions: Mapping[str, str | None]) -> str:
    return ", ".join(f"{name} {version}" for name, version in sorted(versions.items()))
