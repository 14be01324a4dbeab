"""What provisioning decides: edits of files that done twice change nothing, and judgements of a robot's facts."""

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.fleet.core import packages, settings, steps, texts
from laptop.fleet.core.wish import DesiredRobot, Packages
from laptop.fleet.release import bundle
from swarm.errors import LocalError

WISH = DesiredRobot("r0", "zero2w", "r0", 0.0)
lines = st.lists(st.sampled_from([texts.BEGIN, texts.END, "[pi4]", "dtparam=i2c_arm=off", "", "# x"]), max_size=8)


@given(lines, st.booleans())
def test_a_block_is_there_once_and_last_and_others_lines_stay(before: list[str], end: bool) -> None:
    text = "\n".join(before) + ("\n" if end else "")
    once = texts.with_block(text, ["[all]", "dtparam=i2c_arm=on"])
    assert texts.with_block(once, ["[all]", "dtparam=i2c_arm=on"]) == once
    assert once.endswith(f"{texts.BEGIN}\n[all]\ndtparam=i2c_arm=on\n{texts.END}\n")
    assert once.count("dtparam=i2c_arm=on\n") == 1
    if not {texts.BEGIN, texts.END} & set(before):
        assert once.startswith("\n".join(before))


words = st.lists(st.sampled_from(["a=1", "a=2", "b", "console=serial0,115200", "console=tty1"]), max_size=8)


@given(words)
def test_words_are_there_once_and_those_to_go_are_gone(before: list[str]) -> None:
    add, remove = ["a=1", "c"], ["a=.*", "console=serial0.*"]
    once = texts.with_words(" ".join(before), add, remove)
    assert texts.with_words(once, add, remove) == once
    assert once.count("\n") == 1
    found = once.split()
    assert [found.count(word) for word in ("a=1", "c", "a=2", "console=serial0,115200")] == [1, 1, 0, 0]
    assert ("console=tty1" in found) == ("console=tty1" in before)


ini = st.lists(
    st.sampled_from(
        ["[Policy]", "[General]", "#AutoEnable=true", "AutoEnable=false", " AutoEnable = x", "Name = y", ""]
    ),
    max_size=10,
).map("\n".join)


@given(ini)
def test_a_setting_is_set_in_its_section_alone(before: str) -> None:
    once = texts.with_setting(before, "Policy", "AutoEnable", "true")
    assert texts.with_setting(once, "Policy", "AutoEnable", "true") == once
    section = once.split("[Policy]\n", 1)[1].split("[", 1)[0]
    assert section.count("AutoEnable = true\n") == 1
    assert before.count("Name = y") == once.count("Name = y")


@given(st.lists(st.sampled_from(["127.0.0.1\tlocalhost", "127.0.1.1\told", "::1 localhost", "127.0.1.10 x"])))
def test_a_host_has_one_name(before: list[str]) -> None:
    once = texts.with_host("\n".join(before), "r0")
    assert texts.with_host(once, "r0") == once
    assert once.count("127.0.1.1\t") == 1
    assert once.count("127.0.1.10 x") == before.count("127.0.1.10 x")


@pytest.mark.parametrize(
    ("release", "version"), [("6.12.25+rpt-rpi-v8", (6, 12)), ("6.1.0-37-arm64", (6, 1)), ("?", (0, 0)), ("", (0, 0))]
)
def test_the_version_is_read_from_a_kernels_name(release: str, version: tuple[int, int]) -> None:
    assert texts.kernel_version(release) == version


def facts(**other: Any) -> dict[str, Any]:
    """Of a robot that is as it should be, but for `other`."""
    return {
        "model": "Raspberry Pi Zero 2 W Rev 1.0", "architecture": "arm64", "python": "3.11", "kernel": "6.12.1",
        "os": {"ID": "debian", "VERSION_CODENAME": "bookworm"}, "kernels": ["6.12.1"], "time": 0.0, "current": "",
        "free": {"/": 5_000_000_000, "/boot/firmware": 100_000_000}, "there": [], "broken": "",
        "packages": dict.fromkeys(WISH.packages, "1"), "links": dict.fromkeys(packages.FIRMWARE, ""),
        "files": {}, "modes": {}, "blocked": [], "units": {"bluetooth.service": {}}, "hostname": "r0",
    } | other  # fmt: skip


def test_the_radios_firmware_comes_with_its_package() -> None:
    bare = facts(links=dict.fromkeys(packages.FIRMWARE))
    assert packages.radio(bare, WISH).state == "failed"
    offered = replace(WISH, bundle=Packages(names=("bluez-firmware",)))
    assert packages.radio(bare, offered).state == "change"
    assert packages.wanted_packages(bare, offered) == ["bluez-firmware"]
    linked = packages.radio(bare | {"there": [packages.SYNAPTICS + "/SYN43430A1.hcd"]}, WISH)
    assert [each["to"] for each in linked.changes] == ["../synaptics/SYN43430A1.hcd"]
    assert linked.reboot
    assert packages.radio(bare, replace(WISH, board="pi4")).state == "ok"


def test_an_older_kernel_is_replaced_then_booted() -> None:
    old = facts(kernel="6.1.21", kernels=["6.1.21"])
    assert packages.kernel(old, WISH).state == "failed"
    assert packages.kernel(old, replace(WISH, bluetooth=False)).state == "ok"
    offered = replace(WISH, bundle=Packages(names=("linux-image-rpi-v8",)))
    assert packages.wanted_packages(old, offered) == ["linux-image-rpi-v8"]
    assert packages.kernel(old, offered).state == "change"
    installed = facts(kernel="6.1.21", kernels=["6.1.21", "6.12.9"])
    assert packages.wanted_packages(installed, offered) == []
    assert packages.kernel(installed, WISH).text == "boot 6.12.9, which is installed (6.1.21 runs)"


def test_a_full_disk_and_a_wrong_clock() -> None:
    judge = {step.name: step.judge for step in steps.FIRST}
    assert judge["disk"](facts(free={"/": 1_000_000}), WISH).text.startswith("/ has 1 MB left, 400 are needed")
    much = replace(WISH, bundle=Packages({"a.deb": 1_000_000_000}))
    assert judge["disk"](facts(), much).state == "failed"
    assert judge["clock"](facts(time=-100.0), WISH).changes[0]["words"] == ["date", "--utc", "--set", "@0"]
    assert judge["system"](facts(python="3.9"), WISH).text.startswith("its python3 is 3.9, 3.11 or later is needed")


def test_the_uart_is_left_alone_where_the_module_hangs_elsewhere() -> None:
    text = "console=serial0,115200 root=x\n"
    serial = facts(files={"/boot/firmware/cmdline.txt": text})
    assert "console" in settings.cmdline(serial, WISH).changes[0]["text"]
    assert "console" not in settings.cmdline(serial, replace(WISH, uart="/dev/serial0")).changes[0]["text"]


def test_every_step_has_a_name_of_its_own() -> None:
    names = [step.name for step in (*steps.FIRST, *steps.THEN)]
    assert len(set(names)) == len(names)


STANZA = "Package: a\nVersion: 1\nDescription: x\n more: of it\nFilename: pool/a.deb\nSize: 3\nSHA256: {}\n"


def test_an_index_names_files_and_what_they_must_be() -> None:
    digest = "ab" * 32
    (package,) = bundle.entries(bundle.index_of([STANZA.format(digest), STANZA.format("cd" * 32)], {digest: "a_1.deb"}))
    assert package == bundle.Package("a", "1", "a_1.deb", 3, digest)


@pytest.mark.parametrize("file", ["../a.deb", "/a.deb", "a", "x/../../a.deb", ".deb", "a b.deb"])
def test_an_index_cannot_name_files_elsewhere(file: str) -> None:
    with pytest.raises(LocalError, match="odd entry"):
        bundle.entries(STANZA.format("ab" * 32).replace("pool/a.deb", file))


@given(st.text(alphabet="Pa:ckge\nFilnm 0123456789S", max_size=200))
def test_any_index_is_read_or_refused(text: str) -> None:
    try:
        bundle.entries(text)
    except LocalError:
        return


@pytest.mark.parametrize(("board", "core"), [("zero2w", 400), ("pi4", 500)])
@pytest.mark.parametrize("uart", [None, "/dev/serial0"])
@pytest.mark.parametrize("clock", [100, 400])
def test_the_core_clock_of_the_i2c_bus_is_fixed_for_every_wiring(
    board: str, core: int, uart: str | None, clock: int
) -> None:
    wish = replace(WISH, board=board, uart=uart, i2c_clock=clock)
    facts = {"files": {"/boot/firmware/config.txt": "# mine\n"}, "modes": {}}
    verdict = settings.boot(facts, wish)
    text = verdict.changes[0]["text"].splitlines()
    assert text[0] == "# mine"
    assert {f"dtparam=i2c_arm_baudrate={clock}000", f"core_freq={core}", f"core_freq_min={core}"} <= set(text)
    assert ("enable_uart=1" in text) == (uart is not None)
