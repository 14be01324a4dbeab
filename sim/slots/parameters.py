"""The parameters of a slot radio. Each number has its source, or is marked as fitted.

"Fitted" means: chosen so that the original lockstep over this radio takes the times of recorded runs of the thesis'
robots (`./run bench radio` shows model and recordings side by side). Figures of robots in several piconets depend on
`stay`; others hardly do.
"""

from dataclasses import fields, replace

from swarm.errors import ConfigError
from swarm.frozen import frozen

SLOT = 625e-6
"""Duration of a slot, s (Bluetooth Core specification, vol 2 part B, 2.2.2)."""

EDR2 = ((54, 1), (367, 3), (679, 5))
"""Bytes and slots of 2-DH1, 2-DH3 and 2-DH5 packets (Core specification, vol 2 part B, table 6.10)."""

OVERHEAD = 9
"""Bytes of L2CAP (4) and RFCOMM (address, control, length of 2, check) around what is written."""

FRAME = 990
"""Bytes that one frame carries: with `OVERHEAD` what one HCI packet of 1021 B holds (Linux, RFCOMM over a 3-DH5)."""

MAX_PERIPHERALS = 7
"""Active members of a piconet beside its central (3-bit LT_ADDR, Core specification, vol 2 part B, 4.1)."""


@frozen
class SlotParameters:
    """Times in s where nothing else is said."""

    stay: float = 0.1
    """Mean time for which a bridge of two piconets stays in each. Fitted; 0.05 to 0.3 are possible."""
    spread: float = 0.95
    """A stay is uniform in stay * (1 +- spread). Fitted; with nearly equal stays two bridges would miss each other for
    long."""
    guard: int = 2
    """Slots lost at a change of piconet, whose clocks differ (informit.com, article 21324)."""
    poll_busy: int = 40
    """Slots between polls of a link that carried data within `busy_for` (T_poll, commonly 40: davidcontreras.es)."""
    poll_idle: int = 80
    """Slots between polls of another link. Fitted."""
    busy_for: float = 1.0
    loss: float = 0.05
    """Probability that a packet with data is lost. A packet without data is lost with a third of it."""
    host: float = 0.0015
    """Mean time in kernel and UART driver, for each frame at each end, s."""
    host_spread: float = 0.5
    """That time is uniform in host * (1 +- host_spread)."""
    uart: float = 3e6
    """bit/s between host and controller, 10 bits a byte (raspberrypi/linux, issue 2832)."""
    buffers: int = 8
    """Frames that a controller holds for all its links together (BCM4343x)."""
    supervision: float = 20.0
    """Silence after which a link is lost (Core specification, vol 2 part B, 3.1), unless the caller sets another."""
    scan: float = 0.32
    """Time between two page scans: 0x0200 slots, as provisioning sets them; `THESIS` has Linux' own. `FastConnectable`
    has 0.16, which takes twice as much time from the links."""
    scan_window: float = 0.0225
    """Duration of a page scan. It is interlaced: two scans of 0x0012 slots follow one another (Core specification, vol
    2 part B, 8.3.1)."""
    scan_paging: float = 0.5
    """Share of its own scans that a paging robot keeps. Fitted."""
    page_weight: float = 3.0
    """Stays at paging are so many times as long as those in a piconet. Fitted."""
    page_timeout: float = 5.12
    """Seconds after which a page of an absent robot is given up (Linux: 0x2000 slots)."""
    page_answer: float = 0.01
    """Seconds from a scan that hears the page until the link is there."""
    setup: int = 13
    """Exchanges of small frames before a socket is connected: LMP 6, L2CAP 3, RFCOMM 4."""

    @classmethod
    def parse(cls, text: str) -> "SlotParameters":
        """Read `stay=0.2,loss=0.1`, each part optional. Raises `ConfigError`."""
        values: dict[str, float] = {}
        names = [field.name for field in fields(cls)]
        for part in filter(None, text.split(",")):
            name, _, number = part.partition("=")
            try:
                value = float(number)
            except ValueError:
                value = -1.0
            if name not in names or not 0.0 <= value < 1e6:
                raise ConfigError(f"{part!r}: expected {'|'.join(names)}=number, not negative")
            values[name] = int(value) if isinstance(getattr(cls(), name), int) else value
        found = replace(cls(), **values)  # type: ignore[arg-type]
        if not min(found.stay, found.uart, found.buffers, found.poll_busy, found.poll_idle) > 0:
            raise ConfigError(f"{text!r}: stay, uart, buffers, poll_busy and poll_idle must be above 0")
        if found.loss > MAX_LOSS or not found.spread < 1 or found.host_spread > 1 or not found.scan > found.scan_window:
            raise ConfigError(f"{text!r}: expected loss at most {MAX_LOSS}, spread below 1, scan above scan_window")
        return found

    def text(self) -> str:
        """Return the text from which `parse` makes these parameters."""
        usual = type(self)()
        names = [field.name for field in fields(self) if getattr(self, field.name) != getattr(usual, field.name)]
        return ",".join(f"{name}={getattr(self, name)!r}" for name in names)


MAX_LOSS = 0.9

THESIS = SlotParameters(scan=1.28, scan_window=0.01125)
"""The thesis' robots: page scans as Linux sets them where nobody asks for others (0x0800 and 0x0012 slots)."""
