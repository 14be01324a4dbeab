"""`swarm estop` and `swarm arm` on a laptop: each robot is told on its own bus by ssh, too, at the same time.

So it is told whatever became of the mesh and of the laptop's bus, and it is confirmed by any of these. A robot whose
own bus or balancer does not confirm a stop has its balancer stopped by systemd: motors off is its last act, and the
ATmega switches them off 0.2 s later in any case.
"""

import argparse
import asyncio
import os
import re
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from laptop.fleet.ssh import everyone, robot_command
from laptop.fleet.ssh.ssh import OWN_NAME, Host, HostError, Ssh, hosts, last_words
from swarm import clock
from swarm.clock import elapsed
from swarm.config import find, load
from swarm.config.load import HOST
from swarm.errors import LocalError, PayloadError
from swarm.messages.json_input import read_json
from swarm.messages.keys import is_name
from swarm.onboard import halt
from swarm.onboard.command_line import complain
from swarm.process.arguments import show
from swarm.process.paths import DEFAULT_RUNTIME
from swarm.process.simulations import default_run_dir, is_live, robots
from swarm.process.terminal import columns
from swarm.process.text import printable

THERE_S = 3.0
"""Seconds for which the command on the robot waits for the robot's own balancer and mesh."""
_SLACK_S = 15.0
"""Further seconds for `swarm arm`: for the connection, and for a robot that is slow to start Python."""
_HANGS_S = 12.0
"""Seconds after which a robot's own command counts as hanging, and its balancer is stopped by systemd."""
_SYSTEMD_S = 15.0
"""Seconds that systemd has to stop a balancer."""
_USAGE = 2
"""Exit code of a command line that is not understood."""
_BREAKS_S = 8.0
"""Seconds within which a connection that breaks, or is refused, is made once more for a stop."""

_NOTE_S = 4.0
"""Seconds after which the robots that have confirmed are named, while others have not answered yet."""

_TABLE = re.compile(r"^[ \t]*\[", re.MULTILINE)
"""The beginning of a table in swarm.toml."""
_ROBOTS = re.compile(r"\[?[ \t]*robots\b")
"""The rest of the name of a robot's table."""
_ENTRY = re.compile(r"""^[ \t]*(name|host)[ \t]*=[ \t]*["']([^"'\n]*)["']""", re.MULTILINE)


@dataclass
class _Answers:
    """The answers of ssh, bus and mesh."""

    outcomes: dict[str, everyone.RobotOutcome] = field(default_factory=dict)
    """The outcome of ssh by robot: whether it was reached and has confirmed, and how."""
    seen: dict[str, str] = field(default_factory=dict)
    """Robots whose confirmation another robot has seen over the mesh, with that robot's name."""

    def said(self, robot: str) -> str:
        """Return the answer of ssh in words."""
        return self.outcomes[robot].text if robot in self.outcomes else "ssh gave no answer"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and the way by ssh."""
    for each in halt.add_arguments(parser):
        each.add_argument("--no-ssh", action="store_true", help="use only bus and mesh, not ssh")
        everyone.add_config(each, "swarm.toml with the robots to reach by ssh")


def run(args: argparse.Namespace) -> int:
    """Stop or arm over every path there is. Raises `LocalError` where there is none.

    Returns 1 where a robot that can be reached has not confirmed in time.
    """
    alone = args.run_dir and not (args.config or args.ssh_config)  # otherwise real robots are meant as well
    if args.no_ssh or alone or os.environ.get("SWARM_RUNTIME") or DEFAULT_RUNTIME.is_dir():
        return halt.run(args)
    found = _simulated(args.run_dir)
    stop: bool = args.act == "stop"
    problem = ""
    try:
        real = {host.robot: host for host in hosts(load(args.config, addressed=False))}
    except LocalError as error:
        problem = str(error)
        if not (real := legible(args.config or find.find()) if stop else {}):
            return _without_config(args, error)
    try:
        unknown = halt.take_unknown(args, {**dict.fromkeys(real), **found})
    except LocalError as error:
        raise halt.nobody(error) from None
    found = {name: place for name, place in found.items() if not args.robots or name in args.robots}
    meant = tuple(real[name] for name in args.robots or real if name in real)
    ssh = Ssh(args.ssh_config, alone=True, named=False)
    answers, began = _Answers(), elapsed()

    def by_ssh() -> None:
        nonlocal answers
        answers = command(meant, ssh, stop=stop, reason=args.reason, began=began, confirmed=so_far.append)

    so_far: list[str] = []
    rows: list[halt.Row] = []
    thread = threading.Thread(target=by_ssh, name="ssh")
    thread.start()
    try:
        if found:
            try:
                rows = halt.stop_or_arm(found, stop=stop, reason=args.reason, timeout=args.timeout)
            except LocalError as error:  # the simulation may be just starting or ending
                complain("note", str(error))  # on a full disk, too, it does not end the command
        thread.join(_NOTE_S)
        if thread.is_alive():
            complain("swarm", f"{_so_far(meant, so_far)}; waiting for the others")
            thread.join()
    except KeyboardInterrupt:
        complain("swarm", f"INTERRUPTED; {_so_far(meant, so_far)}; OTHERS MAY NOT HAVE BEEN TOLD")
        raise
    how = {host.robot: _how(host.robot, answers) for host in meant}
    done = not problem and halt.all_confirmed(
        [*(row.confirmed for row in halt.reached(rows)), *map(bool, how.values())]
    )
    told = {name: {"confirmed": outcome.ok, "text": outcome.text} for name, outcome in answers.outcomes.items()}
    simulated, real_ones = halt.table(rows, stop=stop), table(how, answers, stop=stop)
    lines = simulated if not how else real_ones
    if rows and how:
        lines = ["simulated robots", "", *simulated, "", "real robots", "", *real_ones]
    show(args, {**halt.report(args, rows, unknown, done=done), "ssh": told}, lines)
    if problem:
        sys.stdout.flush()
        complain("swarm", f"{problem}; NOBODY KNOWS WHETHER MORE ROBOTS THAN THESE ARE MEANT: mend the file")
    return halt.ended(unknown, done=done)


def legible(path: Path | None) -> dict[str, Host]:
    """Return the robots that can be read in a configuration with an error, wherever that is: a stop reaches them."""
    try:
        text = "" if path is None else path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    found = {}
    for table in filter(_ROBOTS.match, _TABLE.split(text)):
        entries: dict[str, str] = dict(_ENTRY.findall(table))
        name = entries.get("name", "")
        address = entries.get("host", name)
        if is_name(name) and HOST.fullmatch(address):
            found[name] = Host(name, address)
    return found


def stop_all(reason: str, args: argparse.Namespace, *, as_json: bool = False) -> None:
    """Stop all robots as `swarm estop REASON` does, with the configurations that `args` of another command name."""
    parser = argparse.ArgumentParser(prog="swarm estop")
    add_arguments(parser)
    own = parser.parse_args(["stop", reason])
    own.config, own.ssh_config, own.json = args.config, args.ssh_config, as_json
    run(own)


def _simulated(run_dir: Path | None) -> dict[str, Path]:
    """Return the runtime directories of the robots of a simulation that runs here; none where none runs."""
    directory = (run_dir or default_run_dir()).absolute()
    return robots(directory) if is_live(directory) else {}


def _without_config(args: argparse.Namespace, error: LocalError) -> int:
    """Stop or arm the robots of a simulation alone, since no configuration names real robots. Where there is one that
    cannot be used, real robots may be meant: nobody has told them, and the exit code is not 0."""
    if args.config is None and find.find() is None:
        return halt.run(args)
    if args.config is not None or not _simulated(None):
        raise halt.nobody(error)
    code = halt.run(args)
    complain("swarm", f"{error}; no real robot was told")
    return code or 1


def _so_far(robots: Sequence[Host], confirmed: Sequence[str]) -> str:
    """Return which real robots have confirmed while the command goes on."""
    which = f" ({' '.join(sorted(confirmed))})" if confirmed else ""
    return f"{len(confirmed)} of {len(robots)} real robots have confirmed until now{which}"


def _how(name: str, answers: _Answers) -> str:
    """Return the paths by which a real robot is confirmed; empty where it is not."""
    paths = ["ssh"] if name in answers.outcomes and answers.outcomes[name].ok else []
    paths += [f"mesh (seen by {answers.seen[name]})"] if name in answers.seen else []
    return ", ".join(paths)


def table(how: Mapping[str, str], answers: _Answers, *, stop: bool) -> list[str]:
    """Return the lines about the robots that ssh was to reach. `how`: the paths by which each is confirmed."""
    what = "stopped" if stop else "armed"
    lines = [("robot", what, "confirmed by", "ssh says")]
    for name, paths in how.items():
        lines.append((name, "yes" if paths else "NOT CONFIRMED", paths or "-", answers.said(name)))
    missing = [name for name, paths in how.items() if not paths]
    summary = f"{what}: {len(how) - len(missing)} of {len(how)} robots"
    summary += f"; NOT CONFIRMED: {' '.join(missing)}" if missing else ""
    return [*columns(lines), "", summary, *([] if stop else [halt.NEXT])]


def command(
    robots: tuple[Host, ...],
    ssh: Ssh,
    *,
    stop: bool,
    reason: str,
    began: float,
    confirmed: Callable[[str], None] = lambda _: None,
) -> _Answers:
    """Tell all robots at once; returns when each has answered or is given up. `began`: what `elapsed` gave when the
    command was given. `confirmed` gets the name of each robot as soon as it has confirmed."""
    answers = _Answers()
    words = [*(["estop", reason] if stop else ["arm"]), "--json", "--timeout", str(THERE_S)]

    async def since(host: Host) -> list[str]:
        """Return the words that say when, by the robot's clock, `swarm arm` was given, or earlier: it takes back no
        stop that came later, however long ssh takes. A robot never sleeps, so its uptime is its monotonic clock."""
        there = float((await ssh.check(host, "cat /proc/uptime")).split()[0])
        return ["--since", f"{there - (elapsed() - began):.2f}"]

    async def ask(host: Host) -> tuple[str, str]:
        """Return what the robot's own command prints, and the last words of its errors."""
        started = clock.now()
        try:
            async with asyncio.timeout(_HANGS_S if stop else None):
                later = [] if stop else await since(host)
                done = await ssh.run(host, robot_command.words(host, [*words, *later]))
        except TimeoutError:
            return "", f"its own command has not ended within {_HANGS_S:g} s"
        except HostError as error:
            if not stop or clock.now() > started + _BREAKS_S:  # the robot is away: another try would take as long
                raise
            return "", str(error)
        if later and done.code == _USAGE and "--since" in done.err:
            # Without the time the robot would take back stops that came after the command.
            raise HostError("its release is older than this program: swarm deploy, or swarm arm on the robot")
        return done.out, last_words(done.err)

    async def job(host: Host, _: everyone.ReportProgress) -> str:
        text = await confirmation(host)
        confirmed(host.robot)
        return text

    async def confirmation(host: Host) -> str:
        """Return how a robot has confirmed; raises `HostError` where it has not."""
        out, error = await ask(host)
        rows = _rows(out)
        for name, row in rows.items():
            if row.get("confirmed") is True and name != host.robot:
                answers.seen[name] = host.robot
        own = rows.get(host.robot, {})
        obeyed = own.get("confirmed") is True
        if obeyed and not stop:
            return "its own bus says so"
        if obeyed and own.get("mode") is not None:
            return "its own bus and balancer say so"
        silent = "its balancer tells no state" if obeyed else "its bus does not confirm it"
        problem = error.removeprefix("swarm: ") or silent
        if not stop:
            raise HostError(problem)
        stop_it = f"sudo -n systemctl stop swarm-balancer.service && {{ {OWN_NAME}; }}"
        found = printable((await ssh.check(host, stop_it)).strip())
        if found not in ("", host.robot):
            raise HostError(f"its balancer was stopped, but it says that it is {found}: correct `host` in swarm.toml")
        return f"its balancer was stopped ({problem}): swarm services start balancer, when all is well"

    try:
        found = asyncio.run(everyone.each(robots, job, _HANGS_S + _SYSTEMD_S if stop else THERE_S + _SLACK_S))
    except LocalError as error:  # there is no ssh here: nobody was told
        found = [everyone.RobotOutcome(host.robot, False, str(error), 0.0) for host in robots]
    answers.outcomes = {outcome.robot: outcome for outcome in found}
    return answers


def _rows(text: str) -> dict[str, dict[str, Any]]:
    """Return the rows by robot that a robot's own command has printed; none where it printed something else."""
    try:
        return {str(row["robot"]): dict(row) for row in read_json(text)["robots"]}
    except (PayloadError, ValueError, LookupError, TypeError):
        return {}
