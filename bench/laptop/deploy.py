"""`swarm deploy` to ssh servers on this machine: 8 robots beside one, and the second time of the same release.

The release has the size and shape of a real one (14 wheels, 11 MB that cannot be compressed). A robot's own part,
unpacking them into an environment, takes a Pi a minute in which the laptop waits; here it takes `Sizes.install_s`. All
robots share this machine's two cores, which real ones do not.
"""

import contextlib
import io
import json
import os
import random
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.rigs.fake_robots import FakeRobots
from bench.rows import Row

WHEELS = 14
INSTALL = "#!/bin/sh\nsleep {:g}\necho 'install: it runs'\n"

MOST_TIMES = 2.0
"""Budget: the time of 8 robots beside that of one."""
MOST_BYTES = 0.01
"""Budget: the bytes of the second deploy beside those of the first."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    robots: int = 8
    size: int = 11_000_000
    """Bytes of the release."""

    install_s: float = 5.0


FULL = Sizes()
SMOKE = Sizes(2, 140_000, 0.1)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Deploy to one, then to eight others, then to these again."""
    with tempfile.TemporaryDirectory(prefix="swarm-bench-") as name:
        folder = Path(name)
        release = _release(folder / "release.tar.gz", sizes)
        one_s, _ = _first_and_again(folder / "one", 1, release)[0]
        (all_s, first), (again_s, again) = _first_and_again(folder / "all", sizes.robots, release)
    yield Row("a release to one robot", one_s, "s", sizes.install_s, None)
    yield Row(f"a release to {sizes.robots} robots, beside one", all_s, "s", one_s, MOST_TIMES)
    ours_s, limit_s = all_s - sizes.install_s, one_s - sizes.install_s
    yield Row("the same beside one, without the robots' own part", ours_s, "s", limit_s, None)
    yield Row(f"the second time, {sizes.robots} robots", again_s, "s", one_s, None)
    yield Row("bytes of the second time, beside the first", float(again), "B", float(first), MOST_BYTES)


def _release(path: Path, sizes: Sizes) -> Path:
    noise = random.Random(1)
    files = {f"wheels/{n}.whl": noise.randbytes(sizes.size // WHEELS) for n in range(WHEELS)}
    files |= {
        "ID": b"1-bench",
        "FOR": f"{os.uname().machine} 3.11".encode(),
        "install": INSTALL.format(sizes.install_s).encode(),
    }
    with tarfile.open(path, "w:gz") as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(f"balboa-swarm-1-bench/{name}")
            entry.size, entry.mode = len(data), 0o755 if name == "install" else 0o644
            archive.addfile(entry, io.BytesIO(data))
    return path


def _first_and_again(folder: Path, count: int, release: Path) -> tuple[tuple[float, int], tuple[float, int]]:
    """(Seconds, bytes) of the first time and of the second."""
    folder.mkdir()
    with contextlib.closing(FakeRobots(folder)) as robots:
        for n in range(count):
            robots.add(f"r{n}")
            robots.script(f"r{n}", "python3.11", "")
        robots.ready()
        return _deploy(robots, release), _deploy(robots, release)


def _deploy(robots: FakeRobots, release: Path) -> tuple[float, int]:
    where = ["--config", str(robots.config), "--ssh-config", str(robots.ssh_config)]
    command = [sys.executable, "-m", "laptop.cli", "deploy", str(release), *where, "--json"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    report = json.loads(done.stdout)
    sent = (outcome["text"].rpartition("(")[2].split()[0] for outcome in report["robots"].values())
    return float(report["seconds"]), sum(map(int, sent))
