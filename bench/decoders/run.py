"""Feeds one decoder after the other with random bytes, in a process that may take a bounded amount of memory more.

The inputs are mutations of good ones, reproducible by a seed. An input fails where the decoder raises another error
than its own, or needs more memory than its target allows: the address space of the process is limited to what it had
before, plus the target's room, so an allocation beyond it is a MemoryError at once. What stays allocated from input to
input counts, too.
"""

import gc
import random
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

MIB = 1024 * 1024

INTERESTING = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF,
               (1 << 63) - 1, 1 << 63, (1 << 64) - 2, (1 << 64) - 1)  # fmt: skip
"""Numbers at the ends of the ranges that fields have."""

LONGEST = 16 * 1024
"""Bytes of an input at most."""


@dataclass(frozen=True)
class Target:
    """One decoder, or a core with its decoders."""

    name: str
    modules: tuple[str, ...]
    """Those that take bytes apart here, as paths below the repository."""
    prepare: Callable[[random.Random], tuple[Sequence[bytes], Callable[[bytes], object]]]
    """Gives good inputs, and the function that takes one."""
    errors: tuple[type[Exception], ...] = ()
    """What the decoder may raise."""
    room: int = 4
    """MiB that it may take for one input, and for all that a core keeps."""


@dataclass
class Result:
    """What came of one target."""

    name: str
    inputs: int = 0
    refused: int = 0
    """Inputs that led to the decoder's own error."""
    seconds: float = 0.0
    failures: list[str] = field(default_factory=list)
    """The error and the input of each failure, the first ones."""


def mutated(golden: Sequence[bytes], rng: random.Random) -> bytes:
    """One of the good inputs with one to four changes; sometimes random bytes, sometimes as it is."""
    data = bytearray(golden[int(rng.random() * len(golden))])
    for _ in range(int(rng.random() * 5)):
        at = int(rng.random() * (len(data) + 1))
        kind = int(rng.random() * 10)
        if kind == 0:
            data[at : at + 1] = bytes((int(rng.random() * 256),))
        elif kind <= 4:
            number = INTERESTING[int(rng.random() * len(INTERESTING))]
            width = (1, 2, 4, 8)[int(rng.random() * 4)]
            order = "little" if rng.random() < 0.7 else "big"
            data[at : at + width] = (number & ((1 << 8 * width) - 1)).to_bytes(width, order)  # type: ignore[arg-type]
        elif kind == 5:
            del data[at : at + 1 + int(rng.random() * 8)]
        elif kind == 6:
            data[at:at] = rng.randbytes(1 + int(rng.random() * 8))
        elif kind == 7:
            data[at:at] = data[at : at + 20] * (1 + int(rng.random() * 3))
        elif kind == 8:
            other = golden[int(rng.random() * len(golden))]
            data[at:] = other[int(rng.random() * (len(other) + 1)) :]
        else:
            del data[at:]
    return bytes(data[:LONGEST])


def run(target: Target, inputs: int, seed: int, *, most_failures: int = 3) -> Result:
    """Feed a target; the same seed gives the same inputs."""
    rng = random.Random(f"{seed} {target.name}")
    result = Result(target.name)
    data = b""
    try:
        golden, feed = target.prepare(rng)
        for data in golden:  # caches and imports are no cost of an input
            _feed(feed, data, target.errors)
    except Exception as error:  # noqa: BLE001 - that is what is looked for
        result.failures.append(_failure(error, data))
        return result
    gc.collect()
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = (_address_space() + target.room * MIB, before[1])
    began = time.monotonic()
    while result.inputs < inputs and len(result.failures) < most_failures:
        data = b""
        resource.setrlimit(resource.RLIMIT_AS, limit)
        try:
            if result.failures:  # what the last one has left behind may be half changed
                golden, feed = target.prepare(rng)
            while result.inputs < inputs:
                data = mutated(golden, rng)
                result.inputs += 1
                result.refused += _feed(feed, data, target.errors)
        except Exception as error:  # noqa: BLE001 - that is what is looked for
            resource.setrlimit(resource.RLIMIT_AS, before)  # telling of it needs memory, too
            result.failures.append(_failure(error, data))
            if isinstance(error, MemoryError):
                break
        finally:
            resource.setrlimit(resource.RLIMIT_AS, before)
    result.seconds = time.monotonic() - began
    return result


def _failure(error: Exception, data: bytes) -> str:
    return f"{type(error).__name__}: {str(error)[:200]}; input {data.hex()[:2000]}"


def _feed(feed: Callable[[bytes], object], data: bytes, errors: tuple[type[Exception], ...]) -> bool:
    try:
        feed(data)
    except errors:
        return True
    return False


def _address_space() -> int:
    """Bytes of this process' address space."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()
