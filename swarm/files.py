"""Files that a kill, a power cut or a full disk must not damage: replaced as a whole, or with blocks of their own.

Only the standard library is imported here: the programs that a laptop sends to a robot without a release use it, too.
"""

import contextlib
import os
from pathlib import Path


def atomic_write(
    path: Path, data: bytes, *, mode: int | None = None, owner: tuple[int, int] | None = None, unsynced: str = ""
) -> None:
    """Replace the file's content; of a symbolic link, that of the file to which it leads. Whenever the process is
    killed or the power fails, a reader finds the whole old content or the whole new one; once this function has
    returned, it finds the new one. One process at a time may write a file.

    `mode`: permissions; without it, those of the file that is there, or what the umask leaves of 0644. `owner`: user
    and group. `unsynced`: the reason why a power cut may take the content away; with a reason nothing waits for the
    disk. Raises `OSError`; the folder must be there.
    """
    path = Path(os.path.realpath(path))
    new = path.with_name(path.name + ".new")
    if mode is None:
        with contextlib.suppress(FileNotFoundError):
            mode = path.stat().st_mode & 0o777
    with contextlib.suppress(FileNotFoundError):
        new.unlink()
    try:
        # A new inode that nobody else has open. A secret is never readable to others, not even for a moment.
        file = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644 if mode is None else 0o600)
        try:
            if owner is not None and owner != (os.geteuid(), os.getegid()):
                os.fchown(file, *owner)
            if mode is not None and hasattr(os, "fchmod"):  # Windows has none before Python 3.13
                with contextlib.suppress(PermissionError):  # a FAT file system has no permissions
                    os.fchmod(file, mode)
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(file, rest) :]
            if not unsynced:
                os.fsync(file)
        finally:
            os.close(file)
        os.replace(new, path)  # noqa: PTH105 - every change of the disk in this module is a call of `os`
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink()
        raise
    if not unsynced:
        sync_folder(path.parent)


def make_folder(path: Path) -> None:
    """Make a folder and those above it, where they are missing; each is on the disk when this function returns."""
    if not path.is_dir():
        make_folder(path.parent)
        path.mkdir(exist_ok=True)
        sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk. Systems that cannot open folders (Windows) do that alone."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def free_space(place: str | Path | int) -> int:
    """Return the bytes that may still be written to the disk of a path or of an open file. Raises `OSError`."""
    disk = os.statvfs(place)
    return disk.f_bavail * disk.f_frsize


def open_reserved(path: Path, size: int, mode: int) -> int:
    """Open a file for reading and writing, and reserve its first `size` bytes: a disk that is full later cannot fail a
    write to them, nor end the process with SIGBUS where they are mapped. Raises `OSError`, on a full disk above all."""
    file = os.open(path, os.O_RDWR | os.O_CREAT, mode)
    try:
        os.posix_fallocate(file, 0, size)
    except OSError:
        os.close(file)
        raise
    return file
