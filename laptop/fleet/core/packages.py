"""Steps about software: Debian's packages from a bundle, the kernel, the radio's firmware."""

from laptop.fleet.core import texts
from laptop.fleet.core.wish import (
    FIRMWARE_PACKAGE,
    KERNEL_PACKAGE,
    MIN_KERNEL,
    DesiredRobot,
    Facts,
    Verdict,
    change,
    failed,
    ok,
)

FIRMWARE = {
    "/lib/firmware/brcm/BCM43430B0.raspberrypi,model-zero-2-w.hcd": "SYN43430B0.hcd",
    "/lib/firmware/brcm/BCM43430A1.raspberrypi,model-zero-2-w.hcd": "SYN43430A1.hcd",
}
"""Names under which the kernel asks for the Zero 2 W's Bluetooth firmware (one for each revision of its chip), and the
files of bluez-firmware that they must lead to."""
SYNAPTICS = "/lib/firmware/synaptics"


def packages(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check Debian's packages. Missing ones come from the bundle, since a robot has no internet."""
    missing = wanted_packages(facts, wish)
    if not missing and not facts["broken"]:
        return ok(" ".join(f"{name} {facts['packages'][name]}" for name in wish.packages))
    repair = {"do": "run", "words": ["dpkg", "--configure", "-a"], "seconds": 600}
    if not missing:
        return change(f"dpkg --configure -a, for {facts['broken']} is half installed", repair)
    if wish.bundle is None:
        suite = facts["os"].get("VERSION_CODENAME", "")
        return failed(f"without {' '.join(missing)}, and no bundle for {suite}: swarm bundle, then --bundle FOLDER")
    if wish.bundle.problem:
        return failed(f"the bundle does not do for {' '.join(missing)}: {wish.bundle.problem}")
    install = {"do": "run", "words": [*apt_get("--yes", "install"), *missing], "seconds": 1200}
    size = sum(wish.bundle.files.values()) / 1e6
    return change(
        f"install {' '.join(missing)} ({len(wish.bundle.files)} packages, {size:.1f} MB)",
        *([repair] if facts["broken"] else []),
        install,
        reboot=bool({KERNEL_PACKAGE, FIRMWARE_PACKAGE} & set(missing)),
    )


def wanted_packages(facts: Facts, wish: DesiredRobot) -> list[str]:
    """Return the packages that the robot lacks: the ones of all robots, the radio's firmware, a newer kernel."""
    missing = [name for name in wish.packages if name not in facts["packages"]]
    if _firmware_missing(facts, wish) and FIRMWARE_PACKAGE not in facts["packages"] and _offers(wish, FIRMWARE_PACKAGE):
        missing.append(FIRMWARE_PACKAGE)
    if wish.bluetooth and _newest_kernel(facts) < MIN_KERNEL and _offers(wish, KERNEL_PACKAGE):
        missing.append(KERNEL_PACKAGE)
    return missing


def _offers(wish: DesiredRobot, package: str) -> bool:
    return wish.bundle is not None and package in wish.bundle.names


def _newest_kernel(facts: Facts) -> tuple[int, int]:
    return max(texts.kernel_version(release) for release in (facts["kernel"], *facts["kernels"]))


CACHE = "/var/cache/balboa-swarm"
"""Where the bundle's packages lie on a robot, as a repository of apt's."""


def apt_get(*words: str) -> list[str]:
    """Return the command apt-get with the bundle for its only source, beside the system's own lists."""
    options = {
        "Dir::Etc::sourcelist": f"{CACHE}/sources.list",
        "Dir::Etc::sourceparts": "/dev/null",
        "Dir::State::lists": f"{CACHE}/lists",
        "Dir::Cache": f"{CACHE}/apt",
        "APT::Sandbox::User": "root",
        "DPkg::Lock::Timeout": "60",
        "Dpkg::Options::": "--force-confold",
    }
    settings = [part for name, value in options.items() for part in ("-o", f"{name}={value}")]
    return ["apt-get", "--quiet", "--no-install-recommends", *settings, *words]


def kernel(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check for a kernel whose RFCOMM survives a call to a robot that is away."""
    least = ".".join(map(str, MIN_KERNEL))
    if texts.kernel_version(facts["kernel"]) >= MIN_KERNEL:
        return ok(facts["kernel"])
    if _newest_kernel(facts) >= MIN_KERNEL:
        newest = max(facts["kernels"], key=texts.kernel_version)
        return change(f"boot {newest}, which is installed ({facts['kernel']} runs)", reboot=True)
    if not wish.bluetooth:
        return ok(f"{facts['kernel']}: older than {least}, but no Bluetooth links")
    if _offers(wish, KERNEL_PACKAGE):
        return change(f"{KERNEL_PACKAGE} of the bundle, for {facts['kernel']} is older than {least}", reboot=True)
    return failed(
        f"{facts['kernel']} may crash when a robot calls one that is absent; {least} is needed: a bundle with "
        f"{KERNEL_PACKAGE} (swarm bundle), or a newer image"
    )


def radio(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that the Zero 2 W's Bluetooth firmware stands under the names that its kernel asks for."""
    if wish.board != "zero2w" or not wish.bluetooth:
        return ok("nothing to do on this board" if wish.bluetooth else "no Bluetooth links")
    if not _firmware_missing(facts, wish):
        return ok("there")
    if wanted := _unlinked(facts):
        return change(
            f"link {' and '.join(wanted.values())}",
            *({"do": "link", "path": path, "to": f"../synaptics/{name}"} for path, name in wanted.items()),
            reboot=True,
        )
    if _offers(wish, FIRMWARE_PACKAGE) and FIRMWARE_PACKAGE not in facts["packages"]:
        return change(f"comes with {FIRMWARE_PACKAGE}", reboot=True)
    return failed(f"there is no {SYNAPTICS}/{next(iter(FIRMWARE.values()))}: a bundle with {FIRMWARE_PACKAGE}")


def _firmware_missing(facts: Facts, wish: DesiredRobot) -> bool:
    if wish.board != "zero2w" or not wish.bluetooth:
        return False
    return bool(_unlinked(facts)) or all(facts["links"][path] is None for path in FIRMWARE)


def _unlinked(facts: Facts) -> dict[str, str]:
    """Return the firmware files that are there, by the names under which the kernel looks for them in vain."""
    return {
        path: name
        for path, name in FIRMWARE.items()
        if facts["links"][path] is None and f"{SYNAPTICS}/{name}" in facts["there"]
    }
