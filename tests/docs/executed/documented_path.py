"""The pages that lead from the box to robots that stand, and the code blocks on them.

The label of a block in its fence says which test runs it as it stands:

    ```sh laptop       tests/docs/executed/test_documented_path.py: needs no robot
    ```sh lab          tests/lab/test_lab_day_one.py: three virtual machines as robots
    ```sh ssh          tests/laptop/fleet/test_docs_commands.py: ssh servers as robots
    ```sh rehearsal    tests/docs/executed/test_calibration_rehearsal.py: a simulation
    ```sh shown="why it is not run: the test that runs such a command"
"""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
TUTORIAL = "tutorials/three-robots.md"
PAGES = (
    TUTORIAL,
    "how-to/fleet/provision.md",
    "how-to/fleet/pair.md",
    "how-to/fleet/find-faults.md",
    "how-to/fleet/deploy.md",
    "how-to/fleet/install-by-hand.md",
    "how-to/fleet/fetch-recordings.md",
    "how-to/robots/build-a-robot.md",
    "how-to/robots/first-power-on.md",
    "how-to/robots/calibrate.md",
    "how-to/robots/commission.md",
    "how-to/robots/stand-and-drive.md",
)
LABELS = {
    "laptop": "tests/docs/executed/test_documented_path.py",
    "lab": "tests/lab/test_lab_day_one.py",
    "ssh": "tests/laptop/fleet/test_docs_commands.py",
    "rehearsal": "tests/docs/executed/test_calibration_rehearsal.py",
}
"""By label the test that runs such blocks."""
FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHOWN = re.compile(r'shown="([^":]+): (tests/\S+\.py)"')


class Block(NamedTuple):
    """A fenced block of a page."""

    page: str
    language: str
    label: str
    text: str

    @property
    def commands(self) -> list[str]:
        """Its lines without their comments."""
        lines = (line.partition(" #")[0].strip() for line in self.text.replace("\\\n", " ").splitlines())
        return [line for line in lines if line and not line.startswith("#")]

    @property
    def run_by(self) -> str | None:
        """The test that runs it, or that a block which is only shown names; None where no test is known."""
        if (shown := SHOWN.fullmatch(self.label)) is not None:
            return shown[2]
        return LABELS.get(self.label)


def blocks(page: str | Path) -> list[Block]:
    """All fenced blocks of a page, in their order. A relative path begins in `docs`."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return [Block(str(page), *found[1].partition(" ")[::2], found[2]) for found in FENCE.finditer(text)]


def commands(page: str, label: str) -> list[str]:
    """The commands of a page's blocks with that label, in their order."""
    return [command for block in blocks(page) if block.label == label for command in block.commands]
