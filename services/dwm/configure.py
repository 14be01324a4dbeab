"""Reading how a module is set up, and setting it up: role, update rates, place."""

from dataclasses import replace

from services.dwm.core.module import calls
from services.dwm.core.module.calls import UWB_ACTIVE, ModuleStatus, Settings, UpdateRate, Version
from services.dwm.core.module.tlv import Position
from services.dwm.line import ModuleConnection, restart
from swarm.config.types import Config
from swarm.frozen import frozen

FASTEST = UpdateRate(1, 1)
"""The rate of 10 Hz, also while the robot stands still: a balancing robot stands still and needs its place."""


@frozen
class ModuleInfo:
    """The settings that a module tells when it is asked."""

    identity: int
    """The module's 64-bit id. Its low 16 bits are the short address."""
    version: Version
    settings: Settings
    rate: UpdateRate
    place: Position
    """The place that is stored in an anchor, or that a tag computes."""
    status: ModuleStatus

    @property
    def address(self) -> str:
        """Short address, as printed."""
        return f"{self.identity & 0xFFFF:04X}"


@frozen
class DesiredModule:
    """The desired settings of a module."""

    anchor: bool
    initiator: bool | None = None
    """Whether the anchor starts the network; None: leave it as it is."""
    rate: UpdateRate = FASTEST
    place: Position | None = None
    """The place of an anchor; None: leave it as it is."""


def inspect(line: ModuleConnection) -> ModuleInfo:
    """Ask for everything; raises `NoAnswerError`."""
    version = line.ask(calls.VER_GET)
    return ModuleInfo(
        line.ask(calls.NODE_ID_GET),
        version,
        line.ask(calls.CFG_GET),
        line.ask(calls.UPD_RATE_GET),
        line.ask(calls.POS_GET),
        line.ask(calls.STATUS_GET),
    )


def wish_of(config: Config | None, address: str) -> DesiredModule | None:
    """Return the desired settings of the module with this address by swarm.toml; None where the file does not have it.

    A robot that serves as an anchor at a place of its own is in [[anchors]], too.
    """
    if config is None:
        return None
    places = {anchor.address: Position(anchor.x, anchor.y, anchor.z, 100) for anchor in config.anchors}
    robot = config.robots_by_module.get(address)
    if robot is not None:
        anchor = config.robot(robot).uwb_role == "anchor"
        return DesiredModule(anchor, place=places.get(address) if anchor else None)
    if address in places:
        return DesiredModule(True, place=places[address])
    return DesiredModule(True) if address == config.dwm.target else None


def wanted(settings: Settings, wish: DesiredModule) -> Settings:
    """Return the settings that fulfil a wish; what it says nothing of stays (LEDs, Bluetooth, encryption)."""
    common = replace(settings, anchor=wish.anchor, uwb=UWB_ACTIVE, measurement=0)
    if wish.anchor:
        initiator = settings.initiator if wish.initiator is None else wish.initiator
        return replace(common, initiator=initiator, low_power=False, engine=False, stationary=False)
    return replace(common, initiator=False, bridge=False, low_power=False, engine=True, stationary=False)


def apply(line: ModuleConnection, wish: DesiredModule) -> list[str]:
    """Set a module up; gives what was changed, in words. Nothing is written that is right already: flash wears out.

    Raises `NoAnswerError`, `LocalError` for what no module can be.
    """
    before = inspect(line)
    changes = []
    settings = wanted(before.settings, wish)
    if not _fulfils(before.settings, settings):
        line.ask(calls.cfg_set(settings))
        changes.append(f"{_role(before.settings)} -> {_role(settings)}")
    if not wish.anchor and before.rate != wish.rate:
        line.ask(calls.upd_rate_set(wish.rate))
        changes.append(f"update rate {_rate(before.rate)} -> {_rate(wish.rate)}")
    if wish.place is not None and (not _same(before.place, wish.place) or not before.settings.anchor):
        line.ask(calls.pos_set(wish.place))
        changes.append(f"place ({wish.place.x:g}, {wish.place.y:g}, {wish.place.z:g}) m")
    if changes:
        restart(line)
    return changes


def unfulfilled(info: ModuleInfo, wish: DesiredModule) -> list[str]:
    """Return in words which parts of a wish are not fulfilled."""
    missing = []
    settings = wanted(info.settings, wish)
    if not _fulfils(info.settings, settings):
        missing.append(f"it is {_role(info.settings)}, not {_role(settings)}")
    if not wish.anchor and info.rate != wish.rate:
        missing.append(f"its update rate is {_rate(info.rate)}, not {_rate(wish.rate)}")
    if wish.place is not None and not _same(info.place, wish.place):
        missing.append("its place is another")
    return missing


def _same(place: Position | None, wish: Position) -> bool:
    """Return whether a module with this place has the wished one: it holds whole mm."""
    if place is None:
        return False
    return all(abs(a - b) < 0.001 for a, b in zip((place.x, place.y, place.z), (wish.x, wish.y, wish.z), strict=True))


def _fulfils(settings: Settings, wish: Settings) -> bool:
    """Return whether a module with `settings` is as wished, in what a module of that role heeds."""
    if settings.anchor != wish.anchor or settings.uwb != wish.uwb:
        return False
    if wish.anchor:
        return settings.initiator == wish.initiator
    return (settings.low_power, settings.engine, settings.stationary) == (wish.low_power, wish.engine, wish.stationary)


def _role(settings: Settings) -> str:
    if settings.anchor:
        return "initiating anchor" if settings.initiator else "anchor"
    words = [("stationary detection", settings.stationary), ("low power", settings.low_power)]
    extra = [word for word, on in words if on] + ([] if settings.engine else ["no location engine"])
    return "tag" + (f" with {', '.join(extra)}" if extra else "")


def _rate(rate: UpdateRate) -> str:
    return f"{rate.moving * calls.RATE_UNIT:g} s moving, {rate.still * calls.RATE_UNIT:g} s still"
