import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.module import shell
from services.dwm.core.module.exchange import is_shell
from services.dwm.core.module.shell import ShellInfo, ShellReader
from services.dwm.core.module.tlv import AnchorRange, Location, Position
from swarm.errors import FrameError

LES = "022E[7.94,8.03,0.00]=3.38 D001[0.00,-1.00,0.00]=1.20 le_us=3082 est[6.97,5.17,-1.77,53]"
LEC = "DIST,2,AN0,022E,7.94,8.03,0.00,3.38,AN1,D001,0.00,-1.00,0.00,1.20,POS,6.97,5.17,-1.77,53"
SEEN = Location(
    Position(6.97, 5.17, -1.77, 53),
    (
        AnchorRange("022E", 3.38, 100, Position(7.94, 8.03, 0.0, 100)),
        AnchorRange("D001", 1.2, 100, Position(0.0, -1.0, 0.0, 100)),
    ),
)
NO_FIX = Location(Position(0.0, 0.0, 0.0, 0), SEEN.ranges)

centimetres = st.integers(-30_000, 30_000).map(lambda value: value / 100)
places = st.builds(Position, centimetres, centimetres, centimetres, st.integers(1, 100))
locations = st.builds(
    Location,
    places | st.just(NO_FIX.position),
    st.lists(
        st.builds(
            AnchorRange,
            st.integers(0, 0xFFFF).map(lambda value: f"{value:04X}"),
            st.integers(0, 30_000).map(lambda value: value / 100),
            st.just(100),
            st.builds(Position, centimetres, centimetres, centimetres, st.just(100)),
        ),
        max_size=5,
    ).map(tuple),
)


def drain(reader):
    results, errors = [], 0
    while True:
        try:
            line = reader.next()
        except FrameError:
            errors += 1
            continue
        if line is None:
            return results, errors
        results.append(line)


def read(data):
    reader = ShellReader()
    reader.receive(data)
    return drain(reader)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (LES, SEEN),
        ("022E[7.94,8.03,0.00]=3.38 D001[0.00,-1.00,0.00]=1.20", NO_FIX),
        ("le_us=3082", Location(NO_FIX.position, ())),
        (LEC, SEEN),
        (LEC.partition(",POS")[0], NO_FIX),
        ("DIST,0", Location(NO_FIX.position, ())),
        ("POS,7.10,5.24,-2.03,53", Position(7.1, 5.24, -2.03, 53)),
        (
            "[000541.880 INF] uwb0: panid=xFD5C addr=xDECA9AABC0A2591A",
            ShellInfo(
                541.88, "uwb0", "panid=xFD5C addr=xDECA9AABC0A2591A", {"panid": "xFD5C", "addr": "xDECA9AABC0A2591A"}
            ),
        ),
        ("[000541.880 INF] mode: tn (act,twr,np,le)", ShellInfo(541.88, "mode", "tn (act,twr,np,le)", {})),
    ],
)
def test_lines_of_the_module(text, line):
    assert read(f"dwm> {text}\r\n".encode()) == ([line], 0)


@given(locations)
def test_round_trips(location):
    assert read(f"{shell.les(location)}\r\n{shell.lec(location)}\r\n".encode()) == ([location, location], 0)
    assert read(f"{shell.lep(location.position)}\r\n".encode()) == ([location.position], 0)


@given(st.lists(locations, min_size=1, max_size=4), st.data())
def test_split_anywhere(sent, data):
    stream = "".join(f"{shell.lec(location)}\r\n" for location in sent).encode()
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=9)))
    reader, results = ShellReader(), []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        reader.receive(stream[start:end])
        results += drain(reader)[0]
    assert results == sent


@pytest.mark.parametrize(
    "text",
    [
        LEC.replace("AN1", "A"),
        LEC.replace("DIST,2", "DIST,3"),
        LEC.replace("1.20", "1.2"),
        LEC.replace("3.38", "-3.38"),
        LEC[:40] + LEC,
        LES.replace("=3.38", ""),
        LES[:30] + LES[40:],
        LES.replace("53]", "153]"),
        "POS,7.10,5.24",
        "POS,7.10,5.24,-2.03,101",
    ],
)
def test_a_garbled_line_costs_itself_alone(text):
    results, errors = read(f"{text}\r\n{LEC}\r\n".encode())
    assert (results, errors) == ([SEEN], 1)


def test_what_is_no_data_is_passed_over():
    reader = ShellReader()
    reader.receive(b"\r\n DWM1001 TWR Real Time Location System\r\n\r\n Help      :  ? or help \r\n\r\ndwm> ")
    assert drain(reader) == ([], 0)
    assert reader.prompts == 1
    reader.receive(b"lec\r\r\n" + LEC.encode() + b"\r\ndwm>")
    assert drain(reader) == ([SEEN], 0)
    assert reader.prompts == 2


def test_a_line_without_an_end_is_given_up():
    reader = ShellReader()
    for _ in range(100):
        reader.receive(b"DIST," * 100)
        assert len(reader._rest) <= shell.MAX_LINE
    reader.receive(b"\r\n" + LEC.encode() + b"\r\n")
    assert drain(reader) == ([SEEN], 0)


@given(st.binary(max_size=400), locations)
def test_any_noise_costs_no_later_line(noise, location):
    results, _ = read(noise + b"\r\n" + shell.lec(location).encode() + b"\r\n")
    assert results[-1] == location


@pytest.mark.parametrize(
    ("heard", "told"),
    [
        (b"\r\ndwm> ", True),
        (LES.encode(), True),
        (b"unknown command\r\n", True),
        (b"\x0c", False),
        (bytes.fromhex("400101"), False),
        (bytes(range(256)), False),
    ],
)
def test_a_shell_is_known_by_what_it_says(heard, told):
    assert is_shell(heard) is told
