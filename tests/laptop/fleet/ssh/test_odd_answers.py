"""A robot that answers what none of ours would is named; the others are told of as ever. It may have been captured."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.cli import halt as halt_ssh
from laptop.cli.robots import status
from laptop.fleet.core import collect, doctor
from laptop.fleet.core.checkup import ExaminedRobot
from laptop.fleet.release import versions
from laptop.fleet.ssh import everyone, remote
from laptop.fleet.ssh.ssh import Host, HostError, Ssh
from swarm.config import parse
from swarm.errors import LocalError, RemoteError
from swarm.messages import topics

CONFIG = parse(
    'network = "x"\n[mesh]\ninsecure = true\n[topology]\nshape = "line"\n'
    + "".join(f'[[robots]]\nname = "r{n}"\nlink = "tcp:127.0.0.1:{9000 + n}"\n' for n in range(2)),
    Path("swarm.toml"),
)

TOPICS = sorted(f"{service}/{topic}".replace("*", "x") for service, topic in topics())
NAMES = ["links", "peer", "state", "mode", "battery", "x", "y", "quality", "phase", "k", "layout", "revision", "reason"]
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(), max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(NAMES), inner, max_size=4),
    max_leaves=8,
)


def tell(host: Host, text: str) -> None:
    pass


@given(st.lists(st.tuples(st.sampled_from(TOPICS), VALUES), max_size=6), st.text(st.characters(), max_size=20))
def test_status_shows_a_robot_whatever_it_says_beside_one_that_is_well(
    samples: list[tuple[str, Any]], runs: str
) -> None:
    lines = "".join(json.dumps({"key": f"swarm/r0/{topic}", "value": value}) + "\n" for topic, value in samples)
    rows: dict[str, status.StatusRow] = {}

    async def job(host: Host, _: everyone.ReportProgress) -> str:
        odd = f"== release\nx\n== units\n{runs}\n== runs\n{runs}\n== bus\n{lines}"
        rows[host.robot] = status.parse(host.robot, odd if host.robot == "r0" else "== release\n/opt/1-a\n")
        return ""

    outcomes = asyncio.run(everyone.each([Host("r0", "r0"), Host("r1", "r1")], job, 60.0, tell))
    assert outcomes[1].ok
    assert len(status.table(outcomes, rows, 1e9)) == 3
    assert outcomes[0].ok or "cannot be understood" in outcomes[0].text


def test_status_names_the_topics_whose_messages_it_leaves_out() -> None:
    said = '== release\n1-a\n== bus\n{"key": "swarm/r0/mesh/links", "value": {"links": 5}}\n'
    row = status.parse("r0", said)
    assert row.links == {}
    assert row.misunderstood == ["mesh/links"]
    table = status.table([everyone.RobotOutcome("r0", True, "", 1.0)], {"r0": row}, 1e9)
    assert "not understood: mesh/links" in table[1]


@given(st.sampled_from(TOPICS), VALUES, VALUES, VALUES)
def test_doctor_judges_a_robot_whatever_it_says(topic: str, value: Any, system: Any, key: Any) -> None:
    odd = ExaminedRobot("r0", CONFIG, system, {"bus": True, topic: value}, key=key)
    report = doctor.examine(odd)
    assert all(finding.state in ("ok", "warning", "bad", "skipped") for finding in report.values())
    doctor.compare([odd, ExaminedRobot("r1", CONFIG, None, None)])


@pytest.mark.parametrize("error", [TypeError("x"), KeyError("x"), RecursionError(), RemoteError("x"), UnicodeError()])
def test_a_job_that_cannot_understand_one_robot_is_done_on_the_others(error: Exception) -> None:
    async def job(host: Host, _: everyone.ReportProgress) -> str:
        if host.robot == "r0":
            raise error
        return "done"

    outcomes = asyncio.run(everyone.each([Host("r0", "r0"), Host("r1", "r1")], job, 60.0, tell))
    assert [outcome.ok for outcome in outcomes] == [False, True]
    assert "cannot be understood" in outcomes[0].text


def test_a_mistake_of_ours_ends_the_command() -> None:
    async def job(_: Host, __: everyone.ReportProgress) -> str:
        raise LocalError("wrong arguments")

    with pytest.raises(LocalError):
        asyncio.run(everyone.each([Host("r0", "r0")], job, 60.0, tell))


@pytest.mark.parametrize("text", ["[" * 100_000, '{"value": 1e999}', "1" * 5000, '{"robots": 5}', '{"robots": [[1]]}'])
def test_odd_json_of_a_robot_is_no_answer(text: str) -> None:
    assert versions.firmware(text) is None
    assert halt_ssh._rows(text) == {}


def test_a_size_of_5000_digits_is_no_list_of_recordings() -> None:
    with pytest.raises(RemoteError, match="cannot be read"):
        collect.parse_list("1" * 5000 + " consensus-1/r0.mcap\0")


def test_a_line_that_comes_in_parts_is_told_as_one_and_the_last_needs_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("laptop.fleet.ssh.ssh._CHUNK", 3)
    ssh, lines = Ssh(), []
    monkeypatch.setattr(ssh, "arguments", lambda host, command: ["printf", r"\n\nab\n123456789\r\n\n0123456789"])
    asyncio.run(ssh.run(Host("r0", "r0"), "", on_line=lines.append))
    assert lines == ["", "", "ab", "123456789\r", "", "0123456789"]


def test_of_a_program_that_prints_without_end_its_last_lines_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[str] = []
    monkeypatch.setattr(remote, "explained", lambda text, _: kept.append(text) or "it failed")
    ssh = Ssh()
    monkeypatch.setattr(ssh, "arguments", lambda host, command: ["sh", "-c", "seq -f 'line %g' 1000; exit 1"])
    with pytest.raises(HostError, match="it failed"):
        asyncio.run(remote.call(ssh, Host("r0", "r0"), "examine", {}))
    assert kept == ["\n".join(f"line {number}" for number in range(981, 1001))]


@pytest.mark.parametrize("on_line", [None, lambda line: None])
def test_an_answer_without_end_is_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_line: Any) -> None:
    monkeypatch.setattr("laptop.fleet.ssh.ssh._LONGEST", 1 << 20)
    ssh = Ssh()
    monkeypatch.setattr(ssh, "arguments", lambda host, command: ["sh", "-c", "exec cat /dev/zero"])
    with pytest.raises(HostError, match="more than 1 MiB"):
        asyncio.run(ssh.run(Host("r0", "r0"), "", on_line=on_line))
