"""`swarm calibrate` on a laptop: as on a robot, and for a real robot over ssh.

The robot runs the session alone, and sends its samples; the fit, the pictures and the file are made here, beside
`swarm.toml`. `swarm deploy` brings the file to the robot.
"""

import argparse
import asyncio
import contextlib
import os
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

from laptop.fleet.ssh import robot_command
from laptop.fleet.ssh.ssh import NO_SSH, Host, HostError, Ssh, copy_text, hosts
from services.dwm.calibrate import __main__ as calibrate
from swarm.config import Config, load
from swarm.errors import LocalError
from swarm.files import atomic_write
from swarm.onboard.command_line import FAR_OPTIONS

_SESSIONS = ("distance", "position", "samples", "check")
_THERE = "/run/swarm/calibration-{robot}-{stamp}.csv"


def main() -> int:
    """Run one command, and return its exit code."""
    way = argparse.ArgumentParser(add_help=False)
    robot_command.add_arguments(way)
    args, words = way.parse_known_args(sys.argv[1:])
    options = calibrate.options_of(words, FAR_OPTIONS)
    args.run_dir = options.run_dir
    config = None
    if robot_command.is_far(args):
        config = load(args.config)
        os.environ["SWARM_CONFIG"] = str(config.path.absolute())
    if config is None or _is_of_files(options):
        return calibrate.main(words)
    if options.samples is not None and options.samples.exists():
        raise LocalError(f"{options.samples}: is there already; name another file with --samples")
    (host,) = hosts(config, options.robots)
    samples = _measure(Ssh(args.ssh_config), host, options, config)
    if options.command == "samples":
        sys.stdout.write(f"the samples are in {samples}: swarm calibrate fit {samples} --robots {host.robot}\n")
        return 0
    common = ["--robots", host.robot]
    if options.target is not None:
        common += ["--target", *map(str, options.target)]
    if options.command == "check":
        return calibrate.main(["check", "--samples", str(samples), *common])
    common += ["--output", str(options.output)] if options.output else []
    common += ["--no-plot"] * options.no_plot
    code = calibrate.main(["fit", str(samples), "--only", options.command, *common])
    if code == 0:
        sys.stdout.write("swarm deploy brings it to the robot\n")
    return code


def _is_of_files(options: argparse.Namespace) -> bool:
    """Return whether the command reads files alone, and asks no robot."""
    if options.command == "check" and options.samples is not None:
        return bool(options.samples.exists())
    return options.command not in _SESSIONS


def _measure(ssh: Ssh, host: Host, options: argparse.Namespace, config: Config) -> Path:
    """Lead the session on the robot and bring its samples here. Raises `LocalError`."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
    path: Path = options.samples or Path(f"calibration-{host.robot}-{stamp}.csv")
    there = _THERE.format(robot=host.robot, stamp=stamp)
    places = " ".join(f"{x},{y}" for x, y in calibrate.places_of(options, config))
    words = ["calibrate", "samples", "--robots", host.robot, "--places", places, "--samples", there]
    words += ["--orientations", str(options.orientations), "--count", str(options.count)]
    sys.stdout.flush()
    try:
        asyncio.run(ssh.check(host, "true"))  # before a person walks about with the robot
    except HostError as error:
        raise LocalError(f"{host.robot}: {error}") from None
    try:
        # The terminal stays ours, line by line: Enter, n, r and q go to the robot, or its own buttons are used.
        with subprocess.Popen(
            ssh.arguments(host, robot_command.words(host, words)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ) as process:
            assert process.stdout is not None
            ended = ""
            try:
                copy_text(process.stdout, sys.stdout)
            except KeyboardInterrupt:  # what was measured until now took a person's time
                process.terminate()
                ended = "was interrupted"
        if process.returncode != 0:
            ended = ended or f"ended with code {process.returncode}"
    except FileNotFoundError:
        raise LocalError(NO_SSH) from None
    try:
        data = asyncio.run(ssh.check(host, f"sudo -n cat {there}"))
        atomic_write(path, data.encode())
    except (HostError, OSError) as error:
        if ended and "No such file" in str(error) and isinstance(error, HostError):
            raise LocalError(f"{host.robot}: the session {ended}; nothing was measured") from None
        kept = f"what was measured is on the robot until it is switched off, in {there}"
        raise LocalError(f"{host.robot}: no samples are here ({error}); {kept}") from None
    with contextlib.suppress(HostError):  # the samples are on the disk here
        asyncio.run(ssh.check(host, f"sudo -n rm {there}"))
    if ended:
        raise LocalError(f"{host.robot}: the session {ended}; what was measured is in {path}")
    return path
