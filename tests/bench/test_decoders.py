"""Every decoder takes random inputs in bounded memory, and raises its own error only; `bench/decoders` lists them.

3000 inputs each in every run of the tests, 100 000 among the slow ones; `./run bench decoders` for more.
"""

import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from bench.decoders.data import recording
from bench.decoders.decoders import ELSEWHERE, ROOT, TARGETS, failed, taking_apart, told
from bench.decoders.run import MIB, Result, Target, mutated, run
from swarm.recording.reader import RecordingReader
from swarm.recording.survey import survey

HALVES = {"mesh": [each.name for each in TARGETS if each.name.startswith("mesh: ")]}
HALVES["others"] = [each.name for each in TARGETS if each.name not in HALVES["mesh"]]


def feed(names: list[str], inputs: int) -> None:
    only = [word for name in names for word in ("--only", name)]
    command = [sys.executable, "-m", "bench.decoders.decoders", "--inputs", str(inputs), *only]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" ok ") == len(names)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("half", HALVES)
def test_every_decoder_takes_three_thousand_inputs(half: str) -> None:
    feed(HALVES[half], 3000)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("half", HALVES)
def test_every_decoder_takes_a_hundred_thousand_inputs(half: str) -> None:
    feed(HALVES[half], 100_000)


def test_every_module_that_takes_bytes_apart_is_in_the_table_or_says_why_not() -> None:
    covered = {module for target in TARGETS for module in target.modules}
    found = taking_apart()
    assert found - covered - ELSEWHERE.keys() == set(), "add a target to bench/decoders"
    assert ELSEWHERE.keys() - found == set(), "it takes no bytes apart any more"
    assert ELSEWHERE.keys() & covered == set()
    assert all((ROOT / module).is_file() for module in covered)


def test_a_streams_unpacker_is_a_means_to_take_bytes_apart() -> None:
    assert "swarm/onboard/lookout.py" in taking_apart()


def test_the_golden_recording_has_all_that_a_file_of_ours_can_have(tmp_path: Path) -> None:
    path = tmp_path / "golden.mcap"
    path.write_bytes(recording())
    reader = RecordingReader(path)
    assert len(list(reader.samples())) == 10
    assert reader.finished
    assert reader.damage == []
    with path.open("rb") as file:
        known = survey(file.fileno())
    assert len(known.checkpoints) == 2
    assert known.chunks == 5


FAULTY = """
from bench.decoders.run import Target, run

def greedy(data):
    return bytes(int.from_bytes(data[:4], "little"))

print(run(Target("greedy", (), lambda rng: ([bytes(4)], greedy), room=4), 10_000, 1).failures)
"""


def test_an_allocation_of_more_than_the_room_is_a_failure() -> None:
    done = subprocess.run([sys.executable, "-c", FAULTY], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "MemoryError" in done.stdout


def test_an_error_that_is_not_the_decoders_own_is_a_failure() -> None:
    def wrong(data: bytes) -> None:
        if len(data) > 4:
            raise KeyError("too long")

    result = run(Target("wrong", (), lambda rng: ([bytes(4)], wrong), (ValueError,), room=64), 1000, 1)
    assert result.failures[0].startswith("KeyError: 'too long'; input ")


def test_an_error_at_a_good_input_is_a_failure() -> None:
    def wrong(data: bytes) -> None:
        raise KeyError("never")

    result = run(Target("wrong", (), lambda rng: ([bytes(4)], wrong), (ValueError,)), 10, 1)
    assert result.failures == ["KeyError: 'never'; input 00000000"]


def test_an_error_while_the_next_inputs_are_prepared_is_a_failure() -> None:
    prepared = []

    def prepare(rng: random.Random) -> tuple[list[bytes], Callable[[bytes], object]]:
        prepared.append(1)
        if len(prepared) > 1:
            raise MemoryError("no room")
        return [bytes(4)], lambda data: 1 // (len(data) == 4)

    result = run(Target("wrong", (), prepare, room=64), 1000, 1)
    assert [failure.partition(";")[0] for failure in result.failures] == [
        "ZeroDivisionError: integer division or modulo by zero",
        "MemoryError: no room",
    ]


@pytest.mark.parametrize(("lacking", "code", "found"), [(0, 0, 0), (0, 1, 1), (0, -9, 1), (3, 0, 3), (3, 1, 3)])
def test_a_decoder_that_no_line_calls_well_has_failed(lacking: int, code: int, found: int) -> None:
    """The first of `lacking` has a line that tells of its failure; the others have none, as after a crash."""
    results = [Result(target.name) for target in TARGETS[lacking:]]
    results += [Result(target.name, failures=["KeyError: 'x'"]) for target in TARGETS[: min(lacking, 1)]]
    assert failed("\n".join(map(told, results)), code) == found


def test_the_same_seed_gives_the_same_inputs() -> None:
    golden = [b"abcdef", bytes(40)]
    first, second = ([mutated(golden, rng) for _ in range(500)] for rng in (random.Random(7), random.Random(7)))
    assert first == second
    assert len(set(first)) > 300
    assert max(map(len, first)) < MIB
