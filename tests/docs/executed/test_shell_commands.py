"""The shell commands of all pages are run as they stand, in the order of their page, each page in a folder of its own.

A real-time simulation on a page goes on while the commands below it act on it. What is not run here is in a block that
says why and which test runs such commands (`documented_path.py` has the form), or on a page with a test of its own.
"""

import contextlib
import re
import shlex
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import pytest
from conftest import wait_until
from documented_path import FENCE, LABELS, SHOWN, blocks
from documented_path import PAGES as ROBOTS
from test_command_lines import PAGES, PLACEHOLDER, ROOT
from test_tutorial import PAGES as TUTORIALS
from test_tutorial import commands_on_the_path

from bench.rigs.running import end

OWN = {
    "docs/how-to/network/fit-the-radio.md": "tests/docs/executed/test_radio_page.py",
    **dict.fromkeys([f"docs/{page}" for page in ROBOTS], "tests/docs/executed/test_documented_path.py"),
}
"""Pages whose blocks of commands have a test of their own."""
BY_OTHERS = {**LABELS, "picture": "tests/docs/executed/test_app_pages.py"}
INDENTED = re.compile(r"^ {4}((?:\./run |swarm |z_sub |pip |python |ssh )(?:.*\\\n)*.*)$", re.MULTILINE)
PROGRAMS = ("swarm", "z_sub")
ENDLESS = {"view", "foxglove", "z_sub"}
"""Commands that run until Ctrl-C: each is given up when it has said something."""
BESIDE = {
    "docs/explanation/stop.md": "swarm sim consensus --robots 2 --seconds 300",
    "docs/how-to/apps/set-parameters.md": "swarm sim follow_leds.py --robots 3 --seconds 300",
    "docs/how-to/network/change-the-topology.md": "swarm sim consensus --robots 4 --seconds 300",
    "docs/how-to/network/inspect-the-mesh.md": "swarm sim consensus --robots 4 --topology loop --seconds 300",
    "docs/how-to/robots/set-up-uwb.md": "swarm sim localization --robots 2 --seconds 300",
    "docs/how-to/runs/act-from-the-page.md": "swarm sim consensus --robots 2 --seconds 300",
    "docs/how-to/runs/find-who-waits.md": "swarm sim consensus --robots 5 --topology loop --seconds 300",
    "docs/how-to/tools/motion-capture.md": "swarm sim localization --robots 2 --seconds 300",
    "docs/explanation/epochs.md": "swarm sim consensus --robots 4 --topology full --seconds 300",
    "docs/reference/keys.md": "swarm sim consensus --robots 2 --seconds 300",
}
"""By page the simulation that its commands act on, where the page starts none."""
FILES = {
    "docs/how-to/apps/set-parameters.md": ("follow_leds.py", "docs/how-to/apps/react-to-events.md"),
}
"""By page the file of an app that its commands need, and the page with its text."""
FIRST = {
    "docs/how-to/apps/check-an-app.md": "swarm new my_app.py",
    "docs/reference/apps.md": "swarm new my_app.py",
}
"""By page a command that its commands need before."""
PARSED = frozenset({"docs/how-to/runs/make-films.md"})
"""Pages of which only the simulations in virtual time are run, since each film takes minutes (test_film.py makes them);
test_command_lines.py parses all their commands."""
EXIT_CODES = {("docs/reference/tour.md", "swarm doctor"): 1}
"""By page and command: its exit code where it is to find a fault."""
STARTED_S = 100.0
OWN_END_S = 30.0
"""Seconds for a simulation to come to its own end, where no command of its page acts on it."""


class Typed(NamedTuple):
    """A command of a page."""

    page: str
    text: str

    @property
    def words(self) -> list[str]:
        return shlex.split(self.text)

    @property
    def in_real_time(self) -> bool:
        """Whether it is a simulation that others act on."""
        return self.words[:2] == ["swarm", "sim"] and "--virtual" not in self.words

    @property
    def is_endless(self) -> bool:
        if self.words[0] == "z_sub":
            return "--count" not in self.words
        named = bool(ENDLESS & set(self.words[:2])) and "--screenshot" not in self.words
        return named or "--view" in self.words or "--watch" in self.words


def commands(page: Path) -> Iterator[str]:
    """The commands of a page that are run here, each as it is typed but for `./run`."""
    name, text = str(page.relative_to(ROOT)), page.read_text(encoding="utf-8")
    texts = []
    if name not in OWN:
        for found in FENCE.finditer(text):
            language, _, label = found[1].partition(" ")
            if language == "sh" and label not in BY_OTHERS and SHOWN.fullmatch(label) is None:
                tutorial = name.removeprefix("docs/") in TUTORIALS
                texts += [] if tutorial else [(found.start(), found[2])]
        plain = FENCE.sub(lambda found: " " * len(found[0]), text)
        texts += [(found.start(), found[1]) for found in INDENTED.finditer(plain)]
    for _, block in sorted(texts):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"; ", re.sub(r"(^|\s)#.*", "", line)):
                typed = part.strip().removeprefix("./run ").rstrip("& ")
                if typed and not PLACEHOLDER.search(typed):
                    yield "swarm demo" if typed == "demo" else typed


TYPED = {str(page.relative_to(ROOT)): list(commands(page)) for page in PAGES}
NOT_HERE = {"README.md": ("test",)}
"""The suite does not run itself."""


@pytest.mark.parametrize("page", [page for page, lines in TYPED.items() if lines])
def test_every_command_of_a_page_is_of_a_program_that_is_run_here(page: str) -> None:
    odd = [line for line in TYPED[page] if line.split()[0] not in (*PROGRAMS, *NOT_HERE.get(page, ()))]
    assert odd == [], f"{page}: put them into a block ```sh shown=..."


def test_blocks_that_are_only_shown_name_a_test_that_is_there() -> None:
    for page in PAGES:
        for block in blocks(page):
            if (shown := SHOWN.fullmatch(block.label)) is not None:
                assert (ROOT / shown[2]).is_file(), (page, shown[2])


class Shell:
    """A folder in which commands are run, beside at most one simulation in real time."""

    def __init__(self, home: Path, environment: dict[str, str]) -> None:
        self.home, self._environment = home, environment
        self._beside: subprocess.Popen[str] | None = None
        self._simulated = ""
        self._said = home.parent / "simulation.log"

    def _start(self, line: str, out: int | IO[str]) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            ["/bin/sh", "-c", f"exec {line}"], cwd=self.home, env=self._environment, text=True,
            stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT,
        )  # fmt: skip

    def simulate(self, line: str) -> None:
        """Start a simulation, and wait until no service of it is starting."""
        self.end()
        self._simulated = line
        with self._said.open("w") as said:
            self._beside = process = self._start(line, said)

        def runs() -> bool:
            if process.poll() is not None:
                return True
            progress = re.findall(r"^ +[\d.]+ s  r0 .*$", self._said.read_text(), re.MULTILINE)
            return bool(progress) and "starting" not in progress[-1]

        wait_until(runs, STARTED_S, what=line)

    def stay(self, typed: Typed) -> None:
        """End the simulation for a command that reads its recording. For any other one start it again if it has come
        to its end, which a person with many terminals is spared."""
        if "--record" in self._simulated and typed.words[1] in ("plot", "export", "replay"):
            self.end()
        elif self._beside is not None and self._beside.poll() == 0:
            self.simulate(self._simulated)

    def run(self, line: str, code: int = 0) -> None:
        """Run a command to its end."""
        done = subprocess.run(
            ["/bin/sh", "-c", line], cwd=self.home, env=self._environment, capture_output=True, text=True, check=False,
            stdin=subprocess.DEVNULL, timeout=400,
        )  # fmt: skip
        assert done.returncode == code, f"{line}\n{done.stdout}\n{done.stderr}\n{self._log()}"

    def look(self, line: str) -> None:
        """Run a command that never ends, until it has said something."""
        process = self._start(line, subprocess.PIPE)
        try:
            assert process.stdout is not None
            assert process.stdout.readline(), f"{line}: has ended\n{self._log()}"
        finally:
            process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=60)[0]
        assert process.returncode in (0, 130, -signal.SIGINT), f"{line}: {process.returncode}\n{said}"

    def end(self, patience: float = 0.0) -> None:
        """End the simulation as Ctrl-C does, if it has not come to its own end within `patience` seconds."""
        process, self._beside = self._beside, None
        if process is None:
            return
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(patience)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) in (0, 130, -signal.SIGINT), self._log()

    def close(self) -> None:
        """Leave no process behind, whatever has failed."""
        if self._beside is not None:
            end(self._beside)

    def _log(self) -> str:
        return self._said.read_text()[-3000:] if self._said.exists() else ""


def played(page: str) -> list[Typed]:
    """The commands of a page that are run, in their order, with those that come before."""
    lines = [Typed(page, line) for line in TYPED[page] if line not in NOT_HERE.get(page, ())]
    if page in PARSED:
        simulations = [each for each in lines if each.words[:2] == ["swarm", "sim"]]
        return [each for each in simulations if not (each.in_real_time or each.is_endless)]
    before = [Typed(page, named[page]) for named in (FIRST, BESIDE) if page in named]
    return before + lines if lines else []


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", [page for page in TYPED if played(page)])
def test_commands_of_a_page_run_as_they_stand(page: str, tmp_path: Path, runtime: Path) -> None:
    tools, home = tmp_path / "tools", runtime / "home"  # a simulation of a page may have its folder there
    tools.mkdir()
    (home / "docs" / "images").mkdir(parents=True)
    environment = {**commands_on_the_path(tools, runtime), "BROWSER": "true"}
    if page in FILES:
        name, source = FILES[page]
        found = re.search(r"^```python\n(.*?)^```$", (ROOT / source).read_text(), re.MULTILINE | re.DOTALL)
        assert found is not None
        (home / name).write_text(found[1])
    with contextlib.closing(Shell(home, environment)) as shell:
        play(shell, played(page))


def play(shell: Shell, lines: list[Typed]) -> None:
    """Run commands in their order."""
    for number, typed in enumerate(lines):
        line = typed.text
        if typed.in_real_time:
            shell.simulate(line)
            following = {each.words[1] for each in lines[number + 1 : number + 2]}
            if following & {"sim", "plot", "sweep"} or "--plot" in typed.words:
                shell.end(OWN_END_S)
            continue
        if "--virtual" not in typed.words:
            shell.stay(typed)
        if typed.is_endless:
            shell.look(line)
        else:
            shell.run(line, EXIT_CODES.get((typed.page, line), 0))
    shell.end(0 if lines[-1].words[:2] != ["swarm", "sim"] else OWN_END_S)
