"""The display: letters, slices, what the simulated SSD1306 shows of them."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.devices.display import ADDRESS, LINES, RETRY_S, SETUP, Screen, render, render_large
from services.balancer.core.devices.font import LETTERS
from services.balancer.core.devices.screen import Composer, wrap
from services.balancer.core.slack.wire_time import LONGEST, WHOLE, Room, WireTime
from sim.core.display import DisplayDevice
from swarm.messages import AppState, BalancerState

GOLDEN = """\
...##.....#....#....#...
..#..#...##.........#...
..#.....#.#...##...####.
.###...#..#....#....#...
..#....#####...#....#...
..#.......#....#....#..#
..#.......#...###....##.
........................"""


class Wired:
    """A screen and a display; `draw` lets them go on until nothing is left to do."""

    def __init__(self) -> None:
        self.screen, self.device = Screen(0.0), DisplayDevice()
        self.transfers: list = []
        self.rooms = [WHOLE]
        """What there is room for in the transfers, over and over."""

    def draw(self, now: float = 1.0, most: int = 10_000) -> int:
        before = len(self.transfers)
        while len(self.transfers) - before < most and (transfer := self._next(now)) is not None:
            assert transfer.address == ADDRESS
            self.transfers.append(transfer)
            self.device.write(transfer.data, now)
            self.screen.take(b"", now)
        return len(self.transfers) - before

    def sent(self) -> int:
        """Count the bytes of the picture that were sent."""
        return sum(len(each.data) - 1 for each in self.transfers if each.data[0] == 0x40)

    def _next(self, now: float):
        return self.screen.next(now, self.rooms[len(self.transfers) % len(self.rooms)])

    def page(self, number: int) -> list[str]:
        return self.device.picture()[8 * number : 8 * number + 8]


def points(pages: list[bytes]) -> list[str]:
    return ["".join("#" if byte >> y & 1 else "." for byte in page) for page in pages for y in range(8)]


def test_the_picture_is_the_text() -> None:
    wired = Wired()
    lines = ("r0", "balancing       7.4 V", "", "consensus k=12", "value 2.833")
    wired.screen.show(lines)
    wired.draw()
    expected = [*render_large("r0"), *(render(line) for line in lines[1:]), render(""), render("")]
    assert wired.device.picture() == points(expected)
    assert wired.screen.drawn


def test_letters_look_like_letters() -> None:
    assert [row[:24] for row in points([render("f4it")])] == GOLDEN.split("\n")
    assert sorted(LETTERS) == [chr(code) for code in range(32, 127)]
    assert len(set(LETTERS.values())) == len(LETTERS), "no two letters look alike"
    assert all(len(columns) == 5 and max(columns) < 0x80 for columns in LETTERS.values())


def test_large_letters_are_the_small_ones_twice_as_large() -> None:
    small, large = points([render("r4")]), points(list(render_large("r4")))
    assert large == [("".join(2 * point for point in row))[:128] for row in small for _ in range(2)]
    assert render_large("a-rather-long-1") == (render("a-rather-long-1"), bytes(128))


def test_the_display_stays_dark_until_the_picture_is_whole() -> None:
    wired = Wired()
    wired.screen.show(("r0",))
    assert wired.draw(most=20) == 20
    assert set("".join(wired.device.picture())) == {"."}
    wired.draw()
    assert "#" in "".join(wired.device.picture())
    assert wired.sent() == 1024


def test_only_what_changed_is_sent() -> None:
    wired = Wired()
    wired.screen.show(("r0", "idle            7.4 V"))
    wired.draw()
    before = wired.sent()
    wired.screen.show(("r0", "idle            7.3 V"))
    assert wired.draw() == 2, "the address of what changed, and that"
    assert wired.sent() - before <= 5, "the columns of one digit"
    wired.screen.show(("r0", "idle            7.3 V"))
    assert wired.draw() == 0
    wired.screen.show(("r0", "balancing       7.3 V"))
    assert wired.draw() <= 6, "what is side by side needs one address"


def test_no_transfer_is_larger_than_the_slack_of_a_tick() -> None:
    wired = Wired()
    wired.screen.show(tuple("0123456789abcdefghijk" for _ in range(LINES)))
    wired.draw()
    assert max(len(transfer.data) for transfer in wired.transfers) <= LONGEST
    assert max(map(WireTime(100e3).duration, wired.transfers)) < 3.0e-3


@given(st.lists(st.integers(-5, 40), min_size=1, max_size=8), st.text(max_size=21), st.text(max_size=21))
def test_the_picture_is_the_same_however_little_room_there_is(rooms: list[int], before: str, after: str) -> None:
    wired = Wired()
    wired.rooms = [Room(0, 0, size) for size in rooms]
    for text in (before, after):
        wired.screen.show(("r0", text))
        wired.draw()
    assert wired.screen.drawn
    pages = [*render_large("r0"), render(after)]
    assert wired.device.picture() == points([*pages, *[render("")] * (8 - len(pages))])
    longest = max(1, *rooms)
    shortest_that_cannot_be_cut = 4  # an address of a slice
    assert all(len(each.data) <= max(longest, shortest_that_cannot_be_cut) for each in wired.transfers)


def test_a_display_that_is_not_there_is_looked_for_now_and_then() -> None:
    screen = Screen(0.0)
    screen.show(("r0",))
    assert screen.next(0.0).data == SETUP
    screen.fail(OSError(121, "Remote I/O error"), 0.0)
    assert screen.present is False
    assert screen.next(RETRY_S - 0.1) is None
    assert screen.next(RETRY_S).data == SETUP


def test_a_display_that_lost_power_is_drawn_anew() -> None:
    wired = Wired()
    wired.screen.show(("r0", "x"))
    wired.draw()
    picture = wired.device.picture()
    wired.device.reset()
    wired.screen.show(("r0", "y"))
    wired.screen.next(1.0)
    wired.screen.fail(OSError(121, "Remote I/O error"), 1.0)
    wired.screen.show(("r0", "x"))
    wired.draw(now=1.0 + RETRY_S)
    assert wired.device.picture() == picture


@given(st.lists(st.lists(st.text(max_size=30), max_size=9), min_size=1, max_size=4), st.randoms())
def test_any_text_is_shown_as_it_would_be_rendered(texts: list[list[str]], chance: random.Random) -> None:
    """However far the drawing had come when the next text was there."""
    wired = Wired()
    for lines in texts:
        wired.screen.show(lines)
        wired.draw(most=chance.randrange(60))
    wired.draw()
    lines = (texts[-1] + [""] * LINES)[:LINES]
    assert wired.device.picture() == points([*render_large(lines[0]), *map(render, lines[1:])])


@given(st.lists(st.binary(min_size=1, max_size=40), max_size=10))
def test_the_simulated_display_takes_anything(transfers: list[bytes]) -> None:
    device = DisplayDevice()
    for data in transfers:
        device.write(data, 0.0)
    picture = device.picture()
    assert len(picture) == 64
    assert {len(row) for row in picture} == {128}


def test_the_simulated_display_takes_every_control_byte() -> None:
    """0x80: one command and then another control byte; horizontal addressing runs on to the next page."""
    device = DisplayDevice()
    device.write(bytes((0x00, 0x20, 0x00, 0xA1, 0xC8, 0x8D, 0x14)), 0.0)
    device.write(bytes((0x80, 0xB0, 0x80, 0x00, 0x80, 0x10, 0x40)) + bytes(1024), 0.0)
    device.write(b"\x40" + bytes(127) + b"\x01\x80", 0.0)
    device.write(b"\x80\xaf", 0.0)
    picture = device.picture()
    assert picture[0] == "." * 127 + "#"
    assert picture[15] == "#" + "." * 127
    assert "".join(picture).count("#") == 2
    assert device.read(1, 0.0) == b"\0"


# What is to be read on it


def state(**changes: object) -> BalancerState:
    values = dict.fromkeys(("t", "tilt", "tilt_rate", "speed", "duty_left", "duty_right"), 0.0)
    values |= {"mode": "balancing", "battery": 7.42, "ticks": 1, "late_p99": 0.0, "late_max": 0.0, "fault": ""}
    return BalancerState(**(values | changes))


def test_name_state_battery_and_the_apps_values() -> None:
    composer = Composer("r0")
    assert composer.lines(0.0) is None, "nothing is known yet"
    composer.take_state(state(battery=None, mode="standing_up"))
    assert composer.lines(0.0).lines == ("r0", "standing up          ", "", "")
    composer.take_state(state())
    composer.take_app("consensus", AppState(1.0, 12, {"value": 2.83333, "at": (1.0, 2.5), "done": True}, {}))
    assert composer.lines(0.1) is None, "not more often than twice a second"
    assert composer.lines(0.6).lines == (
        "r0",
        "balancing       7.4 V",
        "",
        "consensus k=12",
        "value 2.833",
        "at 1 2.5",
        "done True",
    )
    assert composer.lines(9.0) is None, "nothing has changed"


def test_text_goes_before_the_app_and_a_fault_before_both() -> None:
    composer = Composer("r0")
    composer.take_state(state())
    composer.take_app("max", AppState(1.0, 1, {}, {}))
    composer.take_text("hello\nworld")
    assert composer.lines(1.0).lines[3:] == ("hello", "world")
    composer.take_state(state(mode="fault", fault="I2C: Remote I/O error (error 121)"))
    assert composer.lines(2.0).lines[1:] == ("fault           7.4 V", "", "I2C: Remote I/O error", "(error 121)")
    composer.take_state(state())
    composer.take_text("")
    assert composer.lines(3.0).lines[3:] == ("max k=1",)


@given(st.text(max_size=200), st.integers(1, 6))
def test_wrapped_text_fits_the_lines_of_the_display(text: str, lines: int) -> None:
    wrapped = wrap(text, lines)
    assert 1 <= len(wrapped) <= lines
    assert all(len(line) <= 21 for line in wrapped)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", [""]),
        ("one two three four five six", ["one two three four", "five six"]),
        ("x" * 30, ["x" * 21, "x" * 9]),
        ("a\n\nb", ["a", "", "b"]),
        ("1\n2\n3\n4\n5", ["1", "2", "3", "4"]),
    ],
)
def test_text_is_wrapped_between_words_where_they_fit(text: str, expected: list[str]) -> None:
    assert wrap(text, 4) == expected
