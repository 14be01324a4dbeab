"""Checks of a robot's devices and radio, by what its services say of them."""

from laptop.fleet.core.checkup import SIMULATED, Check, ExaminedRobot, Finding, bad, ok, recovery, skipped, warning
from laptop.fleet.core.pairing import bluetooth_links
from services.balancer.core.control.controller import CALIBRATING, STARTING
from services.balancer.core.devices import balboa, imu
from services.mesh.core.routing.physical_links import calls_of

LOW_SCL = 0.9
"""Share of the configured I2C clock. If the bus is slower, the Pi's core clock is below its full speed."""


def devices(robot: ExaminedRobot) -> Finding:
    """Check that IMU and ATmega answer."""
    fault = robot.said("balancer/fault")
    if fault.get("name") in ("bus", "device"):
        return bad(f"{fault['reason']}", "power of the Balboa, seat of the Pi on its header; then: swarm balance stand")
    state = robot.said("balancer/state")
    if state.get("mode") == "starting":
        return bad("the balancer is still looking for IMU and ATmega", "power of the Balboa on? swarm logs balancer")
    if state:
        errors = int(state.get("bus_errors") or 0)
        ticks = max(int(state.get("ticks") or 1), 1)
        if errors > 20 and errors > ticks / 200:
            return warning(
                f"{errors} transfers of {ticks} ticks failed",
                "seat of the Pi on its header; docs/reference/robot/i2c-bus.md",
            )
        return ok(f"both answer, {errors} failed transfers")
    if robot.system is None or robot.system["devices"] is None:
        return bad("the balancer says nothing", "swarm logs balancer")
    return _scanned(robot.system["devices"])


def _scanned(found: dict[str, object]) -> Finding:
    """Return the finding of our own look at the bus, where the balancer does not run."""
    if found["problem"]:
        return bad(f"/dev/i2c-1: {found['problem']}", "swarm provision switches I2C on")
    silent = [name for name in ("imu", "atmega") if found[name] is None]
    if silent:
        return bad(f"no answer from {' and '.join(silent)}", "power of the Balboa, seat of the Pi on its header")
    if found["imu"] not in imu.IDENTITIES:
        known = ", ".join(f"an {name} is 0x{identity:02X}" for identity, name in imu.IDENTITIES.items())
        return bad(f"the IMU says it is 0x{found['imu']:02X}, {known}", "another board, or a bad contact")
    return ok("both answer")


def bus_clock(robot: ExaminedRobot) -> Finding:
    """Check that the I2C bus is as fast as it was told to be, and has time for all that the balancer does with it.

    The balancer times the transfers of each control step, whose bytes are known.
    """
    state = robot.said("balancer/state")
    clock, behind = float(state.get("scl") or 0.0), str(state.get("behind") or "")
    if not clock:
        return skipped("the balancer tells no clock")
    text = f"SCL {clock / 1e3:.0f} kHz"
    mend = "swarm provision fixes the core clock in config.txt, then reboot; docs/reference/robot/i2c-bus.md"
    if behind:
        return bad(f"{text}: no time for {behind}", mend)
    wanted = robot.config.robot(robot.name).i2c_clock
    if clock < LOW_SCL * 1e3 * wanted:
        return warning(f"{text} in place of {wanted}", mend)
    return ok(text)


def firmware(robot: ExaminedRobot) -> Finding:
    """Check that the ATmega runs our firmware."""
    said = robot.said("balancer/firmware")
    scanned = None if robot.system is None else (robot.system["devices"] or {}).get("atmega")
    if said:
        layout, revision = said["layout"], said["revision"]
    elif scanned:
        layout, revision = scanned
    else:
        return warning("it does not tell", "see devices; swarm logs balancer names the revision")
    if layout != balboa.LAYOUT_VERSION:
        return bad(f"layout {layout}, the balancer needs {balboa.LAYOUT_VERSION}", "swarm flash")
    return ok(f"layout {layout}, revision {revision}")


def module(robot: ExaminedRobot) -> Finding:
    """Check that the DWM1001 answers."""
    status = robot.said("dwm/status")
    if not status:
        return bad("the dwm service says nothing", "swarm logs dwm")
    if status.get("state") == "degraded":
        return bad(
            str(status.get("reason") or "it does not tell why"),
            "swarm dwm check says more; power, wires and port of the module",
        )
    return ok("it answers")


def ranges(robot: ExaminedRobot) -> Finding:
    """Check that three anchors are in sight."""
    if not robot.config.anchors:
        return skipped("swarm.toml has no anchors")
    if robot.config.robot(robot.name).uwb_role == "anchor":
        return skipped("its module is an anchor")
    rows = robot.said("dwm/ranges").get("ranges") or []
    known = {anchor.address for anchor in robot.config.anchors}
    seen = sorted({str(row.get("anchor")) for row in rows if not row.get("stale")} & known)
    if len(seen) < min(3, len(known)):
        return bad(f"{len(seen)} of {len(known)} anchors in sight", "power of the anchors; swarm dwm check says more")
    return ok(f"{' '.join(seen)}")


def adapter(robot: ExaminedRobot) -> Finding:
    """Check that the Bluetooth adapter is there, and that it is the one that swarm.toml names."""
    if robot.config.robot(robot.name).link is not None:
        return skipped("its links are not Bluetooth's")
    found = robot.facts["pairing"]
    if found is None:
        return SIMULATED
    if found["problem"]:
        # At some boots the controller of a Zero 2 W answers the kernel too late (raspberrypi/linux issue 6462).
        log = "swarm command 'dmesg | grep Bluetooth' (where it says -110, reboot the robot)"
        return bad(found["problem"], f"swarm provision; firmware: the check `radio`; {log}")
    said = robot.config.robot(robot.name).bluetooth
    if said is None:
        return bad(f"{found['address']}, swarm.toml has no address of it", "swarm pair writes it")
    if found["address"] != said:
        return bad(f"{found['address']}, swarm.toml says {said}", "mend swarm.toml: is it another robot?")
    if not found["powered"]:
        return bad(f"{said} is not powered", "swarm provision; rfkill list there")
    return ok(said)


def _is_bonded(device: dict[str, object] | None) -> bool:
    """Return whether bluetoothd is paired with a device and trusts it. None is a device that it does not know."""
    return device is not None and bool(device.get("paired") and device.get("trusted"))


def pairing(robot: ExaminedRobot) -> Finding:
    """Check that the robot is paired with all robots that may have a link with it, and trusts them."""
    its = robot.facts["pairing"]
    if its is None or robot.config.robot(robot.name).link is not None:
        return skipped("its links are not Bluetooth's")
    known = its.get("devices") or {}
    pairs = [edge for edge in bluetooth_links(robot.config, robot.config.names) if robot.name in edge]
    near = [b if a == robot.name else a for a, b in pairs]
    missing = [name for name in near if not _is_bonded(known.get(robot.addresses.get(name)))]
    if not missing:
        return ok(f"{' '.join(near) or 'no neighbours'}")
    text = f"not paired with {' '.join(missing)}"
    if robot.config.mesh.rfcomm_encrypt:
        return bad(text, "swarm pair")
    # bluetoothd takes calls of devices alone that it is paired with. Where the mesh does not say who calls, the lower
    # address does.
    own, calls = its.get("address", ""), calls_of(robot.config)
    if deaf := [
        name
        for name in missing
        if (name, robot.name) in calls or ((robot.name, name) not in calls and robot.addresses.get(name, own) < own)
    ]:
        return bad(f"{text}: it takes no call of {' '.join(deaf)}", "swarm pair")
    return warning(f"{text}: they take no call of it", "swarm pair")


def links(robot: ExaminedRobot) -> Finding:
    """Check that the mesh has all of its links, and that each name is that of one robot."""
    if clashes := robot.said("mesh/links").get("clashes"):
        return bad(
            "; ".join(text for _, text in sorted(clashes.items())),
            "is an SD card a copy, or a second swarm with this key in range? "
            "docs/explanation/two-robots-with-one-name.md",
        )
    wanted = robot.config.neighbours(robot.name)
    rows = robot.said("mesh/links").get("links")
    if rows is None:
        if not wanted and not robot.config.auto:
            return skipped("it has no neighbours")
        return bad("the mesh says nothing of its links", "swarm logs mesh")
    down = {str(row["peer"]): row for row in rows if row["state"] != "up"}
    if down:
        reasons = ", ".join(f"{peer} ({row.get('reason') or row['state']})" for peer, row in down.items())
        return bad(
            f"no link to {reasons}", "is it switched on, in range, with the same key? swarm mesh; swarm doctor there"
        )
    return ok(f"{len(rows)} up")


def body(robot: ExaminedRobot) -> Finding:
    """Check that the balancer has found its gyro's zero, and has no fault."""
    state, fault = robot.said("balancer/state"), robot.said("balancer/fault")
    if not state:
        return bad("the balancer says nothing", "swarm logs balancer")
    if fault.get("name") or state.get("fault"):
        name, text = str(fault.get("name") or "fault"), str(fault.get("reason") or state.get("fault"))
        remedy = recovery(fault, robot.said("mesh/stopped")) or "docs/reference/robot/balancer.md, faults"
        return bad(text if text.startswith(name) else f"{name}: {text}", remedy)
    if state.get("mode") in (STARTING, CALIBRATING):
        return warning(f"{state['mode']}: it has not found its gyro's zero", "leave it alone for 2 s, then look again")
    return ok(str(state.get("mode") or "it does not tell its mode"))


def battery(robot: ExaminedRobot) -> Finding:
    """Check that the batteries are charged."""
    volts = robot.said("balancer/battery").get("voltage", robot.said("balancer/state").get("battery"))
    if volts is None:
        return bad("its voltage is not read", "see devices")
    limits = robot.config.balancing_of(robot.name)
    left = robot.said("balancer/state").get("battery_left")
    text = f"{volts:.2f} V" + ("" if left is None else f", about {left / 60:.0f} min")
    if volts < limits.battery_limit:
        return bad(text, "charge or change the batteries: it does not stand up")
    if volts < limits.battery_warning:
        return warning(text, "charge the batteries soon")
    return ok(text)


def time(robot: ExaminedRobot) -> Finding:
    """Check that the swarm's common time is known."""
    said = robot.said("mesh/clock")
    if not said:
        return bad("the mesh tells no time", "swarm logs mesh")
    return ok(f"that of {said['root']}, {said['hop']} links away")


CHECKS = (
    Check("devices", "IMU and ATmega answer on the I2C bus", devices),
    Check("bus", "the I2C bus has its clock, and time for all tasks", bus_clock),
    Check("firmware", "the ATmega runs this project's firmware", firmware),
    Check("body", "the balancer has found its zero and has no fault", body),
    Check("battery", "the batteries are charged", battery),
    Check("module", "the DWM1001 answers", module),
    Check("ranges", "at least three anchors are in sight", ranges),
    Check("adapter", "the Bluetooth adapter is the one that swarm.toml names", adapter),
    Check("pairing", "all neighbours are paired and trusted", pairing),
    Check("links", "the mesh has all of its links", links),
    Check("time", "the swarm's common time is known", time),
)
