"""Apps on robots: what they have to be the same in, how one is started anew, goes on and ends.

A start has one number for all robots; a file of the user's lies in a folder that is named by its content. The settings
of an app, `SETTINGS/NAME.env`, say how its newest run was started: whoever starts the unit goes on with that run.
"""

import hashlib
import re
import secrets
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple
from urllib.parse import quote

from laptop.fleet.release import versions
from laptop.fleet.release.install import pack
from laptop.fleet.ssh.ssh import Host, HostError, Ssh
from laptop.fleet.units import SERVICES, is_app, unit
from services.apps import sources
from swarm.app.settings import on_top, parse
from swarm.config import Config
from swarm.errors import AppError, LocalError, RemoteError
from swarm.messages.keys import is_name
from swarm.process.text import printable

APPS = "/var/lib/swarm/apps"
SETTINGS = "/etc/swarm/apps"

_PLAIN = re.compile(r"[A-Za-z0-9_.,:+=\[\]/-]+")
"""Characters that a setting may contain: systemd splits arguments at spaces and interprets quotes."""

_START = """set -e; umask 022
systemctl show --property=InvocationID --value {unit}
if [ -n "{folder}" ]; then
    rm -rf {apps}/{name}-????????????.new; mkdir -p {folder}.new
    head -c {size} >{folder}.new/tar; [ "$(wc -c <{folder}.new/tar)" -eq {size} ]
    tar -x --no-same-owner -f {folder}.new/tar -C {folder}.new; rm {folder}.new/tar
    find {folder}.new -exec sync {{}} +
    [ -d {folder} ] || mv -T {folder}.new {folder}; rm -rf {folder}.new; sync {apps}
fi
head -c {settings_size} >{settings}.new
[ "$(wc -c <{settings}.new)" -eq {settings_size} ]
sync {settings}.new; mv {settings}.new {settings}; sync {directory}
systemctl restart --no-block {unit}
find {apps} -mindepth 1 -maxdepth 1 -name "{name}-????????????" ! -path "{folder}" -exec rm -rf {{}} +"""
"""For the robot's shell, in single quotes: the app lies in a folder that is named by its content and comes whole, and
one renamed file says both where it is and how it is run. Whatever breaks before that has changed nothing, and a robot
that loses its power after it still has both when it comes back: it could not join this run again with the settings of
another."""

_AGAIN = """before=$(systemctl show --property=InvocationID --value {unit})
case {action}-$(systemctl show --property=ActiveState --value {unit}) in
    start-active | start-activating) ;;
    *) echo "$before" ;;
esac
sudo -n systemctl {action} --no-block {unit}"""
"""For the robot's shell: starts a unit; prints the invocation before, where there will be another one."""

_STRANGE = f"""for each in {{units}}; do
    name=${{{{each#swarm-app@}}}}; name=${{{{name%.service}}}}
    [ "$(systemctl show --property=ActiveState --value $each)" != inactive ] ||
        sudo -n test -e {SETTINGS}/$name.env || echo $each
done"""
"""For the robot's shell: prints those units of apps that do not run and were never started there. systemd stops them
without a word, whatever their names."""

_FIRST = """i=0; state=; status=; while [ $i -lt {tries} ]; do
    state=$(systemctl show --property=ActiveState --value {unit})
    if [ "$(systemctl show --property=InvocationID --value {unit})" != "{before}" ]; then
        status=$(systemctl show --property=StatusText --value {unit})
        case $state-$status in active-* | failed-* | {enough}) break ;; esac
    fi
    i=$((i + 1)); sleep 0.5
done
echo "$state"; echo "$status"
[ "$state" = active ] || sudo -n journalctl --unit={unit} --no-pager --lines=5 --output=cat"""
"""For the robot's shell: waits until another invocation than `before` is ready or has failed, or `enough` matches;
prints the unit's state and what it says of itself, and where it is not ready its last words."""

_WAITING = "starting "
"""The beginning of what an app says of itself while it waits before its first state (`Service.waits`)."""

WAIT_S = 20.0
"""Seconds that an app has for its first state: imports, and a measurement where it needs one."""

_KNOWN = f"""cd {SETTINGS} 2>/dev/null || exit 0
for each in *.env; do [ ! -e $each ] || echo $(sha256sum <$each) $each $(sed -n s/^APP=//p $each); done"""
_LINE = re.compile(r"([0-9a-f]{64}) - ([a-z][a-z0-9_-]*)\.env (\S+)")


class StartedApp(NamedTuple):
    """The way an app was started on a robot."""

    digest: str
    """SHA-256 of the app's settings. It is equal for the same run, started in the same way."""
    built_in: bool
    """Whether the app is part of the release; otherwise its file was copied to the robot."""


class AppStart:
    """A new run of an app."""

    def __init__(
        self,
        name: str,
        files: Mapping[str, bytes] | None,
        *,
        arguments: Sequence[str] = (),
        settings: Sequence[str] = (),
    ) -> None:
        """`files`: the files of the user's app, `NAME.py` among them; None for a built-in app. `settings`: checked
        ones, `[ROBOT.]NAME=VALUE`."""
        self.unit = unit(name)
        folder = f"{APPS}/{name}-{sources.digest(files).hex()[:12]}" if files is not None else ""
        data = b"" if files is None else pack(files, dict.fromkeys(files, 0o644))
        # One number for this run on every robot: what an earlier run left behind has another.
        number = secrets.token_hex(8)
        self.run = f"{name}-{number}"
        """The name of the folder of its recordings, on robots and for `swarm fetch`."""
        words = ["--run", number, *arguments]
        for setting in settings:
            # systemd splits at spaces and knows quotes: what has any of them is written with % and two hex digits.
            plain = _PLAIN.fullmatch(setting) is not None
            words += ["--set", setting] if plain else ["--escaped", quote(setting, safe=",:+=[]/")]
        place = name if files is None else f"{folder}/{name}.py"
        environment = f"APP={place}\nARGUMENTS={' '.join(words)}\n".encode()
        self._feed = [data, environment]
        self._script = _START.format(
            folder=folder,
            size=len(data),
            name=name,
            directory=SETTINGS,
            settings=f"{SETTINGS}/{name}.env",
            settings_size=len(environment),
            unit=self.unit,
            apps=APPS,
        )

    async def on(self, ssh: Ssh, host: Host) -> str:
        """Begin on a robot without waiting until the app is ready, which needs its first measurement. Raises
        `HostError`."""
        await self._begin(ssh, host)
        return f"started {self.unit}"

    async def until_first_state(self, ssh: Ssh, host: Host) -> str:
        """Begin on a robot, and wait until its app has a first state. Raises `HostError` with its last words."""
        await _first(ssh, host, self.unit, await self._begin(ssh, host))
        return f"{self.unit} runs: {self.run}"

    async def _begin(self, ssh: Ssh, host: Host) -> str:
        """Start the app, and return which invocation of the unit there was before."""
        said = await ssh.check(host, f"sudo -n sh -c '{self._script}'", feed=self._feed)
        return said.split()[0] if said.split() else ""


async def systemctl(ssh: Ssh, host: Host, action: str, names: Iterable[str]) -> str:
    """Have units started, stopped or restarted. Raises `HostError` where that fails.

    An app that is started or restarted is waited for until it is ready, or says what it waits for: for the first
    measurement or the links of the others, which may take minutes.
    """
    units = list(names)
    apps = [each for each in units if is_app(each)]
    waited = apps if action in ("start", "restart") else []
    said = []
    if others := " ".join(each for each in units if each not in waited):
        look = _STRANGE.format(units=" ".join(apps)) + "; " if action == "stop" and apps else ""
        strange = (await ssh.check(host, f"{look}sudo -n systemctl {action} {others}")).split()
        if strange:
            raise HostError(f"{' '.join(strange)} does not run, and was never started on it")
        said.append(f"{action} {others}")
    for each in waited:
        before = await ssh.check(host, _AGAIN.format(unit=each, action=action))
        waits = await _first(ssh, host, each, before.strip(), may_wait=True)
        said.append(f"{action} {each}" + (f", which runs and waits: {waits}" if waits else ""))
    return ", ".join(said)


async def _first(ssh: Ssh, host: Host, name: str, before: str, *, may_wait: bool = False) -> str:
    """Wait until another invocation of the unit `name` than `before` is ready. With `may_wait`, end also when the unit
    says what it waits for, and return that. Raises `HostError` with the unit's last words."""
    enough = f'"activating-{_WAITING}"*' if may_wait else "-"
    script = _FIRST.format(unit=name, before=before, tries=round(WAIT_S / 0.5), enough=enough)
    state, status, *said = [*(await ssh.check(host, script)).splitlines(), "", ""]
    if state == "active":
        return ""
    waits = printable(status.removeprefix(_WAITING)) if status.startswith(_WAITING) else ""
    if waits and may_wait and state == "activating":
        return waits
    words = " | ".join(printable(line) for line in said if line.strip()) or "it has said nothing"
    why = waits or state or "unknown"
    how = "has failed" if state == "failed" else f"has no first state after {WAIT_S:g} s ({why})"
    raise HostError(f"{name} {how}: {words}")


def check_name(name: str, told: str) -> None:
    """Raise `LocalError` where no app can have this name. `told` is what the user has called the app."""
    if not is_name(name) or name in SERVICES:
        raise LocalError(f"{told}: expected the name of an app, or a file with such a name: a-z, 0-9, _ and -")


def check_settings(settings: Sequence[str], config: Config, name: str) -> None:
    """Check the settings before the start. The robots' own check would come when the app has not started."""
    try:
        on_top(config.app(name), map(parse, settings), config.names)
    except AppError as error:
        raise LocalError(f"--set: {error}") from None


async def ask_versions(ssh: Ssh, host: Host) -> versions.Versions:
    """Return the versions on a robot. Raises `HostError`, also where it has no release."""
    try:
        return versions.parse(await ssh.check(host, versions.question(host.robot)))
    except RemoteError as error:
        raise HostError(str(error)) from None


def differences(found: Mapping[str, versions.Versions], config: Config) -> str:
    """Explain in words which versions differ between robots and this computer; empty where none does."""
    here = hashlib.sha256(config.path.read_bytes()).hexdigest()
    wrong = versions.differences(found, here) if found else []
    return f"the robots have {'; '.join(wrong)}" if wrong else ""


async def ask_known(ssh: Ssh, host: Host) -> dict[str, StartedApp]:
    """Return the apps that were started on a robot, by name. Raises `HostError`."""
    known: dict[str, StartedApp] = {}
    for line in (await ssh.check(host, f"sudo -n sh -c '{_KNOWN}'")).splitlines():
        if found := _LINE.fullmatch(line):
            known[found[2]] = StartedApp(found[1], found[3] == found[2])
    return known
