"""The actions of a page on real robots, over ssh, as `swarm run`, `swarm services start` and `swarm services stop` do
them.

A robot far away takes its time: an act begins at once and returns, and what came of it on each robot is told among the
page's events. None waits for another. Of two orders about one app the newer one holds.
"""

import asyncio
import contextlib
import itertools
import logging
import shlex
import threading
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from typing import Any

import msgpack

from laptop.cli import param
from laptop.fleet import apps
from laptop.fleet.core.answers import MISUNDERSTOOD, misunderstood
from laptop.fleet.ssh.ssh import Host, HostError, Ssh, hosts
from laptop.fleet.units import SERVICES, kill_command, unit
from laptop.view.actions.plan import Plan
from laptop.view.actions.robot_actions import PageAction, cut, named, settings_of
from laptop.view.feeds.news import REACH
from laptop.view.feeds.robots import Robots
from laptop.view.feeds.tunnel import PROGRAM
from swarm import clock
from swarm.errors import LocalError, SwarmError
from swarm.messages import HoldLink
from swarm.messages.codec import Value, encode
from swarm.messages.keys import key

TIMEOUT_S = 60.0
"""Seconds to wait for each robot, as in the commands of the command line."""

COMPARE_S = 15.0
"""Seconds to wait for visible robots before a start, so that their versions can be compared."""

SEEN_S = 20.0
"""Seconds after its start within which an app appears on the robot's bus; a Zero 2 W takes 4 s."""

CUT_S, MEND_S = 8.0, 15.0
"""Seconds after which a link is reported that is not cut or not up as requested. A robot calls another one every 6 s at
the latest."""

AGAIN_S = 3.0
"""Seconds after which robots are told again to cut or mend a link that is not so yet: a bus may lose what is said."""

APPS = "view/apps"
"""Topic of the apps that were started on a real robot, running or not. The laptop adds it."""

_LOOK_EVERY_S = 0.25

_log = logging.getLogger("view")

Job = Callable[[Host], Awaitable[str]]
"""Does the work on one robot and says what was done; raises `HostError`."""


class RemoteActions:
    """Carries out orders in a thread of its own until closed."""

    def __init__(self, view: Robots, ssh: Ssh) -> None:
        self._view = view
        self._ssh = ssh
        self._hosts = {host.robot: host for host in hosts(view.config)}
        self._order = itertools.count()
        self._newest: dict[tuple[str, str], int] = {}
        """The number of the newest order about an app or a link of a robot."""
        self._known: dict[str, set[str]] = {}
        """The apps of each robot."""
        self._turns: dict[tuple[str, str], asyncio.Lock] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="remote actions", daemon=True)
        self._thread.start()
        self.acts: Mapping[str, PageAction] = {
            "start": self._start,
            "end": self._end,
            "kill": self._kill,
            "cut": self._cut,
        }
        self._begin(self._look_for_apps())

    def close(self) -> None:
        """Give up what is under way. On robots, work that has begun goes on."""
        asyncio.run_coroutine_threadsafe(self._cancel(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def give(self, robots: Sequence[str], app: str, values: Mapping[str, Value]) -> list[str]:
        """Set parameters by `swarm app param` on each robot, which reports the outcome."""
        words = [f"{name}={str(value).lower() if isinstance(value, bool) else value}" for name, value in values.items()]
        told = f"app/{app}: {' '.join(words)}"

        async def job(host: Host) -> str:
            await self._ssh.check(host, f"{param.COMMAND} {shlex.join([app, *words])}")
            return told

        self._begin(self._on([self._hosts[robot] for robot in robots], job, f"{told} was not set"))
        return []

    # -- acts, in the server's threads ----------------------------------------------------------------------------

    def _start(self, asked: Mapping[str, Any]) -> str:
        app, robots, settings = self._app(asked), self._robots(asked), [each.text for each in settings_of(asked)]
        apps.check_settings(settings, self._view.config, app)
        self._begin(self._run_app(app, robots, self._number(app, robots), settings, alone=bool(asked.get("robot"))))
        return f"{app}: to be started on {_names(robots)}; what comes of it is told among the events"

    def _end(self, asked: Mapping[str, Any]) -> str:
        app, robots = self._app(asked), self._robots(asked)
        number = self._number(app, robots)

        async def job(host: Host) -> str:
            async with self._turn(app, host):
                self._check_newest(app, host, number)
                await apps.systemctl(self._ssh, host, "stop", [unit(app)])
            return f"app/{app} was stopped"

        self._begin(self._on(robots, job, f"app/{app} was not stopped"))
        return f"{app}: to be stopped on {_names(robots)}; what comes of it is told among the events"

    def _kill(self, asked: Mapping[str, Any]) -> str:
        robot, service = named(asked["robot"], self._hosts), str(asked["service"])
        name = service.removeprefix("app/")
        if (service == name) != (name in SERVICES):
            raise LocalError(f"no service {service[:30]!r}; there are {', '.join(SERVICES)} and app/NAME")
        command = kill_command(name)

        async def job(host: Host) -> str:
            await self._ssh.check(host, command)
            return f"{service} was killed"

        self._begin(self._on([self._hosts[robot]], job, f"{service} was not killed"))
        return f"{robot}: {service} is to be killed"

    def _cut(self, asked: Mapping[str, Any]) -> str:
        ends, seconds = cut(asked, self._hosts)
        number = next(self._order)
        self._newest |= {(robot, _link(peer)): number for robot, peer in (ends, ends[::-1])}
        self._begin(self._hold(ends, seconds, number))
        return f"{' - '.join(ends)}: to be " + (f"cut for {seconds:g} s" if seconds else "mended")

    def _app(self, asked: Mapping[str, Any]) -> str:
        app = str(asked["app"])
        apps.check_name(app, app[:20])
        return app

    def _robots(self, asked: Mapping[str, Any]) -> list[Host]:
        """Return the robot that is named, else all."""
        if asked.get("robot"):
            return [self._hosts[named(asked["robot"], self._hosts)]]
        return list(self._hosts.values())

    def _number(self, app: str, robots: Sequence[Host]) -> int:
        number = next(self._order)
        self._newest |= {(host.robot, app): number for host in robots}
        return number

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        self._loop.call_soon_threadsafe(self._launch, work)

    # -- what is under way, in our own thread ---------------------------------------------------------------------

    def _launch(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if (
            not task.cancelled() and (error := task.exception()) is not None
        ):  # other errors than defects are told before
            _log.error("what was to be done has failed", exc_info=error)

    async def _cancel(self) -> None:
        for task in (tasks := list(self._tasks)):
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _on(self, robots: Sequence[Host], job: Job, failed: str) -> None:
        """Do the job on all robots at once, and tell the outcome of each as it comes."""

        async def one(host: Host) -> None:
            if (text := await self._try(host, job(host), failed)) is not None:
                self._note(host.robot, "info", text)

        await _all(map(one, robots))

    async def _try(self, host: Host, work: Awaitable[str], failed: str) -> str | None:
        """Return what the work on a robot says at its end. Return None where the work fails, and tell the reason among
        the events."""
        try:
            async with asyncio.timeout(TIMEOUT_S):
                return await work
        except TimeoutError:
            self._note(host.robot, "warning", f"{failed} within {TIMEOUT_S:g} s")
        except (SwarmError, *MISUNDERSTOOD) as error:
            why = str(error) if isinstance(error, SwarmError) else misunderstood(error)
            self._note(host.robot, "warning", f"{failed}: {why}")
        return None

    async def _run_app(
        self, app: str, robots: Sequence[Host], number: int, settings: Sequence[str], *, alone: bool
    ) -> None:
        """Have an app go on where it was, or begin anew where the robots have no run of it in common."""
        start = apps.AppStart(app, None, arguments=["--record"], settings=settings)
        plan = Plan(app, self._view.config, alone=alone)
        everybody = {host.robot for host in robots}
        waited = {robot for robot in everybody if self._is_seen(robot)} or everybody
        compared = asyncio.Event()

        async def job(host: Host) -> str:
            try:
                versions = await apps.ask_versions(self._ssh, host)
                known = await apps.ask_known(self._ssh, host)
                plan.found(host.robot, versions, known.get(app))
                self._tell_apps(host.robot, {*known, app})
            finally:
                waited.discard(host.robot)
                if not waited:
                    compared.set()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(compared.wait(), COMPARE_S)
            anew = plan.is_new(host.robot)
            async with self._turn(app, host):
                self._check_newest(app, host, number)
                if anew:
                    await start.on(self._ssh, host)
                else:  # without waiting: an app is ready when it has its first measurement
                    await apps.systemctl(self._ssh, host, "start --no-block", [start.unit])
            self._launch(self._expect(app, host, number))
            return f"app/{app} was started" + ("" if anew else ": it goes on where it was")

        await self._on(robots, job, f"app/{app} was not started")

    async def _expect(self, app: str, host: Host, number: int) -> None:
        """Tell where an app that was started does not come: it may have ended as soon as systemd had started it."""
        await asyncio.sleep(SEEN_S)
        with self._view.lock:
            there = self._view.picture.services().get(host.robot, {}).get(f"app/{app}")
        if not there and self._newest[host.robot, app] == number:
            told = f"app/{app} is not seen {SEEN_S:g} s after its start: swarm logs {app} --robots {host.robot}"
            self._note(host.robot, "warning", told)

    async def _look_for_apps(self) -> None:
        """Tell which apps were started on the robots before."""

        async def one(host: Host) -> None:
            try:
                async with asyncio.timeout(TIMEOUT_S):
                    self._tell_apps(host.robot, await apps.ask_known(self._ssh, host))
            except (SwarmError, TimeoutError, *MISUNDERSTOOD):
                return  # the feed tells which robots are not there

        await _all(map(one, self._hosts.values()))

    async def _hold(self, ends: tuple[str, str], seconds: float, number: int) -> None:
        """Have a link held down, or let up. One near end suffices to cut the link. To mend it both ends are told, since
        either may hold it."""
        failed = f"it cannot be told to {'cut' if seconds else 'mend'} the link {' - '.join(ends)}"
        sides = [(self._hosts[robot], peer) for robot, peer in (ends, ends[::-1])]
        near = [side for side in sides if self._is_near(side[0])]
        told: set[tuple[Host, str]] = set()

        async def tell(host: Host, peer: str) -> str:
            async with self._turn(_link(peer), host):
                if self._newest[host.robot, _link(peer)] == number:
                    await self._say(host, key(host.robot, "mesh", "set", "hold"), HoldLink(peer, seconds))
            return ""

        async def one(host: Host, peer: str) -> None:
            if await self._try(host, tell(host, peer), failed) is not None:
                told.add((host, peer))

        await _all(one(*side) for side in (near if near and seconds else sides))
        end = clock.now() + (CUT_S if seconds else MEND_S)
        again = clock.now() + AGAIN_S
        while told and self._is_up(*ends) == bool(seconds) and self._newest[ends[0], _link(ends[1])] == number:
            if clock.now() > again:
                await _all(one(*side) for side in tuple(told))
                again = clock.now() + AGAIN_S
            if clock.now() > end:
                wrong = "still up: is the release of its mesh older than this program?" if seconds else "still down"
                self._note(ends[0], "warning", f"the link to {ends[1]} is {wrong}")
                return
            await asyncio.sleep(_LOOK_EVERY_S)

    async def _say(self, host: Host, name: str, message: object) -> None:
        """Publish a message on a robot's bus, by the connection that there is, else by one of its own."""
        if self._is_near(host):
            self._view.buses[host.robot].publish(name, message, urgent=True)
            return
        command: bytes = msgpack.packb([name, encode(message)])
        await self._ssh.check(host, f"{PROGRAM} {host.robot}", feed=[command])

    # -- the picture ----------------------------------------------------------------------------------------------

    def _note(self, robot: str, level: str, text: str) -> None:
        with self._view.lock:
            self._view.picture.note(self._view.now(), robot, level, text)

    def _tell_apps(self, robot: str, names: Iterable[str]) -> None:
        known = self._known.setdefault(robot, set())
        known |= set(names)
        with self._view.lock:
            self._view.picture.put(robot, APPS, {"apps": sorted(known)}, self._view.now())

    def _is_near(self, host: Host) -> bool:
        """Return whether there is a connection with its bus."""
        tunnel = self._view.buses.get(host.robot)
        return tunnel is not None and tunnel.connected

    def _is_seen(self, robot: str) -> bool:
        with self._view.lock:
            reach = self._view.picture.newest(robot, REACH)
        return isinstance(reach, dict) and reach.get("by") is not None

    def _is_up(self, robot: str, peer: str) -> bool:
        """Return whether both ends of a link, as far as they have told, say that it is up."""
        with self._view.lock:
            told = [(self._view.picture.newest(a, "mesh/links"), b) for a, b in ((robot, peer), (peer, robot))]
        states = [
            link.get("state")
            for value, other in told
            for link in (value.get("links") if isinstance(value, dict) else None) or ()
            if isinstance(link, dict) and link.get("peer") == other
        ]
        return all(state in ("up", "suspect") for state in states)

    def _turn(self, what: str, host: Host) -> asyncio.Lock:
        """Return the lock that is held while an order about an app or a link of a robot is carried out."""
        return self._turns.setdefault((host.robot, what), asyncio.Lock())

    def _check_newest(self, app: str, host: Host, number: int) -> None:
        if self._newest[host.robot, app] != number:
            raise HostError("another order has come after this one")


async def _all(works: Iterable[Coroutine[Any, Any, None]]) -> None:
    """Run all at once. When cancelled, wait for the end of each, which `asyncio.gather` does not."""
    async with asyncio.TaskGroup() as group:
        for work in works:
            group.create_task(work)


def _link(peer: str) -> str:
    """Return a key for a link that is no app's name."""
    return f"link {peer}"


def _names(robots: Sequence[Host]) -> str:
    return " ".join(host.robot for host in robots)
