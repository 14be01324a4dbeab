"""Every decoder of the project, fed with random inputs in bounded memory: `./run bench decoders`, or with options

    python -m bench.decoders.decoders --inputs 10000000 --seed 3 --only "frames of a member"

The table has all that takes apart bytes of somebody else: of a stranger, of a member, of a neighbour's app, of a
device, of a file. A test compares it with the modules that use the means for that (`taking_apart`).
"""

import argparse
import ast
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.decoders import apps, data, mesh
from bench.decoders.run import Result, Target, run
from bench.rows import Row

TARGETS: tuple[Target, ...] = (*mesh.TARGETS, *apps.TARGETS, *data.TARGETS)


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    inputs: int = 100_000
    """Of each decoder."""


FULL = Sizes()
SMOKE = Sizes(200)

ROOT = Path(__file__).parents[2]
OK = " ok "
"""The end of the line of a target that has not failed."""

ELSEWHERE = {
    "services/apps/__main__.py": "makes a number of a hash of its own",
    "services/apps/core/lockstep_run.py": "its own stamp in a snapshot whose lengths were checked",
    "services/apps/event_runner.py": "states of the size that `Asynchronous` has checked",
    "services/apps/host/event_host.py": "states of the size that the lockstep has checked",
    "services/apps/host/host.py": "makes a number of a hash of its own",
    "sim/rehearsal/examine_sync.py": "states that it has packed itself",
    "services/apps/runner.py": "states of the size that the lockstep has checked",
    "services/apps/persistence/slots.py": "its own file: tests/services/apps/persistence/test_files.py",
    "services/balancer/bridge/link.py": "datagrams between the loop and its own second process",
    "services/balancer/core/devices/mailbox.py": "1 or 2 bytes: tests/services/balancer/core/slack/test_slack_tasks.py",
    "services/mesh/__main__.py": "makes a number of random bytes of its own",
    "services/mesh/core/link/calls.py": "a Bluetooth address that the configuration has checked",
    "services/mesh/links/sim.py": "simulated links only",
    "sim/control/app_requests_server.py": "a simulation's own socket: tests/sim/control/test_orders.py",
    "sim/processes/run.py": "makes a number of random bytes of its own",
    "laptop/cli/measure/experiments.py": "what another command of the same program prints",
    "laptop/cli/robots/body/pad.py": "events of 8 bytes from the kernel: tests/laptop/cli/test_pad.py",
    "laptop/cli/runs/import_csv.py": "makes a number of a hash of its own",
    "laptop/fleet/release/release.py": "the project's own description of what robots carry",
    "laptop/runs/results.py": "what the runner itself wrote about a run",
    "laptop/view/layouts.py": "the page's own file: tests/laptop/view/test_layouts.py",
    "swarm/onboard/buses/samples.py": "shows frames of lockstep: tests/swarm/onboard/test_z_sub.py",
    "swarm/recording/core/foxglove.py": "a schema of its own",
    "swarm/recording/core/writer.py": "checkpoints of its own file: tests/swarm/recording/test_long_recordings.py",
    "services/mesh/core/overlays/flood_store.py": "the bytes of a hash of its own",
    "swarm/core/snapshot_fields.py": "private fields that this robot has packed itself, in a snapshot with a checksum",
    "swarm/core/state.py": "states of the size that the lockstep has checked: tests/swarm/core/test_state.py",
    "swarm/core/lockstep/stopping.py": "two bytes of a state of the size that the lockstep has checked",
    "swarm/messages/json_input.py": "any JSON: tests/swarm/messages/test_json_input.py",
    "sim/control/app_requests.py": "a simulation's own socket: tests/sim/control/test_orders.py",
    "swarm/recording/journal.py": "its own file: tests/swarm/recording/test_journal.py",
    "swarm/config/toml_input.py": "any TOML: tests/swarm/messages/test_json_input.py",
    "swarm/bus/zenoh_config.py": "a configuration of its own",
    "laptop/view/chromium.py": "its own browser",
}
"""Modules that take bytes apart and are not in the table, and why."""

_MEANS = frozenset(("unpack", "unpack_from", "iter_unpack", "from_bytes", "fromhex", "unpackb", "Unpacker"))
_LOADERS = frozenset(("json.load", "json.loads", "tomllib.load", "tomllib.loads", "pickle.loads", "marshal.loads"))


def taking_apart() -> set[str]:
    """The modules of the product that use a means to take bytes apart: struct, int.from_bytes, msgpack, JSON, TOML."""
    found = set()
    for path in (path for folder in ("swarm", "services", "sim", "laptop") for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and (node.attr in _MEANS or ast.unparse(node) in _LOADERS):
                found.add(path.relative_to(ROOT).as_posix())
                break
    return found


def rows(sizes: Sizes) -> Iterator[Row]:
    """Feed all of them; yields rows as they are there."""
    # In a process of its own, whose memory is limited.
    command = [sys.executable, "-m", "bench.decoders.decoders", "--inputs", str(sizes.inputs)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    for line in done.stdout.splitlines():
        if not line.endswith(OK):
            sys.stderr.write(f"{line}\n")
    yield Row(f"decoders that failed, of {len(TARGETS)}", failed(done.stdout, done.returncode), "", 1, 0.0)


def failed(printed: str, code: int) -> int:
    """How many targets have no line that says they are well. A process that ends by another code than 0 has failed in
    one at least: it may have ended before, or behind, its last line."""
    well = sum(line.endswith(OK) for line in printed.splitlines())
    return max(len(TARGETS) - well, int(code != 0))


def told(result: Result) -> str:
    """A line about a target, and one for each failure."""
    verdict = " FAILED " if result.failures else OK
    rate = result.inputs / max(result.seconds, 1e-9)
    line = f"{result.name:<42} {result.inputs:>9} inputs {result.refused:>9} refused {rate:>8.0f} /s {verdict}"
    return "\n".join([line, *(f"    {failure}" for failure in result.failures)])


def chosen(names: Sequence[str]) -> list[Target]:
    """The targets whose names have one of these in them; all without any."""
    return [target for target in TARGETS if not names or any(name in target.name for name in names)]


def main() -> int:
    """Feed the chosen targets; 1 where one has failed."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.decoders.decoders", description="Feeds decoders with random inputs."
    )
    parser.add_argument("--inputs", type=int, default=FULL.inputs, help=f"for each decoder (default {FULL.inputs})")
    parser.add_argument("--seed", type=int, default=1, help="the same seed gives the same inputs (default 1)")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="decoders with this in their name")
    options = parser.parse_args()
    failed = False
    for target in chosen(options.only):
        result = run(target, options.inputs, options.seed)
        failed = failed or bool(result.failures)
        print(told(result), flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
