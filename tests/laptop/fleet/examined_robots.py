"""A robot that is well, as the doctor's examination finds it."""

from pathlib import Path
from typing import Any

from laptop.fleet.core.checkup import ExaminedRobot
from laptop.fleet.core.packages import FIRMWARE
from laptop.fleet.core.settings import CLOUD, LIMITS, LIMITS_TEXT, MODULES, NETWORK_CONF, NETWORK_TEXT
from laptop.fleet.core.texts import with_block
from laptop.fleet.core.wish import PACKAGES
from swarm.config import parse

TEXT = """network = "x"
[topology]
edges = [["r0", "r1"]]
[[robots]]
name = "r0"
bluetooth = "B8:27:EB:00:00:10"
[[robots]]
name = "r1"
bluetooth = "B8:27:EB:00:00:11"
[[anchors]]
address = "D001"
x = 0.0
y = 0.0
[dwm]
source = "balancer"
"""
CONFIG = parse(TEXT, Path("swarm.toml"))
FILES = {
    "/boot/firmware/config.txt": with_block(
        "", ["[all]", "dtparam=i2c_arm=on", "dtparam=i2c_arm_baudrate=100000", "core_freq=400", "core_freq_min=400"]
    ),
    "/boot/firmware/cmdline.txt": "root=x cgroup_enable=memory isolcpus=3\n",
    "/etc/bluetooth/main.conf": "[Policy]\nAutoEnable = true\n"
    "[BR]\nPageScanType = 1\nPageScanInterval = 512\nPageScanWindow = 18\n",
    MODULES: "i2c-dev\n", LIMITS: LIMITS_TEXT, NETWORK_CONF: NETWORK_TEXT,
    "/etc/hosts": "127.0.0.1\tlocalhost\n127.0.1.1\tr0\n", "/etc/hostname": "r0\n", CLOUD: None,
}  # fmt: skip
RUNS = {"LoadState": "loaded", "ActiveState": "active", "NRestarts": "0", "Result": "success"}
SERVICES = ("swarm-bus", "swarm-mesh", "swarm-balancer", "swarm-dwm")


def system(**other: Any) -> dict[str, Any]:
    return {
        "model": "Raspberry Pi Zero 2 W Rev 1.0", "architecture": "arm64", "python": "3.11", "kernel": "6.12.1",
        "os": {"ID": "debian", "VERSION_CODENAME": "bookworm"}, "kernels": ["6.12.1"], "time": 0.0, "current": "1-a",
        "free": {"/": 5_000_000_000}, "there": [], "broken": "", "packages": dict.fromkeys(PACKAGES, "1"),
        "links": dict.fromkeys(FIRMWARE, ""), "files": FILES, "modes": dict.fromkeys(FILES, "0644"), "blocked": [],
        "units": {"bluetooth.service": {"UnitFileState": "enabled"}}, "hostname": "r0", "memory": 200_000_000,
        "temperature": 50.0, "throttled": 0, "services": dict.fromkeys(SERVICES, RUNS), "devices": None,
        "config": "digest", "robot": "r0",
        "pairing": {
            "problem": "", "address": "B8:27:EB:00:00:10", "powered": True,
            "devices": {"B8:27:EB:00:00:11": {"paired": True, "trusted": True}},
        },
    } | other  # fmt: skip


def bus(**other: Any) -> dict[str, Any]:
    topics: dict[str, Any] = {
        "mesh/status": {"state": "ready"}, "dwm/status": {"state": "ready"}, "balancer/status": {"state": "ready"},
        "balancer/state": {"mode": "idle", "fault": "", "ticks": 1000, "bus_errors": 0, "battery_left": 3000.0,
                           "scl": 98e3, "behind": ""},
        "balancer/battery": {"voltage": 7.4}, "balancer/firmware": {"layout": 2, "revision": 1},
        "dwm/ranges": {"ranges": [{"anchor": "D001"}]}, "mesh/links": {"links": [{"peer": "r1", "state": "up"}]},
        "mesh/clock": {"root": "r0", "hop": 0}, "bus": True,
    }  # fmt: skip
    return topics | {name.replace("_", "/", 1): value for name, value in other.items()}


WELL = ExaminedRobot(
    "r0", CONFIG, system(), bus(), digest="digest", addresses={"r1": "B8:27:EB:00:00:11"},
    key={"mode": "0600", "owner": "swarm-mesh", "ids": ["00000001"]},
)  # fmt: skip
