"""Steps about settings: files of the system, each edited so that what others wrote in it stays."""

from laptop.fleet.core import texts
from laptop.fleet.core.wish import Change, DesiredRobot, Facts, Verdict, change, failed, ok

CONFIG_TXT = ("/boot/firmware/config.txt", "/boot/config.txt")
CMDLINE = ("/boot/firmware/cmdline.txt", "/boot/cmdline.txt")
BLUETOOTH_CONF = "/etc/bluetooth/main.conf"
PAGE_SCAN = {"PageScanType": "1", "PageScanInterval": "512", "PageScanWindow": "18"}
"""Page scans of 2 x 11.25 ms each 0.32 s, in slots, in place of 11.25 ms each 1.28 s: a call is heard four times as
soon. `FastConnectable` has them each 0.16 s, which adds 5 to 8 ms to an iteration of six robots on the slot radio."""

MODULES = "/etc/modules-load.d/swarm.conf"
LIMITS = "/etc/security/limits.d/60-swarm.conf"
NETWORK_CONF = "/etc/NetworkManager/conf.d/60-swarm.conf"
WIFI = "/etc/NetworkManager/system-connections/swarm.nmconnection"
CLOUD = "/etc/cloud/cloud.cfg.d/99-swarm.cfg"
HOSTS = "/etc/hosts"
HOSTNAME = "/etc/hostname"

CORE_MHZ = {"zero2w": 400, "pi4": 500}
"""The core clock at full speed by board (raspberrypi/documentation, config_txt, overclocking). SCL is this
clock over a divider that the kernel sets once; left to itself the clock drops when the Pi is idle, and SCL with it.
`core_freq_min` at the same value keeps it (pelwell in raspberrypi/linux 4884 and 5434)."""

FILES = (*CONFIG_TXT, *CMDLINE, BLUETOOTH_CONF, MODULES, LIMITS, NETWORK_CONF, WIFI, CLOUD, HOSTS, HOSTNAME)
"""All files that are examined."""


def _first(facts: Facts, paths: tuple[str, ...]) -> tuple[str, str] | None:
    """Return the first path that is there, and its text."""
    return next(((path, facts["files"][path]) for path in paths if facts["files"].get(path) is not None), None)


def _file(facts: Facts, path: str, wanted: str, what: str, *then: Change, mode: str = "0644") -> Verdict:
    """Check that `path` holds the text `wanted` with this mode."""
    if facts["files"].get(path) == wanted and facts["modes"].get(path) == mode:
        return ok(what)
    return change(what, {"do": "write", "path": path, "text": wanted, "mode": mode}, *then)


def _edited(path: str, before: str, after: str, what: str) -> Verdict:
    if before == after:
        return ok(what)
    return change(what, {"do": "write", "path": path, "text": after, "mode": "0755"}, reboot=True)


def boot(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check config.txt: I2C is on at its speed, the core clock behind it is fixed, and the UART is on where the DWM1001
    is wired to it."""
    found = _first(facts, CONFIG_TXT)
    if found is None:
        return failed(f"there is no {CONFIG_TXT[0]}: is this Raspberry Pi OS?")
    lines = ["[all]", "dtparam=i2c_arm=on", f"dtparam=i2c_arm_baudrate={1000 * wish.i2c_clock}"]
    core = CORE_MHZ[wish.board]
    lines += [f"core_freq={core}", f"core_freq_min={core}"]
    if wish.uart:
        lines.append("enable_uart=1")
    what = f"I2C at {wish.i2c_clock} kHz, core clock fixed at {core} MHz" + (", UART on" if wish.uart else "")
    return _edited(*found, texts.with_block(found[1], lines), what)


def cmdline(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check cmdline.txt: limits of memory are in force, the balancer has a core, and nothing else uses the DWM1001's
    UART."""
    found = _first(facts, CMDLINE)
    if found is None:
        return failed(f"there is no {CMDLINE[0]}: is this Raspberry Pi OS?")
    remove = ["isolcpus=.*"]
    what = "memory limits, core 3 for the balancer"
    if wish.uart:
        remove.append("console=(serial0|ttyAMA0|ttyS0)(,.*)?")
        what += ", no console at the UART"
    return _edited(*found, texts.with_words(found[1], ["cgroup_enable=memory", "isolcpus=3"], remove), what)


def i2c(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that the module behind /dev/i2c-1 is loaded on boot."""
    what = "i2c-dev is loaded on boot"
    verdict = _file(facts, MODULES, "i2c-dev\n", what)
    return change(what, *verdict.changes, reboot=True) if verdict.changes else verdict


def bluetooth(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that bluetoothd runs on boot, the adapter is powered, no radio is blocked, and calls are heard soon."""
    if not wish.bluetooth:
        return ok("no Bluetooth links")
    if "bluetooth!" in facts["blocked"]:
        return failed("the radio is switched off by hardware (rfkill: hard blocked)")
    changes: list[Change] = []
    text = facts["files"].get(BLUETOOTH_CONF) or ""
    wanted = texts.with_setting(text, "Policy", "AutoEnable", "true")
    for key, value in PAGE_SCAN.items():
        wanted = texts.with_setting(wanted, "BR", key, value)
    if wanted != text:
        changes += [
            {"do": "write", "path": BLUETOOTH_CONF, "text": wanted, "mode": "0644"},
            {"do": "run", "words": ["systemctl", "try-restart", "bluetooth.service"]},
        ]
    if "bluetooth" in facts["blocked"]:
        changes.append({"do": "run", "words": ["rfkill", "unblock", "bluetooth"]})
    if facts["units"]["bluetooth.service"].get("UnitFileState") != "enabled":
        changes.append({"do": "run", "words": ["systemctl", "enable", "--now", "bluetooth.service"]})
    what = "bluetoothd on boot, adapter powered, calls heard within 0.32 s"
    return change(what, *changes) if changes else ok(what)


LIMITS_TEXT = """# Balboa Swarm: who is in this group may run the balancer by hand, as its service does.
@swarm - rtprio 40
@swarm - memlock unlimited
"""


def realtime(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that members of the group swarm have real-time priority and locked memory; services have theirs by their
    units."""
    return _file(facts, LIMITS, LIMITS_TEXT, "priority 40 and locked memory for the group swarm")


NETWORK_TEXT = """# Balboa Swarm: a sleeping radio answers ssh late, and shares its antenna with Bluetooth.
[connection]
wifi.powersave = 2
"""


def network(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that Wi-Fi does not sleep, and that the robot joins the network where one was given."""
    verdicts = [_file(facts, NETWORK_CONF, NETWORK_TEXT, "Wi-Fi does not sleep")]
    if wish.wifi is not None:
        what = f"joins {wish.wifi[0]}"
        reload = {"do": "run", "words": ["nmcli", "connection", "reload"]}
        verdicts.append(_file(facts, WIFI, wifi_text(*wish.wifi), what, reload, mode="0600"))
    changes = tuple(each for verdict in verdicts for each in verdict.changes)
    what = ", ".join(verdict.text for verdict in verdicts)
    return change(what, *changes) if changes else ok(what)


def wifi_text(name: str, password: str) -> str:
    """Return a connection in NetworkManager's keyfile format (a backslash and a leading space are written escaped)."""

    def escaped(text: str) -> str:
        text = text.replace("\\", "\\\\")
        return "\\s" + text[1:] if text.startswith(" ") else text

    return (
        "[connection]\nid=swarm\ntype=wifi\nautoconnect=true\n\n"
        f"[wifi]\nmode=infrastructure\nssid={escaped(name)}\n\n"
        f"[wifi-security]\nkey-mgmt=wpa-psk\npsk={escaped(password)}\n\n"
        "[ipv4]\nmethod=auto\n\n[ipv6]\nmethod=auto\n"
    )


CLOUD_TEXT = """# Balboa Swarm: cloud-init would set the image's name again.
preserve_hostname: true
manage_etc_hosts: false
"""


def name(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that the host's name is the robot's, by which others, logs and the prompt call it."""
    changes: list[Change] = []
    if facts["hostname"] != wish.robot or (facts["files"].get(HOSTNAME) or "").strip() != wish.robot:
        changes.append({"do": "run", "words": ["hostnamectl", "set-hostname", wish.robot]})
    hosts = facts["files"].get(HOSTS) or ""
    if (wanted := texts.with_host(hosts, wish.robot)) != hosts:
        changes.insert(0, {"do": "write", "path": HOSTS, "text": wanted, "mode": "0644"})
    if "/etc/cloud" in facts["there"] and facts["files"].get(CLOUD) != CLOUD_TEXT:
        changes.append({"do": "write", "path": CLOUD, "text": CLOUD_TEXT, "mode": "0644"})
    return change(f"{facts['hostname']} becomes {wish.robot}", *changes) if changes else ok(wish.robot)
