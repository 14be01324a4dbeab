"""Runs inside the machine of tools/aarch64_machine.py, as root: prints what it finds as one line of JSON."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from swarm.bus.zenoh_bus import Bus
from swarm.messages import BalancerState, SetMode
from swarm.messages.codec import decode

SERVICES = ("swarm-bus", "swarm-mesh", "swarm-balancer", "swarm-dwm")
PATIENCE_S = 600.0
WATCHED_S = 10.0
"""Seconds over which rates are taken."""
PER_SECOND = 1e9
"""Instructions in a second of the machine's clock."""
found: dict[str, str] = {}


def show(unit: str, name: str) -> str:
    """A property of a unit."""
    words = ["systemctl", "show", unit, f"--property={name}", "--value"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def until(what: str, condition: Callable[[], object]) -> None:
    """Wait for it; end this program where it does not happen."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > PATIENCE_S:
            sys.exit(f"not within {PATIENCE_S:.0f} s: {what}")
        time.sleep(0.2)


def processes(unit: str) -> list[int]:
    """Those of a service."""
    path = Path("/sys/fs/cgroup", show(unit, "ControlGroup").strip("/"), "cgroup.procs")
    return [int(word) for word in path.read_text().split()]


def status(process: int) -> dict[str, str]:
    """/proc/PID/status."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def memory(unit: str) -> float:
    """Proportional set size of its processes, MiB."""
    total = 0
    for process in processes(unit):
        for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                total += int(line.split()[1])
    return total / 1024


def busy(unit: str) -> float:
    """Seconds of CPU time that its processes have taken."""
    threads = [path for process in processes(unit) for path in Path(f"/proc/{process}/task").iterdir()]
    return sum(int((path / "schedstat").read_text().split()[0]) for path in threads) / 1e9


def units() -> None:
    """What the units promise."""
    free = int(next(line for line in Path("/proc/meminfo").read_text().splitlines() if "MemAvail" in line).split()[1])
    total = 0.0
    for unit in SERVICES:
        main = int(show(unit, "MainPID"))
        said, size = status(main), memory(unit)
        total += size
        limit = int(Path("/sys/fs/cgroup", show(unit, "ControlGroup").strip("/"), "memory.max").read_text()) >> 20
        scheduler = os.sched_getscheduler(main) & ~os.SCHED_RESET_ON_FORK
        mounts = [line.split() for line in Path(f"/proc/{main}/mountinfo").read_text().splitlines()]
        whole = [line[5].split(",")[0] for line in mounts if line[4] == "/"]
        found[unit] = ", ".join(
            (
                f"{size:.1f} of {limit} MiB",
                f"user {show(unit, 'User')}",
                f"capabilities {said['CapEff'].lstrip('0') or 'none'}",
                f"no new privileges {said['NoNewPrivs']}",
                f"seccomp {said['Seccomp']}",
                f"locked {said['VmLck']}",
                "SCHED_FIFO" if scheduler == os.SCHED_FIFO else "SCHED_OTHER",
                f"processors {said['Cpus_allowed_list']}",
                f"the system's files {'read-only' if whole[-1:] == ['ro'] else 'writable'}",
            )
        )
    found["all services"] = f"{total:.1f} MiB proportional; {free >> 10} MiB of the machine available"


def instructions() -> None:
    """How much a tick takes, and what the services take besides."""
    last: dict[str, BalancerState] = {}
    with Bus.of(Path("/run/swarm")) as bus:
        bus.wait_connected(60.0)
        bus.subscribe("swarm/r0/balancer/state", lambda key, data: last.update(s=decode(BalancerState, data, key)))
        until("the balancer speaks", lambda: "s" in last)
        until("it is ready", lambda: last["s"].mode in ("idle", "fault"))
        for mode in ("idle", "standing"):
            if mode == "standing":
                bus.publish("swarm/r0/balancer/set/mode", SetMode("stand"))
                time.sleep(8.0)
            loop = int(show("swarm-balancer", "MainPID"))
            began, ticks, before = time.monotonic(), last["s"].ticks, {unit: busy(unit) for unit in SERVICES}
            thread = Path(f"/proc/{loop}/task/{loop}/schedstat")
            own = int(thread.read_text().split()[0])
            time.sleep(WATCHED_S)
            took, done = time.monotonic() - began, last["s"].ticks - ticks
            own = int(thread.read_text().split()[0]) - own
            found[f"{mode}: the loop, a tick"] = f"{own / max(done, 1) / 1e6:.2f} million instructions"
            found[f"{mode}: ticks a second"] = f"{done / took:.1f}, mode {last['s'].mode}, {last['s'].missed} missed"
            for unit in SERVICES:
                rate = (busy(unit) - before[unit]) / took * PER_SECOND
                found[f"{mode}: {unit}"] = f"{rate / 1e6:.1f} million instructions a second"


def main() -> None:
    """What this boot is for, by the kernel's command line."""
    what = Path("/proc/cmdline").read_text().split("probe=")[1].split()[0]
    until("all services are up", lambda: all(show(unit, "ActiveState") == "active" for unit in SERVICES))
    found["boot to ready"] = f"{float(Path('/proc/uptime').read_text().split()[0]):.1f} s by the machine's clock"
    found["machine"] = f"{os.uname().machine}, Linux {os.uname().release}, Python {sys.version.split()[0]}"
    try:
        {"units": units, "instructions": instructions}[what]()
    finally:
        print("\n" + json.dumps(found), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
