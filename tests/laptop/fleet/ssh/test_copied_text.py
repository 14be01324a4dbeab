"""What a program on a robot writes is shown as it comes, and does not steer the terminal."""

import io
import os
import threading

from conftest import wait_until

from laptop.fleet.ssh.ssh import copy_text
from swarm.process.terminal import Guarded


def test_a_question_is_shown_at_once_and_control_characters_are_visible() -> None:
    under = io.StringIO()
    ours, theirs = os.pipe()
    with os.fdopen(ours, "rb") as source:
        copying = threading.Thread(target=copy_text, args=(source, Guarded(under)))
        copying.start()
        os.write(theirs, "place (0, 1)? Enter, n or q: \N{EURO SIGN}".encode()[:-1])
        wait_until(lambda: under.getvalue() == "place (0, 1)? Enter, n or q: ")
        os.write(theirs, "\N{EURO SIGN}".encode()[-1:] + b"\n\x1b[2Jcleared\xff\n")
        os.close(theirs)
        copying.join()
    first, second, rest = under.getvalue().split("\n")
    assert first.endswith("n or q: \N{EURO SIGN}")
    assert "\x1b" not in second
    assert "[2Jcleared" in second
    assert rest == ""


def test_lines_of_ssh_itself_end_as_all_others() -> None:
    shown = io.StringIO()
    copy_text(io.BufferedReader(io.BytesIO(b"no such host\r\nnext\n")), Guarded(shown))
    assert shown.getvalue() == "no such host\nnext\n"
