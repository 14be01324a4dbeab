"""The command that reaches a robot."""

import asyncio
import errno
import os

import pytest

from laptop.fleet.ssh.ssh import Host, Ssh
from swarm.errors import LocalError


@pytest.mark.parametrize("number", [errno.EAGAIN, errno.EMFILE, errno.ENOMEM])
def test_a_computer_that_cannot_start_one_more_program_says_so(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    async def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse)
    with pytest.raises(LocalError, match=f"ssh cannot be started: {os.strerror(number)}"):
        asyncio.run(Ssh().check(Host("r0", "r0"), "true"))
