"""Runs inside the booted container, as root, with Debian's own Python and nothing else: installs, breaks, looks.

Each check is a line of JSON in /rig/report: its name, what went wrong (empty where nothing did), what was measured.
`inside.py install` is the first boot, `inside.py reboot` the second. The host asserts (test_boot.py).
"""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from inside_robot import (
    APP,
    DISK,
    RECORDING,
    RIG,
    RUN,
    SERVICES,
    CheckFailed,
    ask,
    back_after,
    expect,
    goes_on,
    iteration,
    module,
    pid,
    ready,
    sh,
    show,
    standing,
    state,
    surroundings,
    ticks,
    untouched,
    wait,
)

QUIET_S = 5.0


# -- checks ------------------------------------------------------------------------------------------------------


def release() -> Path:
    return next(RIG.glob("balboa-swarm-*"))


def refuses_a_wrong_config() -> dict[str, float]:
    # What an installation that was switched off in the middle has left behind.
    half = Path("/opt/swarm/releases") / (release() / "ID").read_text().strip() / "bin"
    half.mkdir(parents=True)
    (half / "python").write_text("#!/bin/sh\nexit 1\n")
    wrong = RIG / "wrong.toml"
    wrong.write_text("network = 3\n")
    sh(str(release() / "install"), "--config", str(wrong), code=2)
    said = sh(str(release() / "install"), "--config", "/rig/r0.toml", "--name", "r7", code=2)
    expect("r7 is no robot of the config" in said, said)
    expect(not Path("/opt/swarm/current").exists(), "something was switched to all the same")
    return {}


def installs() -> dict[str, float]:
    began = time.monotonic()
    sh("/rig/install-first")
    for unit in SERVICES:
        expect(ready(unit), f"{unit} is not active")
    return {"install_s": time.monotonic() - began}


def again_changes_nothing() -> dict[str, float]:
    before = {unit: pid(unit) for unit in SERVICES}
    said = sh(str(release() / "install"), "--config", "/rig/r0.toml", "--name", "r0")
    expect("nothing to do" in said, said)
    expect(before == {unit: pid(unit) for unit in SERVICES}, "services were restarted")
    return {}


def runs_an_app() -> dict[str, float]:
    sh("systemctl", "start", APP)
    wait(lambda: state("app/restless/progress")["phase"] == "running", "the app runs")
    return {}


def everything_talks() -> dict[str, float]:
    """Through the bus, as the services' users: the body stands, the module is heard, the mesh has its link."""
    wait(standing, "the robot stands", 60)
    wait(lambda: state("dwm/pose")["quality"], "there is a pose")
    wait(lambda: [link["state"] for link in state("mesh/links")["links"]] == ["up"], "the link to r1 is up")
    k = iteration()
    wait(lambda: iteration() > k + 10, "the app goes on")
    return {}


def holds_its_privileges() -> dict[str, float]:
    """What the units promise is so: own users, real-time priority and locked memory for the loop alone."""
    users = {unit: Path(f"/proc/{pid(unit)}/status").read_text() for unit in (*SERVICES, APP)}
    for unit, text in users.items():
        # The mesh tells the Bluetooth controller how long silent links are kept: CAP_NET_RAW, bit 13.
        allowed = 1 << 13 if unit == "swarm-mesh" else 0
        expect(int(text.split("\nCapEff:\t")[1].split()[0], 16) == allowed, f"{unit} has other capabilities")
        uid = int(text.split("\nUid:\t")[1].split()[0])
        expect(uid != 0, f"{unit} runs as root")
    # Where the container itself may raise no limits (a host without CAP_SYS_RESOURCE), the loop can have no priority.
    loop = pid("swarm-balancer")
    limits = Path(f"/proc/{loop}/limits").read_text()
    priority = int(limits.split("Max realtime priority")[1].split()[0]) > 0
    if priority:
        policy = os.sched_getscheduler(loop) & ~os.SCHED_RESET_ON_FORK
        expect(policy == os.SCHED_FIFO, "the loop has no real-time priority")
        expect(int(users["swarm-balancer"].split("VmLck:")[1].split()[0]) > 0, "the loop's memory is not locked")
    mode = Path("/etc/swarm/key").stat().st_mode & 0o777
    expect(mode == 0o600, f"the key has mode {mode:o}")
    return {"realtime": float(priority)}


def killed_and_stopped(unit: str) -> dict[str, float]:
    def deed() -> dict[str, float]:
        killed = back_after("KILL", (unit,), 10.0)[unit]
        sh("systemctl", "stop", unit)
        expect(pid(unit) == 0, f"{unit} still runs")
        began = time.monotonic()
        sh("systemctl", "start", "--no-block", unit)
        wait(lambda: ready(unit), f"{unit} is started again")
        return {"killed_s": killed, "started_s": time.monotonic() - began}

    return untouched((unit,), deed)


def the_balancer_is_as_punctual(quiet: Path) -> dict[str, float]:
    """While all other services were killed and hung, it was late no oftener than before: the ticks that it left out.

    Without real-time priority, as in most containers, these are other processes' doing, so there are some at any time.
    """
    done, missed, began, before = json.loads(quiet.read_text())
    ticks_now, missed_now = ticks()
    share = (missed_now - missed) / max(ticks_now - done + missed_now - missed, 1)
    expect(ticks_now > done, "the balancer was started anew")
    expect(share <= 3.0 * before + 0.1, f"{share:.1%} of its ticks were left out, {before:.1%} in the quiet before")
    return {"share_missed": share, "share_missed_before": before, "stretch_s": time.monotonic() - began}


def a_quiet_stretch(quiet: Path) -> dict[str, float]:
    """What the balancer's loop does when nothing happens."""
    done, missed = ticks()
    time.sleep(QUIET_S)
    ticks_now, missed_now = ticks()
    share = (missed_now - missed) / max(ticks_now - done + missed_now - missed, 1)
    quiet.write_text(json.dumps([ticks_now, missed_now, time.monotonic(), share]))
    return {"share_missed": share}


def the_robot_stands_without_a_bus() -> dict[str, float]:
    old = pid("swarm-balancer")
    sh("systemctl", "stop", "swarm-bus")
    time.sleep(1.0)  # the loop's watchdog is fed once a second: three of them would be missed
    expect(pid("swarm-balancer") == old and ready("swarm-balancer"), "the balancer fell with the bus")
    sh("systemctl", "start", "swarm-bus")
    wait(standing, "it tells of itself again", 60)
    goes_on()
    return {}


def a_full_disk_costs_recordings_only() -> dict[str, float]:
    before = {unit: pid(unit) for unit in (*SERVICES, APP)}
    wait(RECORDING.exists, "there is a recording")
    filler = DISK / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(4096)):
            pass
    k, size = iteration(), RECORDING.stat().st_size
    wait(lambda: iteration() > k + 20, "the app goes on")
    expect(before == {unit: pid(unit) for unit in (*SERVICES, APP)}, "services were restarted")
    filler.unlink()
    wait(lambda: RECORDING.stat().st_size > size + 10_000, "the recording goes on")
    return {}


STATUS = """
import dataclasses, json, subprocess
from laptop.cli.robots import status
from laptop.fleet.files import journal
from laptop.fleet.release import versions

def ask(command):
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=True).stdout

row = dataclasses.asdict(status.parse("r0", ask(status.question("r0"))))
row["versions"] = dataclasses.asdict(versions.parse(ask(versions.question("r0"))))
logs = ask(
    f"journalctl --no-pager --lines=200 --output=json --output-fields={journal.FIELDS} --unit='swarm*'"
).splitlines()
row["entries"] = [journal.entry(line) is not None for line in logs].count(True)
row["lines"] = len(logs)
print(json.dumps(row))
"""
"""What `swarm status`, `run` and `fetch` ask a robot by ssh, and how they read it."""


def the_fleet_can_ask_it() -> dict[str, float]:
    wait(standing, "the robot stands", 60)
    found = json.loads(ask(STATUS))
    expect(found["failed"] == [], f"not running: {found['failed']}")
    expect(found["links"] == {"r1": "up"}, f"links: {found['links']}")
    expect(found["battery_v"] and found["battery_left_s"], f"battery: {found['battery_v']} {found['battery_left_s']}")
    # It stood a moment ago; what `standing` says of falls holds here, too.
    expect(found["mode"] in ("balancing", "fault"), f"body: {found['mode']} {found['fault']}")
    expect(found["pose"], "no pose")
    expect(found["apps"]["restless"]["phase"] == "running", f"apps: {found['apps']}")
    expect(found["release"] == Path("/opt/swarm/current").resolve().name, f"release: {found['release']}")
    expect(found["firmware"] == "2.2", f"firmware: {found['firmware']}")
    expect(found["versions"]["release"] == found["release"], f"versions: {found['versions']}")
    expect(found["versions"]["config"] and found["versions"]["firmware"], f"versions: {found['versions']}")
    expect(found["lines"] and found["entries"] == found["lines"], f"{found['entries']} of {found['lines']} log entries")
    return {}


def stops_and_is_armed() -> dict[str, float]:
    """As `swarm estop` and `swarm arm` of a laptop have it done by ssh."""
    swarm = ("env", "SWARM_ROBOT=r0", "SWARM_RUNTIME=/run/swarm", "/opt/swarm/current/bin/swarm")

    def own(*words: str) -> bool:
        done = subprocess.run([*swarm, *words, "--json"], capture_output=True, text=True)
        rows = {row["robot"]: row for row in json.loads(done.stdout)["robots"]}
        return bool(rows["r0"]["confirmed"])

    expect(own("estop", "a test"), "the stop is not confirmed")
    expect(state("balancer/state")["mode"] == "fault", "the motors are on")
    expect(own("arm"), "the stop was not taken back")
    return {}


def a_release_that_does_not_run_is_taken_back() -> dict[str, float]:
    good = Path("/opt/swarm/current").resolve()
    bad = RIG / "bad"
    sh("cp", "-r", str(release()), str(bad))
    (bad / "ID").write_text("0.0.0-bad\n")
    unit = bad / "systemd/swarm-mesh.service"
    # Meanwhile somebody stops the balancer, as `swarm estop` does where a bus does not answer. It stays stopped.
    stop = "ExecStartPre=+systemctl stop --no-block swarm-balancer.service"
    text = unit.read_text().replace("services.mesh", "services.no_such_mesh")
    unit.write_text(text.replace("[Service]", f"[Service]\n{stop}"))
    said = sh(str(bad / "install"), code=1)
    expect("did not come up; back to" in said, said)
    expect("swarm-balancer was stopped meanwhile" in said, said)
    expect(Path("/opt/swarm/current").resolve() == good, "the bad one is still current")
    expect(show("swarm-balancer", "ActiveState")["ActiveState"] == "inactive", "the balancer was started again")
    sh("systemctl", "start", "swarm-balancer")
    for service in SERVICES:
        wait(lambda service=service: ready(service), f"{service} runs again")
    return {}


def memory() -> dict[str, float]:
    """MiB, proportional, of all processes of the services and the app."""
    total = 0
    groups = {show(unit, "ControlGroup")["ControlGroup"] for unit in (*SERVICES, APP)}
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it may end meanwhile
            lines = (process / "cgroup").read_text().splitlines()
            if groups & {line.split(":", 2)[2] for line in lines}:
                total += int((process / "smaps_rollup").read_text().split("\nPss:")[1].split()[0])
    expect(total, "no process was found")
    return {"pss_mib": total / 1024}


def save_recordings(phase: str) -> dict[str, float]:
    """Where the host finds them."""
    (RIG / "k").write_text(str(iteration()))
    shutil.copy(RECORDING, RIG / f"{phase}.mcap")
    return {}


def goes_on_with_the_run() -> dict[str, float]:
    """What was in memory is lost, what it has voted is not: r1, which waited, takes it in where it is itself. That this
    is one epoch later is what the recordings say."""
    before = int((RIG / "k").read_text())
    wait(lambda: state("app/restless/progress")["phase"] == "running" and iteration() > before, "the run goes on", 60)
    return {}


def is_up_after_a_reboot() -> dict[str, float]:
    wait(lambda: all(ready(unit) for unit in (*SERVICES, APP)), "all services are up", 60)
    stamps = [int(show(unit, "ActiveEnterTimestampMonotonic")["ActiveEnterTimestampMonotonic"]) for unit in SERVICES]
    first = int(show("basic.target", "ActiveEnterTimestampMonotonic")["ActiveEnterTimestampMonotonic"])
    return {"boot_s": (max(stamps) - first) / 1e6}


def uninstalls() -> dict[str, float]:
    sh("systemctl", "disable", "--quiet", APP)
    Path("/etc/systemd/system/swarm-balancer.service.d/90-rig.conf").unlink()
    sh(str(release() / "uninstall"))
    units = [path.name for path in Path("/etc/systemd/system").glob("swarm*")]
    expect(not units, f"still there: {units}")
    expect(not Path("/opt/swarm").exists() and not Path("/run/swarm").exists(), "files are left")
    expect(Path("/etc/swarm/swarm.toml").exists(), "the config is gone")
    sh(str(release() / "uninstall"), "--purge")
    expect(not Path("/etc/swarm").exists(), "the config is still there")
    return {}


def report(name: str, check: Callable[[], dict[str, float]]) -> None:
    problem, measured = "", {}
    try:
        measured = check()
    except CheckFailed as error:
        problem = str(error)
    except (OSError, LookupError, ValueError, TypeError):  # a check of ours is wrong: the host must hear of it, too
        problem = traceback.format_exc()
    if problem:
        with contextlib.suppress(CheckFailed):
            problem += "\n" + sh("journalctl", "--no-pager", "--lines=60", "--unit=swarm-*", "--output=short-monotonic")
    with (RIG / "report").open("a") as file:
        file.write(json.dumps({"check": name, "problem": problem, **measured}) + "\n")


def first_boot() -> subprocess.Popen[str]:
    """Install, and lay hands on everything."""
    report("refuses a wrong config", refuses_a_wrong_config)
    (RIG / "install-first").write_text(
        "#!/bin/sh\nexec /rig/balboa-swarm-*/install --name r0 --config /rig/r0.toml --key /rig/swarm.key\n"
    )
    (RIG / "install-first").chmod(0o755)
    report("installs", installs)
    apps = Path("/etc/swarm/apps")
    (apps / "restless.env").write_text("APP=/rig/restless.py\nARGUMENTS=--record " + (RIG / "arguments").read_text())
    process = module()
    report("runs an app", runs_an_app)
    report("everything talks", everything_talks)
    report("again changes nothing", again_changes_nothing)
    report("holds its privileges", holds_its_privileges)
    quiet = RUN / "quiet"
    report("a quiet stretch", lambda: a_quiet_stretch(quiet))
    others = tuple(unit for unit in (*SERVICES, APP) if unit != "swarm-balancer")
    for unit in others:
        report(f"{unit} killed and stopped", lambda unit=unit: killed_and_stopped(unit))
    report("the bus hung", lambda: untouched(others[:1], lambda: back_after("STOP", others[:1], 40.0)))
    report("the balancer is as punctual", lambda: the_balancer_is_as_punctual(quiet))
    report("swarm-balancer killed and stopped", lambda: killed_and_stopped("swarm-balancer"))
    rest = ("swarm-mesh", "swarm-balancer", "swarm-dwm", APP)
    report("all others hung", lambda: untouched(rest, lambda: back_after("STOP", rest, 60.0)))
    report("stands without a bus", the_robot_stands_without_a_bus)
    report("a full disk", a_full_disk_costs_recordings_only)
    report("the fleet can ask it", the_fleet_can_ask_it)
    report("memory", memory)
    report("a release that does not run", a_release_that_does_not_run_is_taken_back)
    report("stops and is armed", stops_and_is_armed)
    report("saves recordings", lambda: save_recordings("install"))
    sh("systemctl", "enable", "--quiet", APP)
    return process


def second_boot() -> subprocess.Popen[str]:
    """Look whether all is there again, and remove it."""
    process = module()
    report("is up after a reboot", is_up_after_a_reboot)
    report("everything talks after it", everything_talks)
    report("goes on with the run", goes_on_with_the_run)
    report("the fleet can ask it after that", the_fleet_can_ask_it)
    report("saves recordings of the second boot", lambda: save_recordings("reboot"))
    report("uninstalls", uninstalls)
    return process


def main() -> None:
    """One boot."""
    phase = sys.argv[1]
    surroundings(phase)
    process = first_boot() if phase == "install" else second_boot()
    process.kill()
    process.wait()
    subprocess.run(["systemctl", "poweroff", "--no-block"], check=False)


if __name__ == "__main__":
    main()
