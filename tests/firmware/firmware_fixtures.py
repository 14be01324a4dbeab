"""Fixtures of the firmware's tests; test modules name this file in `pytest_plugins`."""

from collections.abc import Callable, Iterator
from pathlib import Path

import firmware_build
import pytest
from avr_bench import Bench
from firmware_pure import Pure


@pytest.fixture(scope="session")
def firmware_cache(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    cache = getattr(request.config, "cache", None)
    return tmp_path_factory.mktemp("firmware") if cache is None else cache.mkdir("firmware")


@pytest.fixture(scope="session")
def built(firmware_cache: Path) -> Path:
    """The directory with the firmware as built by its Makefile."""
    firmware_build.require_avr()
    return firmware_build.build(firmware_cache, "firmware")


@pytest.fixture(scope="session")
def libbench(firmware_cache: Path) -> Path:
    firmware_build.require_avr()
    return firmware_build.build(firmware_cache, "bench") / "libbench.so"


@pytest.fixture
def new_bench(built: Path, libbench: Path) -> Iterator[Callable[..., Bench]]:
    """Makes benches with the firmware; they are gone after the test."""
    made = []

    def make(**arguments: object) -> Bench:
        made.append(Bench(libbench, built / "balboa.elf", **arguments))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


@pytest.fixture
def bench(new_bench: Callable[..., Bench]) -> Bench:
    """A robot that was switched on 20 ms ago."""
    made = new_bench()
    made.run(0.02)
    return made


@pytest.fixture(scope="session")
def libpure(firmware_cache: Path) -> Path:
    firmware_build.require_host()
    return firmware_build.build(firmware_cache, "host") / "libpure.so"


@pytest.fixture
def pure(libpure: Path) -> Pure:
    """The firmware's parts without hardware, compiled for this machine; as after power-on."""
    return Pure(libpure)
