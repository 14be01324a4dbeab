"""`z_sub --robots NAME` of a real robot: the robot's own z_sub at the other end of an ssh connection.

The robot decodes: no socket of its bus is opened to the laptop, and its user needs no more than all commands for robots
do (sudo). The far z_sub ends when its input does, so nothing stays behind on a robot whose connection broke.
"""

import argparse
import asyncio
import contextlib
import json
import shlex
import sys

from laptop.fleet.ssh.everyone import FAILURES, failure, together
from laptop.fleet.ssh.ssh import CURRENT, Host, HostError, Ssh, hosts, last_words
from swarm.config import load
from swarm.errors import PayloadError
from swarm.messages.json_input import read_json
from swarm.onboard.command_line import complain

_PREFIX = "z_sub: "


def watch(options: argparse.Namespace) -> int:
    """Print what the robots print until all end; 2 where one could not be reached or its z_sub failed."""
    ssh = Ssh(options.ssh_config)
    chosen = hosts(load(options.config, addressed=False), options.robots)
    command = _command(options)
    failed = asyncio.run(_all(ssh, chosen, command, as_json=options.json))
    return 2 if failed else 0


def _command(options: argparse.Namespace) -> str:
    words = ["sudo", "-n", f"{CURRENT}/bin/z_sub", "--while-input", *options.keys]
    for name in options.key:
        words += ["--key", name]
    words += ["--rate"] * options.rate + ["--json"] * options.json
    for name, value in (("--count", options.count), ("--seconds", options.seconds)):
        if value is not None:
            words += [name, str(value)]
    return shlex.join(words)


async def _all(ssh: Ssh, robots: tuple[Host, ...], command: str, *, as_json: bool) -> bool:
    """Return whether one has failed; the others go on."""

    async def one(host: Host) -> bool:
        try:
            await _one(ssh, host, command, "" if len(robots) == 1 else f"[{host.robot}] ", as_json=as_json)
        except FAILURES as error:
            complain("z_sub", f"{host.robot}: {failure(error, 0.0)}")
            return True
        return False

    return any(await together(map(one, robots)))


async def _one(ssh: Ssh, host: Host, command: str, prefix: str, *, as_json: bool) -> None:
    """Print what one robot prints; what its z_sub says on its standard error is said here at once."""

    def line(text: str) -> None:
        if as_json:
            with contextlib.suppress(PayloadError):
                if isinstance(sample := read_json(text), dict):
                    text = json.dumps(sample | {"robot": host.robot})
        sys.stdout.write(f"{text}\n" if as_json else f"{prefix}{text}\n")
        sys.stdout.flush()

    told = False

    def complaint(text: str) -> None:
        nonlocal told
        if text.startswith(_PREFIX):
            complain("z_sub", f"{host.robot}: {text.removeprefix(_PREFIX).rstrip()}")
            told = True

    # The far z_sub ends when its input does, which stays open as long as this runs.
    done = await ssh.run(host, command, on_line=line, on_complaint=complaint, hold=asyncio.Event())
    if done.code != 0:
        raise HostError(("" if told else last_words(done.err)) or f"z_sub there: exit code {done.code}")
