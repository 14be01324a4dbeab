"""The doctor's judgements, each of a robot that is well but for one thing; and the checklist for people."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from examined_robots import FILES, RUNS, SERVICES, TEXT, WELL, bus, system

from laptop.fleet.core import doctor
from laptop.fleet.core.checkup import ExaminedRobot
from laptop.fleet.core.texts import with_block
from services.balancer.core import faults
from swarm.config import parse

ROBOTS_FIND_LINKS = parse(
    TEXT.replace('[topology]\nedges = [["r0", "r1"]]\n', 'topology = "auto"\n'), Path("swarm.toml")
)
R1_CALLS = parse(
    TEXT.replace('[["r0", "r1"]]', '[["r0", "r1"], ["r1", "r2"]]')
    + '[[robots]]\nname = "r2"\nbluetooth = "B8:27:EB:00:00:12"\n',
    Path("swarm.toml"),
)


def test_a_robot_that_is_well() -> None:
    found = doctor.examine(WELL)
    assert {name: each.text for name, each in found.items() if each.state != "ok"} == {}


@pytest.mark.parametrize(
    ("check", "state", "part", "robot"),
    [
        ("kernel", "bad", "may crash", replace(WELL, system=system(kernel="6.1.0", kernels=["6.1.0"]))),
        ("clock", "bad", "off by 100 s", replace(WELL, system=system(time=100.0))),
        ("disk", "bad", "20 MB left", replace(WELL, system=system(free={"/": 20_000_000}))),
        ("memory", "warning", "9 MB to be had", replace(WELL, system=system(memory=9_000_000))),
        ("heat", "bad", "too little voltage", replace(WELL, system=system(throttled=0x50005))),
        ("heat", "warning", "81 degrees", replace(WELL, system=system(temperature=81.0))),
        ("heat", "warning", "since it was switched on: throttled", replace(WELL, system=system(throttled=0x40000))),
        ("release", "bad", "no release", replace(WELL, system=system(current=""))),
        ("config", "bad", "is not swarm.toml", replace(WELL, system=system(config="other"))),
        ("config", "bad", "takes itself for r7", replace(WELL, system=system(robot="r7"))),
        ("key", "bad", "others may read it (mode 0644)", replace(WELL, key={"mode": "0644", "owner": "x", "ids": []})),
        ("key", "bad", "belongs to root", replace(WELL, key={"mode": "0600", "owner": "root", "ids": ["1"]})),
        ("key", "bad", "it has no key", replace(WELL, key=None)),
        ("services", "bad", "not running: mesh (exit-code)", replace(WELL, system=system(
            services={**dict.fromkeys(SERVICES, RUNS), "swarm-mesh": {"ActiveState": "failed", "Result": "exit-code"}}
        ))),
        ("services", "warning", "again and again: mesh", replace(WELL, system=system(
            services={**dict.fromkeys(SERVICES, RUNS), "swarm-mesh": {**RUNS, "NRestarts": "7"}}
        ))),
        ("services", "bad", "the bus does not answer", replace(WELL, bus={"bus": False})),
        ("devices", "bad", "I2C, IMU", replace(WELL, bus=bus(balancer_fault={"name": "bus", "reason": "I2C, IMU: x"}))),
        ("devices", "warning", "50 transfers", replace(WELL, bus=bus(
            balancer_state={"mode": "idle", "ticks": 1000, "bus_errors": 50}
        ))),
        ("devices", "bad", "no answer from imu", replace(
            WELL, bus=None, system=system(devices={"problem": "", "imu": None, "atmega": [1, 1], "display": True})
        )),
        ("bus", "warning", "SCL 62 kHz in place of 100", replace(WELL, bus=bus(
            balancer_state={"mode": "idle", "ticks": 1000, "scl": 62.5e3, "behind": ""}
        ))),
        ("bus", "bad", "SCL 40 kHz: no time for uwb, display", replace(WELL, bus=bus(
            balancer_state={"mode": "idle", "ticks": 1000, "scl": 40e3, "behind": "uwb, display"}
        ))),
        ("boot", "bad", "core clock fixed at 400 MHz", replace(WELL, system=system(files={
            **FILES, "/boot/firmware/config.txt": with_block("", [
                "[all]", "dtparam=i2c_arm=on", "dtparam=i2c_arm_baudrate=100000"
            ])
        }))),
        ("devices", "bad", "the IMU says it is 0x6A, an LSM6DS33 is 0x69, an LSM6DSO is 0x6C", replace(
            WELL, bus=None, system=system(devices={"problem": "", "imu": 0x6A, "atmega": [1, 1], "display": True})
        )),
        ("firmware", "bad", "layout 9", replace(WELL, bus=bus(balancer_firmware={"layout": 9, "revision": 1}))),
        ("module", "bad", "it does not answer", replace(WELL, bus=bus(
            dwm_status={"state": "degraded", "reason": "it does not answer"}
        ))),
        ("ranges", "bad", "0 of 1 anchors", replace(WELL, bus=bus(dwm_ranges={"ranges": []}))),
        ("ranges", "bad", "0 of 1", replace(WELL, bus=bus(dwm_ranges={"ranges": [{"anchor": "D001", "stale": True}]}))),
        ("adapter", "bad", "swarm.toml says B8:27:EB:00:00:10", replace(WELL, system=system(
            pairing={"problem": "", "address": "B8:27:EB:00:00:99", "powered": True, "devices": {}}
        ))),
        ("adapter", "bad", "bluetoothd does not run", replace(
            WELL, system=system(pairing={"problem": "bluetoothd does not run"})
        )),
        ("pairing", "warning", "not paired with r1", replace(WELL, system=system(
            pairing={"problem": "", "address": "B8:27:EB:00:00:10", "powered": True, "devices": {}}
        ))),
        ("pairing", "bad", "not paired with r1: it takes no call of r1", replace(
            WELL, config=ROBOTS_FIND_LINKS, addresses={"r1": "B8:27:EB:00:00:0F"}, system=system(
                pairing={"problem": "", "address": "B8:27:EB:00:00:10", "powered": True, "devices": {}}
            )
        )),
        ("pairing", "bad", "not paired with r1: it takes no call of r1", replace(
            WELL, config=R1_CALLS, system=system(
                pairing={"problem": "", "address": "B8:27:EB:00:00:10", "powered": True, "devices": {}}
            )
        )),
        ("links", "bad", "no link to r1 (dead)", replace(WELL, bus=bus(
            mesh_links={"links": [{"peer": "r1", "state": "down", "reason": "dead"}]}
        ))),
        ("links", "bad", "another robot is called r0, too", replace(WELL, bus=bus(mesh_links={
            "links": [{"peer": "r1", "state": "up"}], "clashes": {"r0": "another robot is called r0, too: r1 says so"},
        }))),
        ("body", "bad", "fell: 80 deg", replace(WELL, bus=bus(
            balancer_fault={"name": "fell", "reason": "80 deg", "recovery": "stand"}
        ))),
        ("body", "warning", "it has not found its gyro's zero", replace(WELL, bus=bus(
            balancer_state={"mode": "calibrating", "ticks": 100}
        ))),
        ("battery", "bad", "5.90 V", replace(WELL, bus=bus(balancer_battery={"voltage": 5.9}))),
        ("battery", "warning", "6.50 V", replace(WELL, bus=bus(balancer_battery={"voltage": 6.5}))),
        ("time", "bad", "no time", replace(WELL, bus=bus(mesh_clock={}))),
    ],
)  # fmt: skip
def test_one_thing_is_wrong_and_named(check: str, state: str, part: str, robot: ExaminedRobot) -> None:
    found = doctor.examine(robot)[check]
    assert (found.state, part in found.text) == (state, True), found
    assert found.remedy


@pytest.mark.parametrize(
    ("stopped", "remedy"),
    [
        ({"stopped": True}, faults.RECOVERY["stopped"]),
        ({}, faults.RECOVERY["stopped"]),
        ({"stopped": False}, "swarm balance stand"),
    ],
)
def test_a_robot_that_was_stopped_is_told_to_be_armed_only_while_the_stop_holds(
    stopped: dict[str, bool], remedy: str
) -> None:
    fault = {"name": "stopped", "reason": "stopped: smoke", "recovery": faults.RECOVERY["stopped"]}
    found = doctor.examine(replace(WELL, bus=bus(balancer_fault=fault, mesh_stopped=stopped)))["body"]
    assert (found.text, found.remedy) == ("stopped: smoke", remedy)


def test_a_robot_of_which_nothing_is_known() -> None:
    """No release, no bus, no bluetoothd: each check has something to say all the same."""
    bare = replace(WELL, bus=None, key=None, system=system(current="", services={}, config=None, robot=None))
    assert all(each.text for each in doctor.examine(bare).values())
    simulated = doctor.examine(replace(WELL, system=None, disk=10**9))
    assert not [name for name, each in simulated.items() if each.state in ("bad", "warning")]


def test_what_must_be_the_same_on_all() -> None:
    other = replace(
        WELL, name="r1", system=system(current="1-b"), key={**(WELL.key or {}), "ids": ["00000002"]},
        bus=bus(balancer_firmware={"layout": 2, "revision": 2}),
    )  # fmt: skip
    assert doctor.compare([WELL, replace(WELL, name="r1")]) == []
    assert doctor.compare([WELL, other]) == [
        "different releases (swarm deploy the same to all): 1-a: r0; 1-b: r1",
        "different firmware (swarm flash the same to all): revision 1: r0; revision 2: r1",
        "different keys (swarm deploy --key FILE to all): 00000001: r0; 00000002: r1",
    ]


def test_keys_differ_where_two_robots_have_none_in_common() -> None:
    def having(name: str, *ids: str) -> ExaminedRobot:
        return replace(WELL, name=name, key={**(WELL.key or {}), "ids": list(ids)})

    old, both, new = having("r0", "1"), having("r1", "2", "1"), having("r2", "2")
    assert doctor.compare([old, both]) == doctor.compare([both, new]) == []
    assert doctor.compare([old, both, new]) == [
        "different keys (swarm deploy --key FILE to all): 1: r0; 1 2: r1; 2: r2",
    ]
    assert doctor.compare([both, having("r3", "3")]) == [
        "different keys (swarm deploy --key FILE to all): 1 2: r1; 3: r3",
    ]


def test_the_checklist_is_the_doctors() -> None:
    text = (Path(__file__).parents[4] / "docs/reference/robot/doctor-checks.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| (.+) \|$", text, re.M)
    assert rows == [(check.name, check.question) for check in doctor.CHECKS]
