"""What the lab's build and the radio's pipe decide without a machine."""

import importlib.util
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab import __main__ as command
from lab.vm import build, kernel, network, recipe
from lab.vm.network import Wire
from swarm.errors import LocalError


def guest(name: str) -> object:
    """A module of those that run inside, with Debian's Python alone."""
    sys.path.insert(0, str(recipe.GUEST))
    try:
        spec = importlib.util.spec_from_file_location(f"guest_{name}", recipe.GUEST / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(recipe.GUEST))
    return module


radio, agent = guest("radio"), guest("agent")


def test_equal_content_has_an_equal_name_and_other_content_another(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    first = recipe.sources(tmp_path)
    assert recipe.digest(first, "x") == recipe.digest(recipe.sources(tmp_path), "x")
    (tmp_path / "a").write_text("2")
    assert recipe.digest(first) != recipe.digest(recipe.sources(tmp_path))
    assert recipe.digest("ab", "c") != recipe.digest("a", "bc")


def test_a_host_that_cannot_is_told_what_it_lacks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(build.shutil, "which", lambda tool: None if tool in ("flex", "mke2fs") else tool)
    monkeypatch.setattr(build.os, "geteuid", lambda: 0)
    monkeypatch.setattr(build.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(build, "TUN", tmp_path)
    assert build.missing() == "apt-get install e2fsprogs flex"
    monkeypatch.setattr(build, "TUN", tmp_path / "none")
    assert "modprobe tun" in build.missing()
    monkeypatch.setattr(build.platform, "machine", lambda: "aarch64")
    assert "x86_64, this is aarch64" in build.missing()
    monkeypatch.setattr(build.os, "geteuid", lambda: 1000)
    assert "root" in build.missing()


def test_where_it_cannot_run_the_exit_code_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(build, "missing", lambda: "apt-get install flex")
    assert command.main() == command.UNAVAILABLE == 69
    assert capsys.readouterr().err == "lab: this host cannot run the lab: apt-get install flex\n"


def test_an_option_that_the_kernel_has_dropped_is_named(tmp_path: Path) -> None:
    wanted = [line for line in kernel.CONFIG.read_text().splitlines() if line.startswith("CONFIG_")]
    made = tmp_path / ".config"
    made.write_text("\n".join(wanted))
    kernel._check(made)
    made.write_text("\n".join(line for line in wanted if "BT_RFCOMM" not in line))
    with pytest.raises(LocalError, match="no CONFIG_BT_RFCOMM=y"):
        kernel._check(made)


def test_no_two_machines_have_the_same_addresses() -> None:
    one, other = Wire(), Wire()
    assert len({one.host, one.machine, other.host, other.machine}) == 4
    assert one.interface != other.interface
    one.close()
    again = Wire()
    assert again.machine != other.machine
    again.close()
    other.close()


def test_no_machine_takes_an_interface_that_a_killed_one_has_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(10):
        (tmp_path / f"lab{number}").mkdir()
    monkeypatch.setattr(network, "INTERFACES", tmp_path)
    wire = Wire()
    assert not (tmp_path / wire.interface).exists()
    wire.close()


packet = st.one_of(
    st.builds(lambda p: b"\x04\x0e" + bytes([len(p)]) + p, st.binary(max_size=255)),
    st.builds(lambda p: b"\x02\x01\x20" + len(p).to_bytes(2, "little") + p, st.binary(max_size=600)),
    st.builds(lambda p: b"\x01\x03\x0c" + bytes([len(p)]) + p, st.binary(max_size=255)),
)


@given(st.lists(packet), st.integers(0, 40))
def test_packets_of_a_serial_line_are_found_again_however_it_is_cut(sent: list[bytes], size: int) -> None:
    line, rest, found = b"".join(sent), b"", []
    for at in range(0, len(line), size + 1):
        some, rest = radio.packets(rest + line[at : at + size + 1])
        found += some
    assert (found, rest) == (sent, b"")


def test_a_command_that_hangs_is_ended_and_one_that_leaves_a_daemon_is_not_waited_for() -> None:
    assert agent.run("echo one; exit 4", 5.0) == (4, "one\n")
    assert agent.run("sleep 30", 0.05) == (124, "")
    code, said = agent.run("sleep 30 & echo $!", 5.0)
    assert code == 0
    agent.os.kill(int(said), agent.signal.SIGKILL)
