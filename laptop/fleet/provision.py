"""Provisioning of one robot: facts, judgement, changes, facts again; then the reboot, and the release.

What is decided is in `laptop.fleet.core.steps`; this asks, sends and reports.
"""

import asyncio
import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any

from laptop.fleet.core import packages, provision_checks, steps
from laptop.fleet.core.wish import (
    FIRMWARE_PACKAGE,
    KERNEL_PACKAGE,
    Change,
    DesiredRobot,
    Packages,
    ProvisioningStep,
    Verdict,
)
from laptop.fleet.release.bundle import Package, Repository
from laptop.fleet.release.install import pack
from laptop.fleet.ssh import remote
from laptop.fleet.ssh.everyone import ReportProgress
from laptop.fleet.ssh.ssh import Host, HostError, Ssh, last_words
from swarm.errors import LocalError
from swarm.frozen import frozen

BACK_S = 180.0
"""Seconds within which a robot must answer again after a reboot; a Zero 2 W takes about 40 s."""

ASK_S = 2.0
"""Seconds between two tries to reach a robot that reboots."""


@frozen
class Rig:
    """The place of a robot's files, for tests: another root than `/`, and other places of what the kernel tells."""

    root: str = "/"
    places: Mapping[str, str] = field(default_factory=dict)
    ask_s: float = ASK_S


class Provisioning:
    """The provisioning of one robot."""

    def __init__(
        self,
        ssh: Ssh,
        host: Host,
        wish: DesiredRobot,
        bundle: Mapping[tuple[str, str], Repository],
        tell: ReportProgress,
        rig: Rig,
    ) -> None:
        """`bundle`: the packages for each Debian and architecture."""
        self._ssh, self._host, self._wish, self._bundle = ssh, host, wish, bundle
        self._tell, self._rig = tell, rig
        self.changed = 0
        self._there: set[str] = set()

    async def look(self) -> dict[str, Any]:
        """Return the robot's facts, and note the time of this computer at that moment."""
        self._wish = replace(self._wish, now=time.time())
        request = {
            **steps.LOOK,
            "there": [*steps.LOOK["there"], *filter(None, [self._wish.key_file])],
            "packages": [*self._wish.packages, FIRMWARE_PACKAGE, KERNEL_PACKAGE],
            "root": self._rig.root,
            "places": dict(self._rig.places),
        }
        return dict(await remote.call(self._ssh, self._host, "facts", request))

    async def check(self) -> str:
        """Tell what would be changed, and change nothing. Raises `HostError` where something cannot be helped."""
        facts = await self.look()
        self._offer(facts)
        verdicts = {step.name: step.judge(facts, self._wish) for step in (*steps.FIRST, *steps.THEN)}
        for step, verdict in verdicts.items():
            self._tell(f"{step}: {'would change' if verdict.state == 'change' else verdict.state}: {verdict.text}")
        _refuse(verdicts)
        changes = [verdict for verdict in verdicts.values() if verdict.state == "change"]
        if reboot := _owes_reboot(facts) or any(verdict.reboot for verdict in changes):
            self._tell("reboot: would be needed: some of it is in force only then")
        return f"{len(changes)} of {len(verdicts)} would be changed{', and it would reboot' if reboot else ''}"

    async def carry_out(self, *, reboot: bool) -> bool:
        """Do all steps. Return whether all changes are in force, which some are only after a `reboot`. Raises
        `HostError` where a step fails."""
        facts = await self.look()
        facts, wait = await self._packages(facts)
        facts, wait_too = await self._stage(facts, steps.THEN)
        if wait or wait_too or _owes_reboot(facts):
            if not reboot:
                self._tell("reboot: needed: some of it is in force only then")
                return False
            await self._reboot(facts["boot_id"])
            facts, _ = await self._stage(await self.look(), [step for step in steps.FIRST if step.name == "clock"])
            late = {step.name: step.judge(facts, self._wish) for step in (*steps.FIRST, *steps.THEN)}
            if wrong := [f"{name}: {verdict.text}" for name, verdict in late.items() if verdict.state != "ok"]:
                raise HostError(f"wrong again after the reboot: {'; '.join(wrong)}")
        return True

    # -- packages --------------------------------------------------------------------------------------------------

    def _offer(self, facts: Mapping[str, Any]) -> Repository | None:
        """Return the packages that the bundle has for this robot, and wish for a robot with their names."""
        repository = self._bundle.get((facts["os"].get("VERSION_CODENAME", ""), self._wish.architecture))
        if repository is not None:
            self._wish = replace(self._wish, bundle=Packages(names=repository.names))
        return repository

    async def _packages(self, facts: dict[str, Any]) -> tuple[dict[str, Any], bool]:
        """Do the steps that come first, after asking which packages of the bundle apt would install."""
        repository = self._offer(facts)
        files: list[Package] = []
        if repository is not None:
            gates = [step.judge(facts, self._wish) for step in steps.FIRST if step.name != "packages"]
            missing = packages.wanted_packages(facts, self._wish)
            if missing and all(verdict.state != "failed" for verdict in gates):
                files, problem = await self._resolve(repository, missing)
                sizes = {package.file: package.size for package in files}
                self._wish = replace(self._wish, bundle=Packages(sizes, problem, repository.names))
        return await self._stage(facts, steps.FIRST, repository, files)

    async def _resolve(self, repository: Repository, names: Sequence[str]) -> tuple[list[Package], str]:
        """Return what apt on the robot would install for these names, and what prevents it."""
        apt = [word.replace(packages.CACHE, self._cache) for word in packages.apt_get()]
        request = {"folder": self._cache, "index": repository.index, "apt": apt, "packages": names}
        said = await remote.call(self._ssh, self._host, "repository", request)
        wanted = [repository.packages.get((name, version)) for name, version in said["install"]]
        if None in wanted:
            return [], "apt on the robot would take other packages than the bundle's"
        self._there = set(said["there"])
        return [package for package in wanted if package is not None], said["problem"]

    @property
    def _cache(self) -> str:
        return self._rig.root.rstrip("/") + packages.CACHE

    async def _send(self, repository: Repository, files: Sequence[Package]) -> None:
        """Bring those files that are not on the robot yet."""
        files = [package for package in files if package.sha256 not in self._there]
        if not files:
            return
        try:
            data = pack({package.file: repository.data(package) for package in files}, {})
        except LocalError as error:
            raise HostError(str(error)) from None
        self._tell(f"packages: sending {len(files)} files, {len(data) / 1e6:.1f} MB")
        sums = "".join(f"{package.sha256}  {package.file}\n" for package in files)
        unpack, check = "tar --extract --no-same-owner --file=-", "sha256sum --check --quiet"
        command = f"cd {self._cache}/debs && sudo -n {unpack} && sudo -n {check} <<'END'\n{sums}END"
        done = await self._ssh.run(self._host, command, feed=[data])
        if done.code != 0:
            raise HostError(f"packages: failed: not all arrived: is its disk full? ({last_words(done.err)})")

    # -- judging and changing --------------------------------------------------------------------------------------

    async def _stage(
        self,
        facts: dict[str, Any],
        stage: Sequence[ProvisioningStep],
        repository: Repository | None = None,
        files: Sequence[Package] = (),
    ) -> tuple[dict[str, Any], bool]:
        """Judge all steps, carry out the changes, and check that they hold. Return the facts afterwards, and whether to
        reboot."""
        verdicts = {step.name: step.judge(facts, self._wish) for step in stage}
        for name, verdict in verdicts.items():
            if verdict.state != "change":
                self._tell(f"{name}: {verdict.state}: {verdict.text}")
        _refuse(verdicts)
        wanted = {name: verdict for name, verdict in verdicts.items() if verdict.state == "change"}
        if not wanted:
            return facts, False
        if "packages" in wanted and repository is not None:
            await self._send(repository, files)
        if "clock" in wanted:  # to resolve and send packages may have taken minutes
            passed = time.time() - self._wish.now
            self._wish = replace(self._wish, now=self._wish.now + passed)
            wanted["clock"] = provision_checks.clock({**facts, "time": facts["time"] + passed}, self._wish)
        await self._change(wanted, facts["boot_id"])
        facts = await self.look()
        for step in stage:
            if step.name in wanted:
                self._verify(step, wanted[step.name], step.judge(facts, self._wish))
        return facts, any(verdict.reboot for verdict in wanted.values())

    async def _change(self, wanted: Mapping[str, Verdict], boot_id: str) -> None:
        """Carry out all changes, until one fails."""

        def here(change: Change) -> Change:
            if change["do"] != "run":
                return change
            return {**change, "words": [word.replace(packages.CACHE, self._cache) for word in change["words"]]}

        pairs = [(name, [here(change) for change in verdict.changes]) for name, verdict in wanted.items()]
        if any(
            verdict.reboot for verdict in wanted.values()
        ):  # the mark comes first, so that it stays whatever ends this run
            pairs.insert(0, ("reboot", [{"do": "write", "path": steps.REBOOT, "text": boot_id, "mode": "0644"}]))
        said = await remote.call(self._ssh, self._host, "changes", {"root": self._rig.root, "steps": pairs})
        if said["problem"]:
            self._tell(f"{said['step']}: failed: {said['problem']}")
            raise HostError(f"{said['step']}: {said['problem']}")

    def _verify(self, step: ProvisioningStep, wanted: Verdict, found: Verdict) -> None:
        """Check a change: its step must find nothing more to do, except for a reboot."""
        if found.state == "ok" or (found.state == "change" and found.reboot and wanted.reboot and not found.changes):
            self.changed += 1
            self._tell(f"{step.name}: changed: {wanted.text}")
            return
        self._tell(f"{step.name}: failed: changed, and still: {found.text}")
        raise HostError(f"{step.name}: the change did not hold: {found.text}")

    # -- reboot ----------------------------------------------------------------------------------------------------

    async def _reboot(self, before: str) -> None:
        self._tell("reboot: waiting until it is back")
        with contextlib.suppress(HostError):  # the connection may break before the command has ended
            await self._ssh.run(self._host, "sudo -n systemctl reboot")
        try:
            async with asyncio.timeout(BACK_S):
                while not await self._is_back(before):
                    await asyncio.sleep(self._rig.ask_s)
        except TimeoutError:
            raise HostError(f"it did not come back within {BACK_S:g} s after the reboot: look at its display") from None
        self._tell("reboot: changed: it is back")

    async def _is_back(self, before: str) -> bool:
        request = {"root": self._rig.root, "places": dict(self._rig.places)}
        try:
            facts = await remote.call(self._ssh, self._host, "facts", request)
        except HostError:
            return False
        return bool(facts["boot_id"] != before)


def _refuse(verdicts: Mapping[str, Verdict]) -> None:
    """Raise `HostError` that names what cannot be helped; nothing of these steps is changed then."""
    wrong = [f"{name}: {verdict.text}" for name, verdict in verdicts.items() if verdict.state == "failed"]
    if wrong:
        raise HostError("; ".join(wrong))


def _owes_reboot(facts: Mapping[str, Any]) -> bool:
    """Return whether the robot waits for a reboot, as an earlier run leaves it that was broken off before."""
    return bool((facts["files"].get(steps.REBOOT) or "").strip() == facts["boot_id"].strip())
