"""Same seed, same bytes: every app, in two processes that hash texts differently, so that sets go in other orders, and
add floats by `sum` differently, as Python does before 3.12 and since."""

import json
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
from conftest import thinned

from bench.rigs.running import running
from services.apps import loader

EXAMPLES = Path(__file__).parents[3] / "examples"

APPS = {
    **{
        f"{name} {algorithm}".strip(): [name, *(["--algorithm", algorithm] if algorithm else [])]
        for name in loader.BUILT_IN
        for algorithm in (loader.load(name).algorithms if len(loader.load(name).algorithms) > 1 else [""])
    },
    **{path.stem: [str(path)] for path in EXAMPLES.glob("*.py")},
}
APPS["localization thesis"] += ["--step-size", "2e-6"]
"""Its own one is too large for five robots."""

DISTURBED = (
    "--robots",
    "4",
    "--topology",
    "full",
    "--seconds",
    "1",
    "--jitter",
    "10ms",
    "--seed",
    "4",
    "--press",
    "r2.A@0.5s",
)

RUN = """
import builtins, hashlib, json, pathlib, sys
from sim.virtual.run import run_virtually

def plain(numbers, /, start=0):
    for number in numbers:
        start = start + number
    return start

def compensated(numbers, /, start=0):
    rest = 0.0
    for number in numbers:
        after = start + number
        if type(after) is float:  # Neumaier 1974
            rest += (start - after) + number if abs(start) >= abs(number) else (number - after) + start
        start = after
    return start + rest if rest else start

builtins.sum = {"1": plain, "2": compensated}[sys.argv[3]]
for name, arguments in json.loads(sys.argv[1]).items():
    folder = pathlib.Path(sys.argv[2]) / name.replace(" ", "_")
    report, _ = run_virtually(*arguments, "--record", str(folder))
    digests = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}
    size = sum(path.stat().st_size for path in folder.glob("*.mcap"))
    print(json.dumps([name, [report["problems"], sorted(digests.items()), size]]), flush=True)
"""


class Recordings:
    """What one process says of each app, as soon as it says it: problems, digests of all files and bytes of the
    recording."""

    def __init__(self, apps: list[str], folder: Path, salt: str, stack: ExitStack) -> None:
        runs = json.dumps({name: [*APPS[name], *DISTURBED] for name in apps})
        words = [sys.executable, "-c", RUN, runs, folder, salt]
        environment = {"PYTHONHASHSEED": salt, "PATH": "", "PYTHONPATH": ":".join(sys.path)}
        self.process = stack.enter_context(running(words, env=environment, stdout=subprocess.PIPE, text=True))
        self._found = {}

    def of(self, app: str) -> list:
        while app not in self._found:
            line = self.process.stdout.readline()
            assert line, "it has ended before"
            name, found = json.loads(line)
            self._found[name] = found
        return self._found[app]


@pytest.fixture(scope="module")
def recordings(request, tmp_path_factory):
    """Of the apps that this run of the tests asks for."""
    apps = [item.callspec.params["app"] for item in request.session.items if item.path == request.path]
    with ExitStack() as stack:
        yield [Recordings(apps, tmp_path_factory.mktemp(f"hash{salt}"), salt, stack) for salt in ("1", "2")]


@pytest.mark.parametrize("app", thinned(sorted(APPS)))
def test_every_app_records_the_same_bytes(recordings, app):
    (problems, digests, size), again = (each.of(app) for each in recordings)
    assert problems == []
    assert {name for name, _ in digests} > {"run.toml", "swarm.toml"}
    assert size > 2000
    assert again == [problems, digests, size]
