"""The firmware's file as `swarm flash` reads it, beside avr-objcopy."""

import subprocess
from pathlib import Path

from firmware_layout import CONSTANTS

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
