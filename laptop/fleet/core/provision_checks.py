"""Steps that look whether a machine can be a robot at all, before anything on it is changed."""

from laptop.fleet.core.wish import BOARDS, MIN_FREE, SUITES, DesiredRobot, Facts, Verdict, change, failed, ok
from swarm.config.types import DEFAULT_KEY_FILE


def board(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that the board is one we know, and the one of swarm.toml."""
    model = facts["model"]
    found = next((name for begin, name in BOARDS.items() if model.startswith(begin)), None)
    if found is None:
        return failed(f"{model or 'no Raspberry Pi'}: robots are {' or '.join(BOARDS)}")
    if found != wish.board:
        return failed(f'{model}, but swarm.toml says board = "{wish.board}" of {wish.robot}: mend one of them')
    return ok(model)


def system(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check for Raspberry Pi OS, 64 bit, Bookworm or Trixie, with its own Python."""
    name, architecture = facts["os"].get("VERSION_CODENAME", ""), facts["architecture"]
    advice = "flash Raspberry Pi OS Lite (64 bit), Bookworm or Trixie"
    if facts["os"].get("ID") not in ("debian", "raspbian") or name not in SUITES:
        return failed(f"{facts['os'].get('PRETTY_NAME', 'unknown system')}: {advice}")
    if architecture != wish.architecture:
        return failed(f"its programs are {architecture or 'of an unknown kind'}, not {wish.architecture}: {advice}")
    if tuple(map(int, facts["python"].split("."))) < (3, 11):
        return failed(f"its python3 is {facts['python']}, 3.11 or later is needed: {advice}")
    return ok(f"{name} {architecture}, Python {facts['python']}")


def disk(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that there is room for packages and releases."""
    need = dict(MIN_FREE)
    if wish.bundle is not None:
        need["/"] += 5 * sum(wish.bundle.files.values())  # a package's file, and what it unpacks to
    if facts["current"]:
        need["/"] -= 200_000_000  # the releases are there already
    for path, least in need.items():
        free = facts["free"].get(path)
        if free is not None and free < least:
            return failed(f"{path} has {free / 1e6:.0f} MB left, {least / 1e6:.0f} are needed: remove what is not")
    return ok(f"{(facts['free'].get('/') or 0) / 1e6:.0f} MB left")


def key(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that the robot has the swarm's key, or that the key comes with the release."""
    if wish.key_file is None:
        return ok("none: swarm.toml says insecure")
    if wish.key_file in facts["there"] or wish.key:
        return ok("comes with the release" if wish.key else "there")
    if wish.key_file != DEFAULT_KEY_FILE:
        return failed(f"it has no {wish.key_file}, which [mesh] key names: copy the key there, or remove that line")
    return failed("it has no key of the swarm, and none was given: --key FILE (swarm key new makes one)")


def address(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check that ssh still reaches the robot once it has its name."""
    host = wish.address.rpartition("@")[2]
    if host.endswith(".local") and host != f"{wish.robot}.local" and facts["hostname"] != wish.robot:
        return failed(f"{host} will be {wish.robot}.local once it has its name: give its number, NAME=USER@ADDRESS")
    return ok(wish.address)


CLOCK_S = 30.0
"""Largest error of a robot's clock, s. Beyond it, logs and recordings of robots cannot be compared."""


def clock(facts: Facts, wish: DesiredRobot) -> Verdict:
    """Check the wall clock: a Pi has none of its own, and robots have no NTP."""
    off = facts["time"] - wish.now
    if abs(off) <= CLOCK_S:
        return ok("right")
    return change(f"it is off by {off:.0f} s", {"do": "run", "words": ["date", "--utc", "--set", f"@{wish.now:.0f}"]})
