"""The firmware's file as `swarm flash` reads it, beside avr-objcopy."""

import subprocess
from pathlib import Path

import pytest
from firmware_layout import CONSTANTS, FIRMWARE

from services.balancer.core.flashing import image

pytest_plugins = ["firmware_fixtures"]


def test_the_file_is_read_as_avr_objcopy_does(built: Path, tmp_path: Path) -> None:
    found = image.read((built / "balboa.hex").read_text())
    command = ["avr-objcopy", "-I", "ihex", "-O", "binary", str(built / "balboa.hex"), str(tmp_path / "binary")]
    subprocess.run(command, check=True)
    binary = (tmp_path / "binary").read_bytes()
    assert found.data.rstrip(b"\xff") == binary.rstrip(b"\xff")


def test_its_mark_says_what_it_is(built: Path) -> None:
    found = image.read((built / "balboa.hex").read_text())
    assert (found.layout, found.revision) == (CONSTANTS["LAYOUT_VERSION"], CONSTANTS["REVISION_NUMBER"])


def test_the_file_that_robots_get_is_made_of_these_sources(built: Path) -> None:
    done = subprocess.run(["avr-g++", "-dumpversion"], capture_output=True, text=True, check=True)
    if done.stdout.strip() != "5.4.0":
        pytest.skip(f"avr-g++ {done.stdout.strip()} compiles otherwise than 5.4.0, which has made that file")
    assert (FIRMWARE / "balboa.hex").read_text() == (built / "balboa.hex").read_text(), "make -C firmware release"
