"""`swarm fetch [RUN...]`: the recordings and journals of all robots into one folder on this computer.

Calibrations that were made on robots come along, to where `swarm.toml` says.
"""

import argparse
import contextlib
from collections.abc import Sequence
from pathlib import Path

from laptop.fleet.files.calibrations import bring_back
from laptop.fleet.files.fetch import RecordingFetch
from laptop.fleet.ssh import everyone
from laptop.fleet.ssh.ssh import Host, HostError, Ssh
from swarm.config import Config
from swarm.errors import LocalError
from swarm.onboard.command_line import complain
from swarm.process.locks import folder_lock

HELP = "copy the recordings and logs of all robots to this computer, over ssh"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="*", metavar="RUN", help="names of runs (APP-NUMBER) or of apps (default: all)")
    parser.add_argument("--into", type=Path, default=Path("runs"), metavar="DIR", help="folder for the copies (runs)")
    parser.add_argument(
        "--delete", action="store_true", help="delete files on the robots once the copy here is verified"
    )
    parser.add_argument("--no-logs", action="store_true", help="copy recordings, not journals")
    everyone.add_arguments(parser, timeout_s=3600)


def run(args: argparse.Namespace) -> int:
    """Fetch the files. Return 0 where all files of every robot are here. A transfer that broke off goes on the next
    time."""
    config, robots, ssh = everyone.recipients(args)
    with contextlib.ExitStack() as held:
        try:
            args.into.mkdir(parents=True, exist_ok=True)
            held.enter_context(folder_lock(args.into, wait=False))
        except BlockingIOError:
            raise LocalError(
                f"{args.into}: another swarm fetch writes to it: let it end, or choose another --into"
            ) from None
        except FileExistsError:
            raise LocalError(f"{args.into}: it is no folder") from None
        except OSError as error:
            raise LocalError(f"{args.into}: {error.strerror}") from None
        return _fetch(args, config, robots, ssh)


def _fetch(args: argparse.Namespace, config: Config, robots: Sequence[Host], ssh: Ssh) -> int:
    found: set[str] = set()

    async def job(host: Host, tell: everyone.ReportProgress) -> str:
        await everyone.check_answer(ssh, host)
        fetch = RecordingFetch(ssh, host, args.into, tell)
        got = await fetch.recordings(args.runs)
        found.update(got.runs, (run.rpartition("-")[0] for run in got.runs))
        if got.strange:
            tell(f"left there, with a name that is none of ours: {', '.join(map(repr, got.strange[:5]))}")
        said = [f"{got.files} files of {len(got.runs)} runs, {got.received} bytes received"]
        if not args.no_logs:
            said.append(f"{await fetch.journal()} new log entries")
        if calibration := await bring_back(ssh, host, config):
            said.append(calibration)
        if args.delete:
            gone, running = await fetch.delete()
            said.append(f"{gone} files deleted there" + (f", not of {' '.join(running)}: it runs" if running else ""))
            if gone < sum(file.run not in running for file in got.verified):
                raise HostError(f"{'; '.join(said)}: the others have changed meanwhile")
        return ", ".join(said)

    code = everyone.run(args, robots, job)
    if nowhere := [name for name in args.runs if name not in found]:
        hint = "".join(f"; {name} is a robot: --robots {name}" for name in nowhere if name in config.names)
        complain("swarm", f"no robot has told of a run, or of runs of an app, called {', '.join(nowhere)}{hint}")
    return 1 if nowhere else code
