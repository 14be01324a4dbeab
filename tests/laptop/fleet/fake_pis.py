"""Fake robots that look like fresh Raspberry Pis: a root of their own, and commands that only keep a record."""

import hashlib
from pathlib import Path

from fake_robots import FakeRobots

STUBS = {
    "dpkg": """case $1 in
--print-architecture) cat $HOME/architecture ;;
--audit) cat $HOME/audit 2>/dev/null; true ;;
--configure) rm -f $HOME/audit; echo "dpkg $*" >> $HOME/log ;;
esac
""",
    "dpkg-query": """sed -n "s/^$3 /ii |/p" $HOME/installed | grep . || exit 1
""",
    # Installs what the index of the bundle has, when its files are there.
    "apt-get": """debs=$HOME/root/var/cache/balboa-swarm/debs
case " $* " in *' update '*) exit 0 ;; esac
for word; do
    file=$(sed -n "/^Package: $word\\$/,/^\\$/s/^Filename: //p" $debs/Packages)
    version=$(sed -n "/^Package: $word\\$/,/^\\$/s/^Version: //p" $debs/Packages)
    if [ -z "$file" ]; then
        case $word in python3*|bluez*|linux*|rfkill) echo "E: Unable to locate package $word" >&2; exit 100 ;; esac
        continue
    fi
    case " $* " in
    *' --simulate '*) echo "Inst $word ($version balboa-swarm [arm64])" ;;
    *) [ -f $debs/$file ] || { echo "E: no $file" >&2; exit 100; }
       echo "$word $version" >> $HOME/installed; echo "apt $word" >> $HOME/log
       [ $word != linux-image-rpi-v8 ] || mkdir -p $HOME/root/lib/modules/6.12.25+rpt-rpi-v8 ;;
    esac
done
""",
    "systemctl": """echo "systemctl $*" >> $HOME/log
case $1 in
show) cat $HOME/unit-$2 2>/dev/null || echo UnitFileState=disabled ;;
enable) echo UnitFileState=enabled > $HOME/unit-$3 ;;
reboot) echo x >> $HOME/root/boot_id; ls $HOME/root/lib/modules | sort -V | tail -1 > $HOME/root/kernel ;;
esac
""",
    "hostnamectl": 'echo "$2" > $HOME/root/etc/hostname\n',
    "rfkill": "echo 0 > $HOME/root/sys/class/rfkill/rfkill0/soft\n",
    "date": 'echo "date $*" >> $HOME/log\n',
}

OS = 'PRETTY_NAME="{suite}"\nID=debian\nVERSION_CODENAME={suite}\n'
CONFIG_TXT = "# For more options see http://rptl.io/configtxt\ndtparam=audio=on\n[cm4]\notg_mode=1\n[all]\n"
CMDLINE = "console=serial0,115200 console=tty1 root=PARTUUID=1-02 rootfstype=ext4 fsck.repair=yes rootwait\n"

PLACES = {"model": "/model", "kernel": "/kernel", "boot_id": "/boot_id"}
"""Below a fake Pi's root."""


def add_pi(
    robots: FakeRobots,
    name: str,
    *,
    model: str = "Raspberry Pi Zero 2 W Rev 1.0",
    suite: str = "bookworm",
    kernel: str = "6.12.25+rpt-rpi-v8",
    packages: str = "bluez python3 rfkill",
    hook: str = "",
) -> Path:
    """A fresh one; its home folder."""
    home = robots.add(name, hook=hook)
    root = home / "root"
    for command, text in STUBS.items():
        (home / "bin" / command).write_text("#!/bin/sh\n" + text)
        (home / "bin" / command).chmod(0o755)
    (home / "architecture").write_text("arm64\n")
    (home / "installed").write_text("".join(f"{package} 1.0\n" for package in packages.split()))
    files = {
        "model": model + "\0", "kernel": kernel + "\n", "boot_id": "x\n", "etc/os-release": OS.format(suite=suite),
        "etc/hostname": "raspberrypi\n", "etc/hosts": "127.0.0.1\tlocalhost\n127.0.1.1\traspberrypi\n",
        "boot/firmware/config.txt": CONFIG_TXT, "boot/firmware/cmdline.txt": CMDLINE,
        "etc/bluetooth/main.conf": "[General]\n\n[Policy]\n#AutoEnable=true\n",
        "sys/class/rfkill/rfkill0/type": "bluetooth\n", "sys/class/rfkill/rfkill0/soft": "1\n",
        "sys/class/rfkill/rfkill0/hard": "0\n", f"lib/modules/{kernel}/kernel": "",
        "lib/firmware/synaptics/SYN43430B0.hcd": "", "lib/firmware/synaptics/SYN43430A1.hcd": "",
    }  # fmt: skip
    for path, text in files.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text)
    (root / "lib/firmware/brcm").mkdir()
    return home


def make_bundle(folder: Path, packages: str, suite: str = "bookworm", architecture: str = "arm64") -> Path:
    """A bundle of packages that hold nothing."""
    debs = folder / f"{suite}-{architecture}"
    debs.mkdir(parents=True)
    index = ""
    for name in packages.split():
        data = f"the package {name}".encode()
        (debs / f"{name}.deb").write_bytes(data)
        index += f"Package: {name}\nVersion: 2.0\nArchitecture: {architecture}\nFilename: ./{name}.deb\n"
        index += f"Size: {len(data)}\nSHA256: {hashlib.sha256(data).hexdigest()}\n\n"
    (debs / "Packages").write_text(index)
    return folder
