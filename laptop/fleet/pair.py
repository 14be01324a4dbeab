"""Pairing of many robots: one program at each end of a link, both watched from here."""

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

from laptop.fleet.core.pairing import Bond, PairingSchedule, ordered, plan
from laptop.fleet.ssh import remote
from laptop.fleet.ssh.everyone import FAILURES, ReportProgress, failure
from laptop.fleet.ssh.ssh import Host, HostError, Ssh
from swarm.core.graph import Edge

INQUIRY_S = 25.0
"""Seconds of inquiry: one of 10.24 s finds most devices, a second one finds those that were missed."""

LISTENS_S = 20.0
"""Seconds within which the called robot must have its agent and be found."""


async def look(ssh: Ssh, host: Host) -> dict[str, Any]:
    """Return a robot's adapter (`address`, `powered`) and the devices it knows. Raises `HostError`."""
    return await ask(ssh, host, {"do": "look"})


async def ask(ssh: Ssh, host: Host, request: Mapping[str, Any]) -> dict[str, Any]:
    """Run the pairing program on a robot; raises `HostError` with what it says is wrong."""
    answer = dict(await remote.call(ssh, host, "pairing", request))
    if answer["problem"]:
        raise HostError(answer["problem"])
    return answer


class Pairing:
    """The pairing of all links of a swarm."""

    def __init__(
        self,
        ssh: Ssh,
        hosts: Mapping[str, Host],
        looks: Mapping[str, Mapping[str, Any]],
        timeout_s: float,
        tell: ReportProgress,
    ) -> None:
        """`looks`: the answer of each robot that has been asked with `look`. `timeout_s`: the time that each link may
        take."""
        self._ssh, self._hosts, self._looks, self._timeout_s, self._tell = ssh, hosts, looks, timeout_s, tell

    async def carry_out(self, edges: Sequence[Edge], *, check: bool, again: bool) -> dict[Edge, str]:
        """Bring all links to be paired and trusted, or `check` only. Return by link what is wrong, empty where nothing
        is."""
        addresses = {name: str(answer["address"]) for name, answer in self._looks.items()}
        problems = {}
        reachable = []
        for edge in edges:
            if absent := [name for name in edge if name not in self._looks]:
                problems[edge] = f"{' and '.join(absent)} did not take part"
            else:
                reachable.append(edge)
        schedule = PairingSchedule(ordered(reachable, addresses))
        running: dict[asyncio.Task[str], Edge] = {}
        while schedule.waiting or running:
            for edge in schedule.start():
                running[asyncio.create_task(self._link(edge, check=check, again=again))] = edge
            done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                edge = running.pop(task)
                problems[edge] = task.result()
                schedule.done(edge)
                self._tell(f"{edge[0]} {edge[1]}: {problems[edge] or 'paired'}")
        return {edge: problems.get(edge, problems.get(edge[::-1], "")) for edge in edges}

    async def _link(self, edge: Edge, *, check: bool, again: bool) -> str:
        try:
            async with asyncio.timeout(self._timeout_s):
                await self._bring(edge, check=check, again=again)
        except FAILURES as error:
            return failure(error, self._timeout_s)
        return ""

    async def _bring(self, edge: Edge, *, check: bool, again: bool) -> None:
        a, b = edge
        first, second = self._bonds(edge, self._looks[a], self._looks[b])
        todo = plan(first, second)
        if again:
            todo = [*(f"forget-{end}" for end, bond in (("a", first), ("b", second)) if bond is not None), "pair"]
        if check:
            if todo:
                raise HostError(_state(a, b, first, second))
            return
        for step in todo:
            if step == "pair":
                await self._pair(a, b)
            else:
                do, _, end = step.partition("-")
                me, peer = (a, b) if end == "a" else (b, a)
                await self._ask(me, do, peer)
        if todo:
            # The check goes by what both robots say, not by what they were told.
            looks = await asyncio.gather(look(self._ssh, self._hosts[a]), look(self._ssh, self._hosts[b]))
            first, second = self._bonds(edge, *looks)
            if plan(first, second):
                raise HostError(f"done, and still {_state(a, b, first, second)}")

    def _bonds(self, edge: Edge, a: Mapping[str, Any], b: Mapping[str, Any]) -> tuple[Bond | None, Bond | None]:
        """Return what each end knows of the other."""
        found = [answer["devices"].get(other["address"]) for answer, other in ((a, b), (b, a))]
        first, second = (None if device is None else Bond(device["paired"], device["trusted"]) for device in found)
        return first, second

    async def _ask(self, me: str, do: str, peer: str) -> None:
        request = {"do": do, "peer": self._looks[peer]["address"], "inquiry": INQUIRY_S}
        try:
            await ask(self._ssh, self._hosts[me], request)
        except HostError as error:
            raise HostError(f"{me}: {error}") from None

    async def _pair(self, a: str, b: str) -> None:
        """Let `b` wait to be found, and `a` find it and pair. If `a` fails, the end of its input tells `b` to stop."""
        listening, end = asyncio.Event(), asyncio.Event()
        request = {"do": "listen", "peer": self._looks[a]["address"], "inquiry": INQUIRY_S}
        called = asyncio.create_task(
            remote.call(self._ssh, self._hosts[b], "pairing", request, told=lambda _: listening.set(), until=end)
        )
        waiting = asyncio.create_task(listening.wait())
        try:
            await asyncio.wait({called, waiting}, timeout=LISTENS_S, return_when=asyncio.FIRST_COMPLETED)
            if not listening.is_set():
                answer = await called if called.done() else {"problem": f"not ready within {LISTENS_S:g} s"}
                raise HostError(f"{b}: {answer['problem']}")
            await self._ask(a, "call", b)
            answer = await called
            if answer["problem"]:
                raise HostError(f"{b}: {answer['problem']}")
        finally:
            waiting.cancel()
            end.set()
            await asyncio.gather(called, return_exceptions=True)


def _state(a: str, b: str, first: Bond | None, second: Bond | None) -> str:
    """Describe the state of a pairing in words."""

    def word(bond: Bond | None) -> str:
        if bond is None or not bond.paired:
            return "not paired"
        return "paired and trusted" if bond.trusted else "paired, not trusted"

    return f"{word(first)} at {a}, {word(second)} at {b}"
