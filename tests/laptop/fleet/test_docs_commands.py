"""The commands of the how-to pages about fleets and robots and the tutorial's robot step, as they stand there.

What ssh servers in place of robots suffice for is run here, in the order of the pages: blocks with the label `ssh`, and
what stands within sentences. What needs a robot's system is named, with the test that runs it on one.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import documented_path
import pytest
from fake_releases import add_python, add_robot, make_package_cache
from fake_robots import FakeRobots
from needs import needs_ssh

from swarm.config import parse
from swarm.config.example import EXAMPLE

pytest_plugins = ["fleet_fixtures"]

DOCS = Path(__file__).parents[3] / "docs"
INLINE = ("robots/build-a-robot.md", "robots/first-power-on.md", "robots/commission.md")
"""Pages with commands within their sentences."""
TUTORIAL = DOCS / "tutorials/own-algorithm.md"

ELSEWHERE = {
    "swarm bundle": "Debian's archive: tests/laptop/fleet/release/test_bundle.py",
    "swarm provision": "a robot's system: tests/deploy/test_provision_boot.py, tests/laptop/fleet/test_provision.py",
    "swarm pair": "bluetoothd: tests/lab/test_lab_pairing.py, tests/laptop/fleet/test_pair.py",
    "swarm doctor": "a robot's system: tests/laptop/fleet/test_doctor.py",
    "swarm dwm": "modules: tests/services/dwm/test_dwm_tool.py",
    "swarm calibrate": "a robot's module: tests/laptop/fleet/files/test_calibrations.py",
    "swarm flash": "avr-gcc: tests/laptop/cli/robots/body/test_flash_fleet.py",
    "swarm commission": "bodies: tests/laptop/cli/robots/body/test_commission_ssh.py, tests/sim/control/test_hands.py",
    "swarm balance": "a robot's body: tests/laptop/cli/robots/body/test_balance_ssh.py",
    "swarm drive": "a keyboard: tests/laptop/cli/robots/body/test_drive_ssh.py",
    "swarm sim": "a simulation: tests/sim/control/test_hands.py, tests/sim/scenario/test_commission_report.py",
    "swarm hand": "a simulation: tests/sim/control/test_hands.py",
}
"""Commands that are not run here: what they need, and what runs them."""


def commands() -> list[str]:
    """Each command line of the pages, without its comment, in their order."""
    inline = "\n".join((DOCS / "how-to" / page).read_text() for page in INLINE)
    tutorial = TUTORIAL.read_text()
    found = re.findall(r"`((?:swarm|deploy/release) [^`\n]+)`", inline)
    found += [command for page in documented_path.PAGES for command in documented_path.commands(page, "ssh")]
    found += re.findall(r"^(swarm .*)$", tutorial[tutorial.index("On robots") :], re.M)
    return [line.partition("  #")[0].partition(" #")[0].strip() for line in found]


def is_elsewhere(command: str) -> bool:
    return any(command.startswith(each) for each in ELSEWHERE)


def test_each_command_of_the_pages_is_run_here_or_named_with_what_runs_it() -> None:
    here = {command for command in commands() if not is_elsewhere(command)}
    assert here == {
        "swarm key new swarm.key",
        "swarm config --example > swarm.toml",
        "swarm deploy",
        "swarm deploy --key swarm.key",
        "swarm run descent.py",
    }


def rig(robots: FakeRobots) -> dict[str, str]:
    """Six robots as the example has them, and the environment in which the pages' commands reach them."""
    for number in range(6):
        home = add_robot(robots, f"r{number}")
        add_python(home)
        sudo = (home / "bin/sudo").read_text()
        installed = 'echo "$@" >>$HOME/installed; echo "install: $(cat ID) runs"'
        (home / "bin/sudo").write_text(sudo.replace("case $1 in", f"case $1 in ./install) {installed} ;;", 1))
    (far,) = [robot for robot in parse(EXAMPLE, robots.config).robots if robot.host is not None]
    # One robot's address stands in the example, with a user that this machine lacks: it is one of these robots, too.
    named = f'[ "$word" != {far.host} ] || word={far.name}; set -- "$@" "$word"'
    ssh = f'for word; do shift; {named}; done; exec /usr/bin/ssh -F {robots.ssh_config} "$@"'
    tools = robots.folder / "tools"
    tools.mkdir()
    for name, line in (
        ("swarm", f'exec {sys.executable} -P -m laptop.cli "$@"'),
        ("ssh", ssh),
    ):
        (tools / name).write_text(f"#!/bin/sh\n{line}\n")
        (tools / name).chmod(0o755)
    make_package_cache(robots.folder / "cache")
    own = {name: value for name, value in os.environ.items() if not name.startswith("SWARM_")}
    return {
        **own,
        "PATH": f"{tools}:{os.environ['PATH']}",
        "PYTHONPATH": str(DOCS.parent),
        "XDG_CACHE_HOME": str(robots.folder / "cache"),
        "XDG_RUNTIME_DIR": str(robots.folder / "none"),
    }


@needs_ssh
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_commands_of_the_pages_work_in_their_order_as_they_stand(robots: FakeRobots) -> None:
    environment = rig(robots)
    descent = re.search(r"```python descent\.py\n(.*?)```", TUTORIAL.read_text(), re.S)
    assert descent is not None
    (robots.folder / "descent.py").write_text(descent[1])
    robots.config.unlink()
    robots.ready()
    for command in dict.fromkeys(each for each in commands() if not is_elsewhere(each)):
        done = subprocess.run(
            ["/bin/sh", "-c", command], cwd=robots.folder, env=environment, capture_output=True, text=True,
            check=False, timeout=240,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    for number in range(6):
        home = robots.folder / f"r{number}"
        first, *_, last = (home / "installed").read_text().splitlines()
        assert first.startswith(f"./install --name r{number} --config ")
        assert "--key" in first + last
        assert list(home.glob("lib/apps/descent-*/descent.py"))
        assert (home / "systemctl.log").read_text().splitlines()[-1] == "restart --no-block swarm-app@descent.service"
