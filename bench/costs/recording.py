"""What a recording costs an app's process, and what a kill -9 takes from it."""

import contextlib
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.rigs.running import running
from bench.rows import Row
from services.apps.persistence.recorder import Recorder
from swarm.recording import trajectory
from swarm.recording.file import FLUSH_S, RecordingFile

RATE_HZ = 1000.0
LIMIT_S = 50e-6
"""CPU time of a state: 5 % of a lockstep iteration of 1 ms, the fastest that links of no latency allow."""
LIMIT_BYTES = 200.0
LIMIT_KIB = 2048.0
LOST_S = FLUSH_S + 0.2
"""What is recorded between two flushes may be lost, and what is while one of them is under way."""

IMPORTS = "import swarm.process.service, swarm.app.overlays, services.apps.runner"
RESIDENT = "open('/proc/self/statm').read().split()[1]"


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    states: int = 20_000
    before_kill: int = 200
    """States on the disk before the process is killed, at any time between two flushes."""

    kills: int = 10


FULL = Sizes()
SMOKE = Sizes(500, 20, 1)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    states = sizes.states
    with tempfile.TemporaryDirectory() as place:
        path, journal = Path(place) / "r0.x.mcap", Path(place) / "journal"
        file = RecordingFile(path, Counter(), append=False, journal=journal)
        began = _cpu_s()
        _record(file, states)
        file.close()
        yield Row("a state, CPU time", (_cpu_s() - began) / states, "s", LIMIT_S, 1.0)
        yield Row("a state, on the disk", path.stat().st_size / states, "bytes", LIMIT_BYTES, 1.0)
        began = _cpu_s()
        found = trajectory.read(path)
        yield Row("reading a state, CPU time", (_cpu_s() - began) / states, "s", LIMIT_S, 1.0)
        yield Row("states that are missing", float(states - len(found.rows)), "", 1.0, 0.0)
    yield Row("its modules, resident", _resident_kib(), "KiB", LIMIT_KIB, 1.0)
    draw = random.Random(1)
    lost_s = max(_lost_s(sizes.before_kill, draw.uniform(0.0, 2 * FLUSH_S)) for _ in range(sizes.kills))
    yield Row(f"lost by a kill -9, without a restart, most of {sizes.kills}", lost_s, "s", LOST_S, 1.0)


def _record(file: RecordingFile, states: int) -> None:
    recorder = Recorder(file, "r0", "x")
    for k in range(states):
        recorder.state(k, k / RATE_HZ, {"value": k / 3}, {"value": k / 3})
        if k % 500 == 499:
            file.flush()


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def _resident_kib() -> float:
    """What importing it adds to an app host that has all the rest."""
    program = f"{IMPORTS}\na = int({RESIDENT})\nimport services.apps.persistence.recording\nprint(int({RESIDENT}) - a)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return float(done.stdout) * resource.getpagesize() / 1024


def _lost_s(before: int, pause_s: float) -> float:
    """Between the last state in the file and the last one that was recorded, when the process is killed: a while after
    `before` states were seen in the file, which is right behind a flush."""
    program = (
        "import sys, time\nfrom collections import Counter\nfrom pathlib import Path\n"
        "from swarm.recording.file import RecordingFile\nfrom services.apps.persistence.recorder import Recorder\n"
        "recorder = Recorder(RecordingFile(Path(sys.argv[1]), Counter(), append=False), 'r0', 'x')\nk = 0\n"
        "while True:\n    recorder.state(k, time.monotonic(), {'v': 1.0}, {})\n    k += 1\n    time.sleep(0.005)\n"
    )
    with tempfile.TemporaryDirectory() as place, contextlib.ExitStack() as stack:
        path = Path(place) / "r0.x.mcap"
        process = stack.enter_context(running([sys.executable, "-c", program, path]))
        while not path.exists() or trajectory.read(path).last < before:
            time.sleep(0.05)
        time.sleep(pause_s)
        process.kill()
        killed = time.monotonic()
        process.wait()
        return killed - max(trajectory.read(path).times.values())
