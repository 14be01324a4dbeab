"""Every command that a text names as a way out exists in the command line."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from laptop.cli.commands import SECTIONS
from services.balancer.core import faults
from swarm.onboard import halt
from swarm.onboard.body import mode_change
from swarm.onboard.command_line import CommandGroup, commands_of

ROOT = Path(__file__).parents[3]
SOURCES = (
    "laptop/fleet/core/checks_robot.py",
    "laptop/fleet/core/checks_system.py",
    "services/balancer/core/faults.py",
    "swarm/onboard/halt.py",
    "swarm/onboard/body/mode_change.py",
    "swarm/onboard/commission/core/device_steps.py",
    "swarm/onboard/commission/core/imu_steps.py",
    "swarm/onboard/commission/core/motor_steps.py",
    "swarm/onboard/commission/core/uwb_steps.py",
    "services/dwm/core/module/diagnosis.py",
    "docs/reference/robot/balancer.md",
    "docs/how-to/robots/first-power-on.md",
    "docs/how-to/robots/commission.md",
    "docs/how-to/robots/stand-and-drive.md",
)
NAMED = re.compile(r"\bswarm ([a-z0-9_-]+)(?: ([a-z0-9_-]+))?")
QUOTED = re.compile(r"`([^`\n]*)`|\"([^\"\n]*)\"")
"""Code and texts: in prose `swarm` is a noun, too."""


def named(text: str) -> Iterator[str]:
    """Each command as it is typed behind `swarm`; of a group with the command in it."""
    commands = commands_of(SECTIONS)
    for first, second in NAMED.findall(text):
        inner = commands.get(first)
        yield f"{first} {second}" if isinstance(inner, CommandGroup) and second else first


def exists(command: str) -> bool:
    commands = commands_of(SECTIONS)
    first, _, second = command.partition(" ")
    each = commands.get(first)
    return each is not None and (not second or (isinstance(each, CommandGroup) and second in each.commands))


@pytest.mark.parametrize("name", sorted(faults.RECOVERY))
def test_the_way_out_of_a_fault_is_a_command_that_exists(name: str) -> None:
    found = list(named(faults.RECOVERY[name]))
    assert found
    assert all(map(exists, found)), found


@pytest.mark.parametrize("text", [*mode_change._WAY_OUT.values(), halt.NEXT])
def test_the_way_out_of_a_refusal_is_a_command_that_exists(text: str) -> None:
    found = list(named(text))
    assert found
    assert all(map(exists, found)), found


@pytest.mark.parametrize("path", SOURCES)
def test_docs_and_doctor_name_commands_that_exist(path: str) -> None:
    text = (ROOT / path).read_text()
    spans = [code or said for code, said in QUOTED.findall(text)]
    found = {command for span in spans if span.startswith("swarm ") or "; swarm " in span for command in named(span)}
    assert not {command for command in found if not exists(command)}
