"""Builds what the tests run, where the tools for it are: firmware, GPL-3 bench, the pure parts for this machine.

Results are kept in pytest's cache under a hash of all sources, so that an unchanged firmware is built once.
"""

import fcntl
import hashlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from firmware_layout import FIRMWARE

HERE = Path(__file__).parent
APT = "apt install make gcc g++ gcc-avr binutils-avr avr-libc libsimavr-dev libelf-dev"

_COMMANDS_AVR = ("make", "gcc", "avr-g++", "avr-objcopy", "avr-size")
_HEADERS_AVR = ("/usr/include/simavr/sim_avr.h", "/usr/lib/avr/include/avr/io.h", "/usr/include/libelf.h")
_COMMANDS_HOST = ("g++",)


def require(commands: tuple[str, ...], headers: tuple[str, ...] = ()) -> None:
    """Skip with a message that says what to install; in continuous integration nothing may be missing."""
    missing = [name for name in commands if shutil.which(name) is None]
    missing += [name for name in headers if not Path(name).exists()]
    if not missing:
        return
    message = f"missing {', '.join(missing)}: {APT}"
    if os.environ.get("CI") == "true":
        pytest.fail(message)
    pytest.skip(message)


def require_avr() -> None:
    require(_COMMANDS_AVR, _HEADERS_AVR)


def require_host() -> None:
    require(_COMMANDS_HOST)


def _digest() -> str:
    digest = hashlib.sha256()
    for folder in (FIRMWARE, HERE / "avr", HERE / "host"):
        for path in sorted(folder.iterdir()):
            if path.is_file():
                digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def _run(*command: str, cwd: Path = HERE) -> None:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.fail(f"{' '.join(command)}\n{done.stdout}{done.stderr}")


def build(cache: Path, what: str) -> Path:
    """`firmware` or `bench` (a directory to look for balboa.elf or libbench.so in) or `host` (libpure.so)."""
    digest = _digest()
    target = cache / f"{what}-{digest}"
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if target.exists():
            return target
        for old in cache.glob(f"{what}-*"):
            shutil.rmtree(old)
        half = cache / f"half-{what}"
        shutil.rmtree(half, ignore_errors=True)
        half.mkdir()
        _BUILDERS[what](half)
        half.rename(target)
    return target


def _build_firmware(into: Path) -> None:
    _run("make", "-j2", f"BUILD={into}", "all", "size", cwd=FIRMWARE)
    flags = ("-mmcu=atmega32u4", "-nostartfiles", "-Wl,--section-start=.text=0x7000")
    _run("avr-gcc", *flags, "-o", str(into / "caterina.elf"), str(HERE / "host" / "caterina.S"))
    _run("avr-objcopy", "-O", "binary", str(into / "caterina.elf"), str(into / "caterina.bin"))


def _build_bench(into: Path) -> None:
    _run("make", f"BUILD={into}", cwd=HERE / "avr")


def _build_host(into: Path) -> None:
    sources = [str(FIRMWARE / name) for name in PURE] + [str(HERE / "host" / "pure.cpp")]
    flags = ("-std=c++14", "-O1", "-g", "-Wall", "-Wextra", "-Wshadow", "-Werror", "-fshort-enums", "-fPIC", "-shared")
    # Undefined behaviour and array bounds end the test run with a message; no run-time library is needed for a trap.
    checks = ("-fsanitize=undefined,bounds", "-fsanitize-undefined-trap-on-error")
    _run("g++", *flags, *checks, f"-I{FIRMWARE}", "-o", str(into / "libpure.so"), *sources)


PURE = ("front.cpp", "slave.cpp", "reports.cpp", "mailbox.cpp", "location.cpp", "tlv.cpp", "tune.cpp")
"""Parts of the firmware that know no hardware."""

_BUILDERS = {"firmware": _build_firmware, "bench": _build_bench, "host": _build_host}
