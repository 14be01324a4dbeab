"""A release, config and key onto one robot, and the switch to it, by the release's own `install`."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from laptop.fleet import transfer
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host, HostError, Ssh
from laptop.fleet.transfer import Release
from laptop.fleet.versions import OWN_NAME
from swarm.config.keyfile import read_keys
from swarm.errors import LocalError

_WHAT = "uname -m; for v in 3.11 3.12 3.13 3.14; do command -v python$v >/dev/null && echo $v; done; true"

_INSTALL = (
    "umask 077; own=$(mktemp -d) || exit 1; trap 'rm -rf $own' EXIT; "
    f"tar --extract --file=- --directory=$own && cd {transfer.FOLDER} && sudo -n ./install --name $robot "
)
"""Config and key come as a tar; nothing of them stays behind in a home folder."""


def read_files(config: Path, key: Path | None) -> dict[str, bytes]:
    """What goes with a release, by the option of `install`; raises `LocalError` where it cannot be read, or is no key
    that only its owner can read."""
    if key is not None:
        read_keys(key)
    files = {}
    for name, path in {"config": config, "key": key}.items():
        if path is not None:
            try:
                files[name] = path.read_bytes()
            except OSError as error:
                raise LocalError(f"{path} cannot be read: {error.strerror}") from None
    return files


async def check_name(ssh: Ssh, host: Host) -> None:
    """Raises `HostError` where the robot at this address was installed under another name."""
    found = (await ssh.check(host, OWN_NAME)).strip()
    if found not in ("", host.robot):
        raise HostError(
            f"at {host.address} is {found} by its own word: mend `host` in swarm.toml, "
            f"or --rename makes it {host.robot}"
        )


async def install(
    ssh: Ssh, host: Host, releases: Sequence[Release], files: Mapping[str, bytes], tell: ReportProgress
) -> tuple[str, int]:
    """Bring and install the release that fits the robot; what `install` said last, and the bytes sent."""
    machine, *pythons = (await ssh.check(host, _WHAT)).split()
    release = transfer.fitting(list(releases), machine, pythons)
    sent = await transfer.bring(ssh, host, release, tell)
    tell("installing")
    data = transfer.pack(files, {})
    options = " ".join(f"--{name} $own/{name}" for name in files)
    said = await ssh.check(host, f"robot={shlex.quote(host.robot)}; {_INSTALL}{options}", feed=[data])
    return said.strip().splitlines()[-1].removeprefix("install: "), sent + len(data)
