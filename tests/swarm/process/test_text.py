"""Text that others have named reaches logs and terminals in printable form only, whatever it is."""

import io
import json
import logging
import re
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import swarm
from laptop.fleet.files import journal
from laptop.fleet.ssh.ssh import last_words
from swarm.messages.codec import MAX_PAYLOAD, encode
from swarm.onboard.buses.samples import BusSample, as_json, as_text
from swarm.process import log, terminal
from swarm.process.terminal import Guarded, steer, write_lines
from swarm.process.text import printable

ANY_TEXT = st.text(st.characters()) | st.text(
    st.sampled_from(
        "a\x00\x07\b\t\n\v\f\r\x1b\x1c\x7f\x85\x9b\u200b\u200e\u202a\u202e\u2028\u2029\u2066\u2069\ud800\ufeff\U000e0041"
    )
)
"""Halves of surrogate pairs are in it, too."""

ROOT = Path(swarm.__file__).parent.parent


def is_harmless(text: str) -> bool:
    """Nothing that steers, breaks a line, reverses it, or cannot be seen."""
    return not any(unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp") for letter in text)


@given(ANY_TEXT, st.integers(3, 50) | st.none())
def test_printable_text_is_one_bounded_line_of_visible_characters(text: str, longest: int | None) -> None:
    shown = printable(text, longest)
    assert is_harmless(shown)
    assert len(shown.splitlines()) <= 1
    shown.encode()
    if longest is not None:
        assert len(shown) <= longest
    if text.isprintable() and (longest is None or len(text) <= longest):
        assert shown == text


@given(st.text(st.characters()))
def test_printable_json_means_what_it_meant(text: str) -> None:
    for ascii_only in (True, False):
        line = json.dumps({text: [text]}, ensure_ascii=ascii_only)
        assert json.loads(printable(line, None)) == json.loads(line)


@given(ANY_TEXT, ANY_TEXT, st.booleans())
def test_no_log_line_is_forged_or_steers(message: str, fault: str, journal_is_there: bool) -> None:
    formatter = log._Formatter(journal=journal_is_there)
    prefix = "<4>" if journal_is_there else ""
    record = logging.LogRecord("mesh", logging.WARNING, "", 0, "stopped reason=%s", (message,), None)
    line = formatter.format(record)
    assert is_harmless(line)
    assert len(line) <= log.MAX_LINE + 3
    try:
        raise ValueError(fault)  # noqa: TRY301 - a traceback is wanted
    except ValueError:
        record = logging.LogRecord("mesh", logging.WARNING, "", 0, "failed", (), sys.exc_info())
    first, *rest = formatter.format(record).split("\n")
    assert first.endswith("mesh: failed")
    assert rest
    for line in rest:
        assert line.startswith(prefix + log.TRACEBACK)
        assert is_harmless(line)


def test_the_length_of_a_log_line_and_of_a_traceback_is_bounded() -> None:
    formatter = log._Formatter(journal=True)
    try:
        raise ValueError("x\n" * 10_000 + "x" * 1_000_000)  # noqa: TRY301
    except ValueError:
        record = logging.LogRecord("mesh", logging.ERROR, "", 0, "x" * 1_000_000, (), sys.exc_info())
    lines = formatter.format(record).split("\n")
    assert len(lines) == 1 + log.MAX_TRACEBACK
    assert max(map(len, lines)) <= log.MAX_LINE + 5


@given(st.lists(ANY_TEXT))
def test_a_guarded_stream_keeps_its_lines_and_shows_all_else(texts: list[str]) -> None:
    under = io.StringIO(newline="")
    stream = Guarded(under)
    for text in texts:
        print(text, file=stream)
    stream.writelines(texts)
    steer(stream, "\x1b[H")
    written = under.getvalue()
    assert written.endswith("\x1b[H")
    assert all(is_harmless(line) for line in written.removesuffix("\x1b[H").split("\n"))
    assert written.count("\n") == 2 * "".join(texts).count("\n") + len(texts)


@given(st.lists(ANY_TEXT))
def test_a_row_stays_on_its_line(rows: list[str]) -> None:
    under = io.StringIO(newline="")
    before, sys.stdout = sys.stdout, Guarded(under)  # type: ignore[assignment]
    try:
        write_lines(rows)
    finally:
        sys.stdout = before
    assert under.getvalue().count("\n") == len(rows)


@given(st.dictionaries(ANY_TEXT.filter(lambda text: text.isascii()), st.integers(0, 9), min_size=1, max_size=3))
def test_z_sub_shows_unknown_fields_in_printable_form(fields: dict[str, int]) -> None:
    sample = BusSample(1.0, "", "swarm/r0/mesh/status", encode(fields))
    assert is_harmless(as_text(sample))
    assert as_json(sample).isascii()


def test_z_sub_shows_one_bounded_line_for_the_largest_field_name() -> None:
    sample = BusSample(1.0, "", "swarm/r0/mesh/status", encode({"\x1b]0;x\x07" + "y" * (MAX_PAYLOAD - 50): 1}))
    assert is_harmless(as_text(sample))


@given(ANY_TEXT)
def test_what_a_robot_writes_to_its_journal_is_kept_in_printable_form(text: str) -> None:
    fields = {"__CURSOR": "s=1", "__REALTIME_TIMESTAMP": "1", "MESSAGE": text, "UNIT": text, "_PID": text}
    found = journal.entry(json.dumps(fields))
    if found is not None:  # half a surrogate pair is refused
        assert is_harmless(found[1])
    assert is_harmless(last_words(text))
    assert len(last_words(text)) <= 200


def test_an_error_that_names_what_a_peer_has_sent_is_printable(tmp_path: Path) -> None:
    """As the command line and a service end with it."""
    for program in ("swarm.onboard.command_line:main({})", "swarm.process.edges:run(main)"):
        module, _, call = program.partition(":")
        code = (
            f"import {module} as module\nfrom swarm.errors import LocalError\n"
            "def main(*_): raise LocalError('x\\x1b]0;owned\\x07\\u202e')\n"
            f"module._main = main\nmodule.{call}\n"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
        assert done.returncode == 2
        assert "x\\u001b]0;owned\\u0007\\u202e" in done.stderr
        assert all(map(is_harmless, done.stderr.splitlines()))


PROGRAMS_OF_JSON = {"swarm/onboard/lookout.py", "swarm/onboard/listen.py", "sim/rehearsal/examine.py"}
"""What they write is for programs: msgpack and JSON in ASCII."""


def test_every_program_of_ours_guards_its_output() -> None:
    unguarded = set()
    for folder in ("swarm", "services", "sim", "laptop"):
        for path in (ROOT / folder).rglob("*.py"):
            text = path.read_text()
            if '__name__ == "__main__"' not in text:
                continue
            if not re.search(r"\brun\(\s*main\b|guard\(\)|end_with\(", text):
                unguarded.add(str(path.relative_to(ROOT)))
    assert unguarded == PROGRAMS_OF_JSON


def test_no_program_of_ours_writes_past_the_guard() -> None:
    """`steer` is the one way, for codes of our own."""
    for folder in ("swarm", "services", "sim", "laptop"):
        for path in (ROOT / folder).rglob("*.py"):
            text = path.read_text()
            assert "sys.__stdout__" not in text
            assert "sys.__stderr__" not in text
            if path != Path(terminal.__file__):
                assert "stdout.buffer" not in text
                assert ".stream.write" not in text


@pytest.fixture(autouse=True)
def _streams_of_the_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever guards them is gone after the test."""
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    monkeypatch.setattr(sys, "stderr", sys.stderr)
