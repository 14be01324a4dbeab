"""Keys are built and taken apart the same way, and nothing from outside gets past the parser."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.errors import BusError, LocalError, PayloadError
from swarm.messages.keys import MAX_KEY_LENGTH, Key, is_name, key, parse, whose_token
from swarm.process import paths

CHUNK = st.from_regex(r"[A-Za-z0-9_.:-]{1,12}", fullmatch=True)


@given(CHUNK, CHUNK, st.lists(CHUNK, min_size=1, max_size=6))
def test_a_key_is_parsed_as_it_was_made(robot: str, service: str, topic: list[str]) -> None:
    text = key(robot, service, *topic)
    assert parse(text) == Key(robot, service, "/".join(topic))
    assert str(parse(text)) == text


def test_services_and_topics_may_have_several_chunks() -> None:
    assert key("r0", "app/consensus", "set/gain") == "swarm/r0/app/consensus/set/gain"
    assert parse("swarm/r0/app/consensus/state") == Key("r0", "app", "consensus/state")
    assert key("*", "**", "status") == "swarm/*/**/status"


@pytest.mark.parametrize("part", ["", "a b", "a//b", "/a", "a/", "ä", "a?b", "a#b", "$*", "a*", "a\n", "***"])
def test_odd_parts_are_refused(part: str) -> None:
    with pytest.raises(LocalError):
        key("r0", "mesh", part)


@pytest.mark.parametrize(
    "text",
    ["", "swarm", "swarm/stop", "swarm/r0/mesh", "other/r0/mesh/links", "/swarm/r0/mesh/links", "swarm/r0/mesh/",
     "swarm/*/mesh/links", "swarm/r0/**/links", "swarm/r0/mesh/a b", "swarm//mesh/links", "swarm/r0/mesh/ü",
     "swarm/r0/mesh/links\n", "swarm/r0/mesh/" + "x" * MAX_KEY_LENGTH],
)  # fmt: skip
def test_foreign_keys_are_refused(text: str) -> None:
    with pytest.raises(PayloadError) as caught:
        parse(text)
    assert len(str(caught.value)) < 400


def test_a_token_names_its_service() -> None:
    assert whose_token("swarm/r0/mesh/alive") == ("r0", "mesh")
    assert whose_token("swarm/r0/app/consensus/alive") == ("r0", "app/consensus")
    for text in ("swarm/r0/mesh/links", "swarm/r0/alive", "swarm/r0/alive/mesh", "swarm/r0/mesh/*/alive"):
        with pytest.raises(PayloadError):
            whose_token(text)


def test_a_key_of_the_greatest_length_is_parsed() -> None:
    text = "swarm/r0/mesh/" + "x" * (MAX_KEY_LENGTH - 14)
    assert str(parse(text)) == text


@given(st.text() | st.text(st.sampled_from("swarm/r0*$#?\n.é\ud800"), max_size=300))
def test_any_text_is_parsed_or_refused(text: str) -> None:
    try:
        parsed = parse(text)
    except PayloadError:
        return
    assert str(parsed) == text
    assert key(*parsed) == text


@given(st.text(max_size=20))
def test_a_name_makes_a_valid_key(text: str) -> None:
    if is_name(text):
        assert parse(key(text, "app/" + text, "state")).robot == text


@pytest.mark.parametrize("text", ["r0", "a", "left-front_2", "a" * 16])
def test_these_texts_are_names(text: str) -> None:
    assert is_name(text)


@pytest.mark.parametrize("text", ["", "R0", "0r", "r.0", "r 0", "a" * 17, "r0\n", "-r", "é"])
def test_these_texts_are_no_names(text: str) -> None:
    assert not is_name(text)


def test_the_environment_names_the_runtime_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    assert paths.runtime_dir() == Path("/run/swarm")
    monkeypatch.setenv("SWARM_RUNTIME", "")
    assert paths.runtime_dir() == Path("/run/swarm")
    monkeypatch.setenv("SWARM_RUNTIME", "/tmp/run/r0")
    assert paths.runtime_dir() == Path("/tmp/run/r0")
    assert paths.bus_endpoint(paths.runtime_dir()) == "unixsock-stream//tmp/run/r0/bus.sock"


def test_a_socket_path_has_at_most_107_bytes() -> None:
    """Counted in bytes: sun_path has 108 with the closing zero."""
    directory = Path("/tmp") / ("ü" * 40)  # 5 + 80 bytes
    assert paths.socket_path(directory, "x" * 21)
    with pytest.raises(BusError, match="108 bytes, but a Unix socket's path holds at most 107"):
        paths.socket_path(directory, "x" * 22)
