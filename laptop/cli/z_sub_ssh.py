"""`z_sub --robot NAME` of a real robot: the robot's own z_sub at the other end of an ssh connection.

The robot decodes: no socket of its bus is opened to the laptop, and its user needs no more than all commands for robots
do (sudo). The far z_sub ends when its input does, so nothing stays behind on a robot whose connection broke.
"""

import argparse
import asyncio
import contextlib
import json
import shlex
import sys

from laptop.fleet.core.answers import MISUNDERSTOOD, misunderstood
from laptop.fleet.ssh import Host, HostError, Ssh, explain, hosts, last_words
from swarm.config import load
from swarm.errors import LocalError, PayloadError
from swarm.messages.json_input import read_json

PROGRAM = "/opt/swarm/current/bin/z_sub"
_PREFIX = "z_sub: "
_CLIENT_FAILED = 255
_LONGEST_LINE = 1 << 23
"""Bytes: the largest message as JSON."""


def watch(options: argparse.Namespace) -> int:
    """Print what the robots print until all end; 2 where one could not be reached or its z_sub failed."""
    ssh = Ssh(options.ssh_config)
    names = list(dict.fromkeys(options.robot))
    chosen = hosts(load(options.config), ",".join(names))
    command = _command(options)
    failed = asyncio.run(_all(ssh, chosen, command, as_json=options.json))
    return 2 if failed else 0


def _command(options: argparse.Namespace) -> str:
    words = ["sudo", "-n", PROGRAM, "--while-input", *options.keys]
    for name in options.key:
        words += ["--key", name]
    words += ["--rate"] * options.rate + ["--json"] * options.json
    for name, value in (("--count", options.count), ("--seconds", options.seconds)):
        if value is not None:
            words += [name, str(value)]
    return shlex.join(words)


async def _all(ssh: Ssh, robots: tuple[Host, ...], command: str, *, as_json: bool) -> bool:
    """Whether one has failed; the others go on."""
    alone = len(robots) == 1

    async def one(host: Host) -> bool:
        try:
            await _one(ssh, host, command, as_json=as_json, alone=alone)
        except HostError as error:
            _tell(f"{host.robot}: {error}")
            return True
        except MISUNDERSTOOD as error:
            _tell(f"{host.robot}: {misunderstood(error)}")
            return True
        return False

    return any(await asyncio.gather(*map(one, robots)))


async def _one(ssh: Ssh, host: Host, command: str, *, as_json: bool, alone: bool) -> None:
    pipe = asyncio.subprocess.PIPE
    try:
        process = await asyncio.create_subprocess_exec(
            *ssh.arguments(host, command), stdin=pipe, stdout=pipe, stderr=pipe, limit=_LONGEST_LINE
        )
    except FileNotFoundError:
        raise LocalError("there is no ssh here: sudo apt-get install openssh-client") from None
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        err, _ = await asyncio.gather(
            _complaints(process.stderr, host), _lines(process.stdout, host, as_json=as_json, alone=alone)
        )
        code = await process.wait()
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
    if code == _CLIENT_FAILED:
        raise HostError(explain(host, err))
    if code != 0:
        raise HostError(last_words(err) or f"z_sub there: exit code {code}")


async def _lines(stream: asyncio.StreamReader, host: Host, *, as_json: bool, alone: bool) -> None:
    async for data in stream:
        line = data.decode(errors="replace")
        if as_json:
            with contextlib.suppress(PayloadError):
                if isinstance(sample := read_json(line), dict):
                    line = json.dumps(sample | {"robot": host.robot}) + "\n"
        elif not alone:
            line = f"[{host.robot}] {line}"
        sys.stdout.write(line)
        sys.stdout.flush()


async def _complaints(stream: asyncio.StreamReader, host: Host) -> str:
    """What the far z_sub says is said here at once; the rest is ssh's, and is explained at its end."""
    rest = []
    async for data in stream:
        line = data.decode(errors="replace")
        if line.startswith(_PREFIX):
            _tell(f"{host.robot}: {line.removeprefix(_PREFIX).rstrip()}")
        else:
            rest.append(line)
    return "".join(rest)


def _tell(text: str) -> None:
    with contextlib.suppress(OSError):
        sys.stderr.write(_PREFIX + text + "\n")
        sys.stderr.flush()
