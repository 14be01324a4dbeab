"""The plan and the stream of `swarm fetch`, and its journal, without robots."""

import contextlib
import hashlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.fleet.core import collect
from laptop.fleet.core.collect import File, FileData, FileEnd, Stream, Wanted
from laptop.fleet.files.journal import JournalMark, entry
from swarm.errors import RemoteError


def test_a_list_is_read() -> None:
    names = ("12 led_sync-a1/r0.led_sync.mcap", "3 led_sync-a1/run.toml", "9 x-1/../../etc/passwd", "1 x-1/a b")
    text = "".join(f"{name}\0" for name in names)
    files, strange = collect.parse_list(text)
    assert files == [File("led_sync-a1/r0.led_sync.mcap", 12), File("led_sync-a1/run.toml", 3)]
    assert strange == ["x-1/../../etc/passwd", "x-1/a b"]
    assert [file.own("r0") for file in files] == ["led_sync-a1/r0.led_sync.mcap", "led_sync-a1/r0.run.toml"]
    assert [file.is_of("r0") for file in files] == [True, False]
    assert (files[0].run, files[0].app) == ("led_sync-a1", "led_sync")
    with pytest.raises(RemoteError, match="the list of its recordings cannot be read"):
        collect.parse_list("total 5\0")


@given(st.text(st.characters(exclude_characters="\0")))
def test_no_name_leads_out_of_the_folder(name: str) -> None:
    files, _ = collect.parse_list(f"1 {name}\0")
    for file in files:
        parts = file.own("r0").split("/")
        assert not {"", ".", ".."} & set(parts)
        assert not set(file.path) & set(" '\"$`;\\&|<>\n")


def test_only_the_wanted_runs_are_chosen() -> None:
    files = [File("consensus-1/r0.a", 1), File("consensus-2/r0.a", 1), File("goto-1/r0.a", 1)]
    assert collect.of_runs(files, []) == files
    assert collect.of_runs(files, ["consensus"]) == files[:2]
    assert collect.of_runs(files, ["goto-1", "consensus-2"]) == files[1:]


def test_what_is_here_is_not_asked_for() -> None:
    files = [File("a-1/r0.new", 10), File("a-1/r0.part", 10), File("a-1/r0.all", 10), File("a-1/r0.longer", 10)]
    wanted = collect.plan(files, {"a-1/r0.part": 4, "a-1/r0.all": 10, "a-1/r0.longer": 11})
    assert [each.offset for each in wanted] == [0, 4, 10, 0]
    assert wanted[1].line == b"4 10 a-1/r0.part\n"


@given(
    st.lists(st.tuples(st.binary(max_size=300), st.integers(0, 300), st.booleans()), max_size=5),
    st.lists(st.integers(1, 90)),
)
def test_a_stream_comes_apart_wherever_it_is_cut(files: list[tuple[bytes, int, bool]], cuts: list[int]) -> None:
    wanted, answer = [], b""
    for number, (data, offset, there) in enumerate(files):
        offset = min(offset, len(data))
        wanted.append(Wanted(File(f"a-1/{number}", len(data)), offset))
        digest = hashlib.sha256(data).hexdigest()
        answer += b"+\n" + data[offset:] + f"{digest}  -\n".encode() if there else b"-\n"
    stream, got, sums = Stream(wanted), dict.fromkeys(wanted, b""), dict[Wanted, str | None]()
    while answer:
        size = cuts.pop() if cuts else len(answer)
        for part in stream.receive(answer[:size]):
            if isinstance(part, FileData):
                got[part.wanted] += part.data
            else:
                sums[part.wanted] = part.sum
        answer = answer[size:]
    assert stream.finished
    for each, (data, _, there) in zip(wanted, files, strict=True):
        assert got[each] == (data[each.offset :] if there else b"")
        assert sums[each] == (hashlib.sha256(data).hexdigest() if there else None)


@given(st.lists(st.binary(max_size=200)))
def test_a_stream_takes_any_bytes(parts: list[bytes]) -> None:
    stream = Stream([Wanted(File("a-1/x", 40), 10), Wanted(File("a-1/y", 3), 0)])
    with contextlib.suppress(RemoteError):
        for part in parts:
            assert all(isinstance(found, FileData | FileEnd) for found in stream.receive(part))


def test_more_than_was_asked_for_is_refused() -> None:
    with pytest.raises(RemoteError, match="more than was asked for"):
        list(Stream([Wanted(File("a-1/x", 1), 0)]).receive(b"-\n+"))


# -- journal -----------------------------------------------------------------------------------------------------


def test_an_entry_becomes_a_line() -> None:
    fields = {
        "__CURSOR": "s=1;i=2", "__REALTIME_TIMESTAMP": "1700000000123456", "MESSAGE": "ready\nor not", "PRIORITY": "4",
        "_SYSTEMD_UNIT": "swarm-mesh.service", "_PID": "12",
    }  # fmt: skip
    line = "2023-11-14T22:13:20.123456Z swarm-mesh[12] warning: ready\\nor not"
    assert entry(json.dumps(fields)) == ("s=1;i=2", line)
    fields |= {"MESSAGE": [104, 255], "UNIT": "swarm-dwm.service"}
    assert entry(json.dumps(fields)) == ("s=1;i=2", "2023-11-14T22:13:20.123456Z swarm-dwm[12] warning: h\ufffd")
    assert entry(json.dumps(fields | {"MESSAGE": None})) == (
        "s=1;i=2",
        "2023-11-14T22:13:20.123456Z swarm-dwm[12] warning: (left out)",
    )


@given(st.one_of(st.text(), st.dictionaries(st.sampled_from(
    ["__CURSOR", "__REALTIME_TIMESTAMP", "MESSAGE", "PRIORITY", "_PID"]), st.one_of(
        st.none(), st.text(), st.integers(), st.lists(st.integers())))))  # fmt: skip
def test_any_line_is_an_entry_or_none(value: object) -> None:
    found = entry(value if isinstance(value, str) else json.dumps(value))
    assert found is None or "\n" not in found[1]


@pytest.mark.parametrize("text", ["12", "34567", "8", "-1", 3, None, ["3"]])
def test_a_priority_that_is_none_is_taken_for_info(text: object) -> None:
    found = entry(json.dumps({"__CURSOR": "s=1", "__REALTIME_TIMESTAMP": "1", "MESSAGE": "x", "PRIORITY": text}))
    assert found is not None
    assert found[1].endswith("error: x" if text == 3 else "info: x")


def test_a_line_that_nests_deeply_is_no_entry() -> None:
    assert entry("[" * 100_000) is None


def test_a_size_of_thousands_of_digits_is_no_list() -> None:
    with pytest.raises(RemoteError, match="cannot be read"):
        collect.parse_list(f"{'9' * 5000} run-1/r0.mcap\0")


@given(st.integers(0, 10**20 - 1), st.from_regex(r"[a-z0-9=;]+", fullmatch=True))
def test_a_mark_is_read_as_written(size: int, cursor: str) -> None:
    assert JournalMark.of(JournalMark(size, cursor).text) == JournalMark(size, cursor)


@pytest.mark.parametrize("text", ["", "x", "5", "-5 s=1", "5 ", "\u0663 s=1"])
def test_a_mark_that_is_none_is_the_beginning(text: str) -> None:
    assert JournalMark.of(text) == JournalMark()
