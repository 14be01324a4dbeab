"""What a lab machine is made of. A change here makes new machines; the rest of the cache stays (lab.vm.build)."""

import hashlib
from pathlib import Path

SUITE = "trixie"
PYTHON = "3.13"
MACHINE = "x86_64"
MIRROR = "http://deb.debian.org/debian"

EPOCH = "315532800"
"""Of the time stamps that a build makes: equal sources, equal bytes."""

PACKAGES = (
    # A robot as Raspberry Pi OS has it: init, Bluetooth, Python with PyBluez, ssh.
    *("systemd", "systemd-sysv", "dbus", "udev", "kmod", "sudo", "iproute2", "procps", "openssh-server"),
    *("python3", "python3-venv", "python3-bluez", "python3-dbus", "python3-gi", "bluez"),
    # What the tests inside use.
    *("python3-pytest", "python3-pytest-timeout"),
)

DISK_MB = 1200
"""Size of a machine's disk; what is not used takes no room."""

MASKED = (
    *("systemd-timesyncd.service", "e2scrub_reap.service", "getty@tty1.service", "serial-getty@ttyS0.service"),
    *("apt-daily.timer", "apt-daily-upgrade.timer", "dpkg-db-backup.timer", "fstrim.timer", "e2scrub_all.timer"),
    *("systemd-logind.service", "dev-hugepages.mount", "dev-mqueue.mount", "sys-kernel-debug.mount"),
    *("sys-kernel-tracing.mount", "systemd-hwdb-update.service", "systemd-update-utmp.service", "ldconfig.service"),
    *("kmod-static-nodes.service", "modprobe@configfs.service", "modprobe@drm.service", "modprobe@efi_pstore.service"),
    *("modprobe@fuse.service", "sys-fs-fuse-connections.mount", "run-lock.mount", "systemd-ask-password-console.path"),
    *("systemd-ask-password-wall.path", "systemd-creds.socket", "systemd-hostnamed.socket", "systemd-initctl.socket"),
    *("systemd-journal-flush.service", "systemd-modules-load.service", "systemd-random-seed.service"),
    *("systemd-remount-fs.service", "systemd-sysctl.service", "systemd-sysext.socket", "systemd-tmpfiles-clean.timer"),
    *("systemd-tmpfiles-setup-dev-early.service", "systemd-udev-load-credentials.service"),
    *("systemd-user-sessions.service",),
)
"""Units that only take time of a machine that lives for minutes, each a third of a second and more: systemd and its
helpers are half of a boot. So are what its generators would add; none of them finds anything here (`build`)."""

GUEST = Path(__file__).parent / "guest"
"""The files that run inside."""


def digest(*parts: str | bytes) -> str:
    """16 hex digits that name this content."""
    found = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        found.update(len(data).to_bytes(8, "little") + data)
    return found.hexdigest()[:16]


def sources(*folders: Path) -> bytes:
    """All bytes of the Python and shell files in these folders."""
    files = sorted(path for folder in folders for path in folder.glob("*") if path.is_file())
    return b"".join(path.name.encode() + b"\0" + path.read_bytes() for path in files)
