"""Boots a robot on an emulated arm64 machine with Debian's kernel and our units, and says what it found there:

    .venv/bin/python tools/aarch64_machine.py [FOLDER]

Debian 13 for arm64 is unpacked into FOLDER (default: a temporary one), the release is installed there by its own
`install` under qemu-user, and qemu-system-aarch64 boots the result twice, with 512 MB of memory:

- on four processors, for what the units promise: limits, sandbox, real-time priority, the balancer's own processor;
- on one processor whose clock counts instructions (`-icount`), 1 ns each: CPU time is then a number of instructions,
  the same on any host.

Needs root, half an hour, 4 GB of disk, and
`apt-get install mmdebstrap qemu-user-static qemu-system-arm cpio kmod xz-utils e2fsprogs`.
"""

import json
import lzma
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from lab.robot import disk  # noqa: E402
from lab.vm import recipe  # noqa: E402
from lab.vm.build import Image  # noqa: E402
from lab.vm.shell import sh  # noqa: E402
from swarm.config.keyfile import new_key_file  # noqa: E402

PACKAGES = (
    *("ca-certificates", "dash", "bash", "coreutils", "findutils", "diffutils", "grep", "sed", "hostname"),
    *("util-linux", "mount", "procps", "gzip", "tar"),
    *("python3", "python3-venv", "systemd", "systemd-sysv", "dbus", "udev", "kmod", "base-passwd", "base-files"),
    *("linux-image-arm64", "busybox-static"),
)
MODULES = ("virtio_pci", "virtio_blk", "ext4")
"""What the kernel needs to find its disk."""
DISK_MB = 3000
BOOT_S = 1500.0
CONFIG = """network = "lab"
[topology]
edges = []
[[robots]]
name = "r0"
link = "tcp:127.0.0.1:5501"
[mesh]
listen = "127.0.0.1:5501"
[dwm]
source = "serial:/run/lab/{robot}/dwm.tty"
[[anchors]]
address = "D001"
x = 0.0
y = 0.0
[[anchors]]
address = "D002"
x = 2.0
y = 0.0
[[anchors]]
address = "D003"
x = 0.0
y = 2.0
[simulation.places]
r0 = [1.0, 1.0, 0.0]
"""
INSTALL = """
set -eu
mount -t binfmt_misc none /proc/sys/fs/binfmt_misc
magic='\\x7fELF\\x02\\x01\\x01\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\x02\\x00\\xb7\\x00'
mask='\\xff\\xff\\xff\\xff\\xff\\xff\\xff\\x00\\xff\\xff\\xff\\xff\\xff\\xff\\xff\\xff\\xfe\\xff\\xff\\xff'
printf '%s' ":aarch64:M::$magic:$mask:$2:F" >/proc/sys/fs/binfmt_misc/register
mount --rbind /proc "$1/proc"
mount --rbind /dev "$1/dev"
mount -t tmpfs none "$1/run"
mkdir -p "$1/run/systemd/system"
exec env -i PATH=/opt/stubs:/usr/sbin:/usr/bin:/bin HOME=/root chroot "$1" \\
    /opt/release/install --name r0 --config /opt/release/swarm.toml
"""
"""In a user namespace of its own, in which programs for arm64 run by qemu-user."""
STUBS = ("systemctl", "systemd-sysusers", "systemd-tmpfiles", "udevadm")
INIT = """#!/bin/busybox sh
/bin/busybox mount -t devtmpfs none /dev
for name in {modules}; do /bin/busybox insmod "/modules/$name"; done
until [ -b /dev/vda ]; do /bin/busybox sleep 0.1; done
/bin/busybox mount -t ext4 /dev/vda /root
exec /bin/busybox switch_root /root /sbin/init
"""
PROBE = """[Unit]
Description=says what it finds
After=swarm.target
Wants=swarm.target
[Service]
Type=simple
Environment=PYTHONPATH=/opt/lab PYTHONUNBUFFERED=1
ExecStart=/opt/swarm/current/bin/python /opt/probe.py
ExecStopPost=/usr/bin/systemctl poweroff --force
StandardOutput=tty
StandardError=tty
TTYPath=/dev/ttyAMA0
[Install]
WantedBy=multi-user.target
"""
MACHINE = (
    *("qemu-system-aarch64", "-M", "virt", "-cpu", "cortex-a53", "-m", "512"),
    *("-display", "none", "-nic", "none", "-no-reboot"),
)
KERNEL = "root=/dev/vda rw panic=-1 console=ttyAMA0 quiet loglevel=3 systemd.show_status=0 net.ifnames=0"


def unpack(root: Path) -> None:
    """Debian's root with the release's files in it, not yet installed."""
    include = f"--include={','.join(PACKAGES)}"
    hook = "--hook-dir=/usr/share/mmdebstrap/hooks/merged-usr"
    options = ["--quiet", "--architectures=arm64", "--variant=extract", "--components=main", hook, include]
    sh("mmdebstrap", *options, recipe.SUITE, root, recipe.MIRROR)
    for name in ("passwd", "group"):  # what the configuration of the packages would make
        shutil.copy(root / f"usr/share/base-passwd/{name}.master", root / "etc" / name)
    certificates = root / "etc/ssl/certs"
    certificates.mkdir(parents=True, exist_ok=True)
    with (certificates / "ca-certificates.crt").open("w") as file:
        for path in sorted((root / "usr/share/ca-certificates/mozilla").glob("*.crt")):
            file.write(path.read_text())
    release = sh(ROOT / "deploy/release", "--machine", "aarch64", "--python", recipe.PYTHON, root / "opt").split()[-1]
    (root / "opt/release").mkdir()
    sh("tar", "-C", root / "opt/release", "--strip-components=1", "-xf", release)
    Path(release).unlink()
    (root / "opt/release/swarm.toml").write_text(CONFIG)
    (root / "opt/stubs").mkdir()
    for name in STUBS:
        path = root / "opt/stubs" / name
        path.write_text('#!/bin/sh\n[ "$1" != show ] || echo 0\n')
        path.chmod(0o755)


def install(root: Path) -> None:
    """The release by its own script, and what makes the root a system that boots into the probe."""
    qemu = shutil.which("qemu-aarch64-static")
    script = root.with_name("install.sh")
    script.write_text(INSTALL)
    sh("unshare", "--user", "--map-root-user", "--mount", "sh", script, root, qemu)
    (users,) = root.glob("opt/swarm/releases/*/systemd/swarm.sysusers")
    sh("sh", "-c", f"systemd-sysusers --root='{root}' - <'{users}'")
    units = root / "etc/systemd/system"
    (units / "multi-user.target.wants").mkdir(parents=True, exist_ok=True)
    (units / "probe.service").write_text(PROBE)
    (units / "multi-user.target.wants/probe.service").symlink_to("/etc/systemd/system/probe.service")
    (units / "default.target").unlink(missing_ok=True)
    (units / "default.target").symlink_to("/usr/lib/systemd/system/multi-user.target")
    for name in recipe.MASKED:
        (units / name).unlink(missing_ok=True)
        (units / name).symlink_to("/dev/null")
    for name, text in (("hostname", "r0\n"), ("fstab", ""), ("machine-id", "0123456789abcdef0123456789abcdef\n")):
        (root / "etc" / name).write_text(text)
    shutil.copy(Path(__file__).with_name("aarch64_probe.py"), root / "opt/probe.py")


def kernel(root: Path, folder: Path) -> tuple[Path, Path]:
    """Debian's kernel, and a file system in memory that leads to the disk."""
    (image,) = (root / "boot").glob("vmlinuz-*")
    version = image.name.removeprefix("vmlinuz-")
    sh("depmod", "-b", root, version)
    tree = folder / "initrd"
    for name in ("bin", "modules", "dev", "root"):
        (tree / name).mkdir(parents=True)
    shutil.copy(root / "usr/bin/busybox", tree / "bin/busybox")
    names = []
    for line in sh("modprobe", "-d", root, "-S", version, "--show-depends", "--all", *MODULES).splitlines():
        word, path = line.split()[:2]
        name = Path(path).name.removesuffix(".xz")
        if word == "insmod" and name not in names:
            data = Path(path).read_bytes()
            (tree / "modules" / name).write_bytes(lzma.decompress(data) if path.endswith(".xz") else data)
            names.append(name)
    (tree / "init").write_text(INIT.format(modules=" ".join(names)))
    (tree / "init").chmod(0o755)
    packed = folder / "initrd.img"
    sh("sh", "-c", f"cd '{tree}' && find . | cpio --quiet -o -H newc >'{packed}'")
    shutil.copy(image, folder / "vmlinuz")
    return folder / "vmlinuz", packed


def boot(folder: Path, what: str, image: Image, initrd: Path, *options: str) -> dict[str, object]:
    """Boot until the probe has ended; what it said."""
    copy = folder / f"machine-{what}.ext4"
    sh("cp", "--sparse=always", image.disk, copy)
    console = folder / f"console-{what}"
    drive = ("-drive", f"file={copy},if=virtio,format=raw")
    start = ("-kernel", str(image.kernel), "-initrd", str(initrd), "-append", f"{KERNEL} probe={what}")
    began = time.monotonic()
    subprocess.run([*MACHINE, *options, *drive, *start, "-serial", f"file:{console}"], check=True, timeout=BOOT_S)
    text = console.read_text(errors="replace")
    print(f"{what}: {time.monotonic() - began:.0f} s of this host")  # noqa: T201
    found = [line for line in text.splitlines() if line.startswith("{")]
    if not found:
        sys.exit(f"the machine said nothing of use:\n{text[-3000:]}")
    return json.loads(found[-1])  # type: ignore[no-any-return]


def main() -> None:
    """See the module."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
    root = folder / "root"
    made = folder / "robots.ext4"
    if not made.exists():
        began = time.monotonic()
        for step in (unpack, install):
            step(root)
            print(f"{step.__name__}: {time.monotonic() - began:.0f} s")  # noqa: T201
        new_key_file(folder / "swarm.key", int(time.time()))
        kernel(root, folder)
        sh("mke2fs", "-q", "-t", "ext4", "-d", root, folder / "plain.ext4", f"{DISK_MB}M")
        plain = Image(folder / "plain.ext4", folder / "vmlinuz", folder / "none")
        disk.robots(plain, folder, CONFIG, folder / "swarm.key")
    image, initrd = Image(made, folder / "vmlinuz", folder / "none"), folder / "initrd.img"
    for what, options in (
        ("units", ("-smp", "4", "-accel", "tcg,thread=multi")),
        ("instructions", ("-smp", "1", "-icount", "shift=0,sleep=off")),
    ):
        for name, value in boot(folder, what, image, initrd, *options).items():
            print(f"{name:<40}{value}")  # noqa: T201


if __name__ == "__main__":
    main()
