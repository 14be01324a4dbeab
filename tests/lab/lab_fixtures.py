"""Machines for the tests of the lab; each test's machines end with it."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lab.vm.build import Image, image
from lab.vm.machine import Machine


@pytest.fixture(scope="session")
def lab_image() -> Image:
    return image()


@pytest.fixture
def machine(lab_image: Image, tmp_path: Path) -> Iterator[Callable[..., Machine]]:
    """Make machines by name, with the arguments of `Machine`; not yet switched on."""
    made: list[Machine] = []

    def make(name: str, **options: object) -> Machine:
        made.append(Machine(lab_image, tmp_path / name, name, **options))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for each in made:
        each.kill()
