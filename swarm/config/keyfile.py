"""The file with the pre-shared key of a swarm: one line, or two while one key takes the place of another.

    # comments and empty lines are free
    68a1f0c2 9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08

A line is the key's id (8 hex digits) and the key (64). The id is the second since 1970 in which the key was made, so
the higher of two ids is the newer key; it is no secret, the mesh says it in the open. Whoever can read the key is a
member of the swarm: the file must be its owner's alone.
"""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from swarm.errors import LocalError
from swarm.files import atomic_write
from swarm.process.locks import folder_lock

KEY_SIZE = 32
"""Bytes of a key."""

MAX_KEYS = 2

_MAX_SIZE = 4096
_LINE = re.compile(r"([0-9A-Fa-f]{8})[ \t]+([0-9A-Fa-f]{64})")
_HEADER = "# The key of a swarm: who can read this is a member of it. Made by `swarm key`; id, then key.\n"


def read_keys(path: Path) -> dict[int, bytes]:
    """Return the keys of a file by id, the newest first; raises `LocalError` that says what to do."""
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode & 0o777
            data = file.read(_MAX_SIZE + 1)
    except FileNotFoundError:
        raise LocalError(
            f"{path}: there is no such file, and without a key no link comes up. Make one by `swarm key new {path}` "
            "and copy it to all robots. Only where anyone in reach may join: [mesh] insecure = true"
        ) from None
    except OSError as error:
        raise LocalError(f"{path}: the key cannot be read: {error.strerror}") from None
    if mode & 0o077:
        raise LocalError(
            f"{path}: others than its owner may use it (mode {mode:04o}): chmod 600 {path}; "
            "if others had access to this machine, make a new key by `swarm key new`"
        )
    return parse_keys(data, path)


def parse_keys(data: bytes, path: Path) -> dict[int, bytes]:
    """Check the content of a key file; `path` is for the messages, which never repeat what the file holds."""
    if len(data) > _MAX_SIZE:
        raise LocalError(f"{path}: longer than {_MAX_SIZE} bytes: not a key file")
    keys: dict[int, bytes] = {}
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        match = _LINE.fullmatch(text)
        if match is None:
            raise LocalError(f"{path}: line {number}: expected a key's id (8 hex digits) and the key (64)")
        key_id, key = int(match[1], 16), bytes.fromhex(match[2])
        if key_id in keys:
            raise LocalError(f"{path}: line {number}: id {match[1]} is there twice")
        if key in keys.values() or not any(key):
            raise LocalError(f"{path}: line {number}: this is no key of its own: make one by `swarm key new`")
        keys[key_id] = key
    if not 1 <= len(keys) <= MAX_KEYS:
        raise LocalError(f"{path}: holds {len(keys)} keys, expected one, or two during a rotation")
    return dict(sorted(keys.items(), reverse=True))


def new_key_file(path: Path, now: float) -> int:
    """Make a file with a new key; returns its id. Never touches a file that is there. `now` in s since 1970."""
    key_id = int(now) & 0xFFFFFFFF
    try:
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))  # of two calls at a time, one has the name
        try:
            atomic_write(path, _text({key_id: os.urandom(KEY_SIZE)}), mode=0o600)
        except BaseException:
            path.unlink()
            raise
    except FileExistsError:
        raise LocalError(f"{path}: is there already and is left alone (`swarm key rotate` replaces a key)") from None
    except OSError as error:
        raise LocalError(f"{path}: cannot be made: {error.strerror}; name another file, such as swarm.key") from None
    return key_id


def rotate(path: Path, now: float) -> int:
    """Put a new key in front of the one in the file; returns its id. Both are accepted from then on."""
    with _changed(path) as keys:
        if len(keys) >= MAX_KEYS:
            raise LocalError(
                f"{path}: holds two keys: when all robots have this file, end that rotation by `swarm key retire "
                f"{path}`"
            )
        key_id = max(int(now) & 0xFFFFFFFF, max(keys) + 1)
        if key_id > 0xFFFFFFFF:
            raise LocalError(f"{path}: id {max(keys):08x} leaves no room for a higher one: make a new file")
        _replace(path, {key_id: os.urandom(KEY_SIZE), **keys})
    return key_id


def retire(path: Path) -> int:
    """Forget the older of two keys; returns its id."""
    with _changed(path) as keys:
        if len(keys) < MAX_KEYS:
            raise LocalError(f"{path}: holds one key only: `swarm key rotate {path}` adds a new one first")
        newest, oldest = keys
        _replace(path, {newest: keys[newest]})
    return oldest


@contextlib.contextmanager
def _changed(path: Path) -> Iterator[dict[int, bytes]]:
    """Yield the keys of a file that no other process changes meanwhile: of two rotations at the same time one key
    would be lost, and a robot that already has it would be alone."""
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(folder_lock(Path(os.path.realpath(path)).parent, wait=False))
        except BlockingIOError:
            raise LocalError(
                f"{path}: another swarm command changes files in this folder: when it has ended, look which keys the "
                f"file has by `swarm key show-id {path}`"
            ) from None
        except OSError as error:
            raise LocalError(f"{path}: cannot be replaced: {error.strerror}") from None
        yield read_keys(path)


def _text(keys: dict[int, bytes]) -> bytes:
    return (_HEADER + "".join(f"{key_id:08x} {key.hex()}\n" for key_id, key in keys.items())).encode()


def _replace(path: Path, keys: dict[int, bytes]) -> None:
    """Write the file anew, whole or not at all, for the same owner; others cannot read it."""
    try:
        there = path.stat()
        atomic_write(path, _text(keys), mode=0o600, owner=(there.st_uid, there.st_gid))
    except OSError as error:
        raise LocalError(f"{path}: cannot be replaced: {error.strerror}") from None
