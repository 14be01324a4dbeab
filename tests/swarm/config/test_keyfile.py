"""The file with the pre-shared key, and `swarm key`."""

import contextlib
import os
import stat
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.cli import main
from swarm.config.keyfile import new_key_file, parse_keys, read_keys, retire, rotate
from swarm.errors import LocalError

NOW = 1_760_000_000.5
FILE = Path("key")
KEY = "9f" * 32


def run(*arguments):
    """The exit code of `swarm key ARGUMENTS`."""
    with pytest.raises(SystemExit) as caught:
        main(("key", *map(str, arguments)))
    return caught.value.code


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "key"


@pytest.mark.parametrize("mask", [0o000, 0o022, 0o777])
def test_a_new_file_is_its_owners_alone_whatever_the_mask(path, mask):
    before = os.umask(mask)
    try:
        key_id = new_key_file(path, NOW)
    finally:
        os.umask(before)
    assert mode(path) == 0o600
    keys = read_keys(path)
    assert list(keys) == [key_id] == [int(NOW)]
    assert len(keys[key_id]) == 32


def test_no_two_keys_are_alike(tmp_path):
    found = set()
    for number in range(20):
        new_key_file(tmp_path / str(number), NOW)
        found.update(read_keys(tmp_path / str(number)).values())
    assert len(found) == 20


def test_a_file_that_is_there_is_left_alone(path):
    path.write_text("precious")
    with pytest.raises(LocalError, match="is there already"):
        new_key_file(path, NOW)
    assert path.read_text() == "precious"
    link = path.with_name("link")
    link.symlink_to(path.with_name("elsewhere"))
    with pytest.raises(LocalError, match="is there already"):
        new_key_file(link, NOW)


def test_of_two_that_make_a_key_at_the_same_time_one_is_refused(path, monkeypatch):
    """Both find no file; the other one goes on before the first has written its key."""
    draw = os.urandom

    def other_first(size):
        monkeypatch.setattr(os, "urandom", draw)
        with pytest.raises(LocalError, match="is there already"):
            new_key_file(path, NOW + 1)
        return draw(size)

    monkeypatch.setattr(os, "urandom", other_first)
    key_id = new_key_file(path, NOW)
    assert list(read_keys(path)) == [key_id]


def test_a_key_that_cannot_be_written_leaves_no_file(path, monkeypatch):
    monkeypatch.setattr(os, "fsync", MagicMock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(LocalError, match="cannot be made: No space left"):
        new_key_file(path, NOW)
    assert not list(path.parent.iterdir())


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(LocalError, match=r"none/key: cannot be made: No such file"):
        new_key_file(tmp_path / "none/key", NOW)


@pytest.mark.parametrize("now", [NOW + 9, NOW - 1e6])  # a Pi's clock may be years behind
def test_a_rotation_adds_a_key_and_keeps_the_old_one(path, now):
    old = new_key_file(path, NOW)
    secret = read_keys(path)[old]
    new = rotate(path, now)
    assert new > old
    keys = read_keys(path)
    assert list(keys) == [new, old]
    assert keys[old] == secret != keys[new]
    lines = path.read_text().splitlines()
    assert lines[1].startswith(f"{new:08x} ")
    assert lines[2].startswith(f"{old:08x} ")
    assert mode(path) == 0o600
    with pytest.raises(LocalError, match="end that rotation by `swarm key retire"):
        rotate(path, now + 1)
    assert retire(path) == old
    assert read_keys(path) == {new: keys[new]}
    assert mode(path) == 0o600
    with pytest.raises(LocalError, match="holds one key only"):
        retire(path)
    assert [each.name for each in path.parent.iterdir()] == ["key"]


@pytest.mark.parametrize("other", [lambda path: rotate(path, NOW + 2), retire])
def test_of_two_that_change_a_key_file_at_the_same_time_one_is_refused(path, monkeypatch, other):
    """The first one has read the file, and has not replaced it yet: its key would be lost, or come back."""
    old = new_key_file(path, NOW)
    draw = os.urandom

    def other_meanwhile(size):
        link = path.with_name("link")
        link.symlink_to(path)
        with pytest.raises(LocalError, match=r"another swarm command changes files .*swarm key show-id"):
            other(link)
        return draw(size)

    monkeypatch.setattr(os, "urandom", other_meanwhile)
    new = rotate(path, NOW + 1)
    assert list(read_keys(path)) == [new, old]
    assert retire(path) == old  # the lock is free again


def test_a_left_over_of_a_killed_rotation_does_no_harm(path):
    new_key_file(path, NOW)
    path.with_name("key.new").write_text("half")
    rotate(path, NOW + 1)
    assert len(read_keys(path)) == 2


def test_a_rotation_follows_a_link(path):
    new_key_file(path, NOW)
    link = path.with_name("link")
    link.symlink_to(path)
    rotate(link, NOW + 1)
    assert link.is_symlink()
    assert len(read_keys(path)) == 2


@pytest.mark.parametrize("bits", [0o640, 0o604, 0o660, 0o610, 0o444])
def test_a_file_others_may_use_is_refused(path, bits):
    new_key_file(path, NOW)
    path.chmod(bits)
    for use in (lambda: read_keys(path), lambda: rotate(path, NOW), lambda: retire(path)):
        with pytest.raises(LocalError, match=rf"mode 0{bits:o}\): chmod 600"):
            use()
    path.chmod(0o400)
    assert len(read_keys(path)) == 1


def test_a_missing_file_says_what_to_do(path):
    with pytest.raises(LocalError, match=r"no such file.*`swarm key new .*copy it to all robots.*insecure = true"):
        read_keys(path)
    with pytest.raises(LocalError, match="the key cannot be read: Is a directory"):
        read_keys(path.parent)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "holds 0 keys"),
        ("# 00000001 " + KEY, "holds 0 keys"),
        (f"00000001 {KEY}\n00000002 {'a' * 64}\n00000003 {'b' * 64}", "holds 3 keys"),
        (f"00000001 {KEY}\n00000001 {'a' * 64}", "line 2: id 00000001 is there twice"),
        (f"00000001 {KEY}\n00000002 {KEY}", "line 2: this is no key of its own"),
        ("00000001 " + "0" * 64, "line 1: this is no key of its own"),
        ("0001 " + KEY, "line 1: expected a key's id"),
        ("00000001 " + KEY[:-1], "line 1: expected a key's id"),
        (f"00000001 {KEY} x", "line 1: expected a key's id"),
        ("# \n\n00000001" + KEY, "line 3: expected a key's id"),
        ("secret", "line 1: expected a key's id"),
        ("# " + "x" * 5000, "longer than 4096 bytes"),
    ],
)
def test_wrong_files_are_refused_without_repeating_them(text, problem):
    with pytest.raises(LocalError, match=problem) as caught:
        parse_keys(text.encode(), FILE)
    assert KEY[:8] not in str(caught.value)
    assert "secret" not in str(caught.value)


def test_the_newest_key_comes_first_whatever_the_order():
    text = f"# a comment\n\n00000001 {KEY}  # the old one\r\n  00000002\t{'Aa' * 32}"
    assert list(parse_keys(text.encode(), FILE).items()) == [(2, b"\xaa" * 32), (1, b"\x9f" * 32)]


@given(st.binary(max_size=300) | st.text("0123456789abcdef \n#", max_size=200).map(str.encode))
def test_any_bytes_are_read_or_refused(data):
    with contextlib.suppress(LocalError):
        assert 1 <= len(parse_keys(data, FILE)) <= 2


# -- the command ---------------------------------------------------------------------------------------------


def test_the_command_from_new_to_retire(path, capsys):
    assert run("new", path) == 0
    assert mode(path) == 0o600
    (old,) = read_keys(path)
    assert run("rotate", path) == 0
    capsys.readouterr()
    assert run("show-id", path) == 0
    new, also_old = capsys.readouterr().out.split()
    assert (new, also_old) == (f"{max(read_keys(path)):08x}", f"{old:08x}")
    assert run("retire", path) == 0
    assert run("show-id", path) == 0
    out = capsys.readouterr().out
    assert out.split()[-1] == new
    assert all(key.hex() not in out for key in read_keys(path).values())


def test_the_command_fails_in_one_line(path, capsys):
    assert run("show-id", path) == 2
    assert run("new", path) == 0
    assert run("new", path) == 2
    assert run("retire", path) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 3
    assert all(line.startswith(f"swarm: {path}: ") for line in errors)
    assert run() == 2
    assert run("nwe", path) == 2


def test_a_part_of_a_key_file_is_refused_or_holds_whole_keys(path):
    new_key_file(path, NOW)
    old = read_keys(path)
    rotate(path, NOW + 1)
    both, data = read_keys(path), path.read_bytes()
    for size in range(len(data) + 1):
        try:
            found = parse_keys(data[:size], path)
        except LocalError:
            continue
        assert found in (both, {key_id: key for key_id, key in both.items() if key_id not in old})
