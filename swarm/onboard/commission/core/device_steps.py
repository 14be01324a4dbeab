"""Steps that move nothing: balancer and gyro, I2C bus, battery, buttons, display, radio."""

from swarm.messages import MeasureI2C, SetDisplay, SetMode
from swarm.onboard.commission.core.procedure import Desk, Script, StepError

LAY_BACK = "Lay the robot on its back, its battery cover up, and leave it alone. A or Enter when it lies."
READY_S = 20.0
CALM_S = 1.5
"""Seconds without a fault after which none holds: a stop that holds is repeated each second."""
SIZES = (4, 28)
"""Bytes of the transfers that are timed; their difference is pure time of bytes."""
TRANSFERS = 30
I2C_S = 20.0
HOLD_S = 25e-6
"""Seconds by which the ATmega lengthens each byte (firmware/README.md)."""
SLOWEST_SCL = 80e3
"""Clock of the bus in Hz below which the slack of a tick has no room for all tasks."""
PRESS_S = 30.0
DISPLAY_S = 5.0
LINKS_S = 3.0


def ready(desk: Desk) -> Script:
    """Check that the balancer runs, its devices answer, it has found its gyro's zero, and no fault holds."""
    yield from desk.confirm("lay-back", LAY_BACK)
    desk.send(SetMode("rest"))
    robot = desk.robot
    found = yield from desk.until(lambda: robot.mode == "idle", READY_S)
    if found:  # a fault that comes again, as of a stop that holds, does so within a second
        found = not (yield from desk.until(lambda: robot.mode == "fault", CALM_S))
    if not found:
        if robot.state is None:
            raise StepError("the balancer says nothing", "swarm doctor tells why; swarm services start balancer")
        if robot.fault.name:
            raise StepError(f"fault: {robot.fault.reason}", robot.fault.recovery)
        raise StepError(f"the balancer stays {robot.mode}", "leave the robot alone; swarm logs balancer tells more")
    if robot.firmware is not None:
        desk.figures["firmware"] = f"{robot.firmware.layout}.{robot.firmware.revision}"


def bus(desk: Desk) -> Script:
    """Check that the I2C bus is fast enough, and that transfers succeed."""
    robot, seconds = desk.robot, {}
    if robot.state is not None and robot.state.scl:  # where it is slow, a tick has no room for the longer transfers
        _judge_clock(desk, robot.state.scl)
    for size in SIZES:
        ticket = f"commission {desk.subject.date} {size} {desk.now:.3f}"
        desk.send(MeasureI2C(ticket, size, TRANSFERS))
        if not (yield from desk.until(lambda ticket=ticket: ticket in robot.rates, I2C_S)):  # type: ignore[misc]
            raise StepError("the balancer times no transfers", "swarm doctor; swarm measure i2c")
        rates = robot.rates[ticket]
        if rates.problem or rates.write is None or rates.read is None:
            raise StepError(f"transfers fail: {rates.problem}", "check the I2C cables and the ATmega's power")
        seconds[size] = 8 * size / rates.write
        desk.figures |= {"read_kbit_s": round(rates.read / 1e3, 2), "write_kbit_s": round(rates.write / 1e3, 2)}
        desk.figures["failed"] = desk.figures.get("failed", 0) + rates.failed
    byte = (seconds[SIZES[1]] - seconds[SIZES[0]]) / (SIZES[1] - SIZES[0])
    desk.figures["byte_us"] = round(byte * 1e6, 1)
    scl = 9 / max(byte - HOLD_S, 1e-6)
    if desk.figures["failed"] > TRANSFERS // 10:
        raise StepError(f"{desk.figures['failed']} transfers failed", "check the I2C cables and the ATmega's power")
    _judge_clock(desk, scl)


def _judge_clock(desk: Desk, scl: float) -> None:
    """Note the bus' clock, Hz, and refuse one that is too slow."""
    desk.figures["scl_hz"] = round(scl)
    if scl < SLOWEST_SCL:
        raise StepError(
            f"the I2C bus is slow: SCL is some {scl / 1e3:.0f} kHz in place of 100",
            "the Pi's core clock drops when it idles: swarm provision fixes it in config.txt, then reboot the robot",
        )


def battery(desk: Desk) -> Script:
    """Check that the batteries are charged."""
    yield from desk.until(lambda: desk.robot.state is not None and desk.robot.state.battery is not None, 5.0)
    state = desk.robot.state
    volts = None if state is None else state.battery
    if volts is None:
        raise StepError("the battery's voltage is not read", "swarm doctor: does the ATmega answer?")
    desk.figures["battery_v"] = round(volts, 2)
    if not desk.subject.battery_warning <= volts <= 10.0:
        limit = desk.subject.battery_warning
        raise StepError(f"the battery has {volts:.2f} V, expected {limit:g} to 10", "charge or change the batteries")


def buttons(desk: Desk) -> Script:
    """Check that each button is reported as itself."""
    robot = desk.robot
    yield from desk.until(lambda: robot.buttons is not None, 5.0)
    for name in "abc":
        before = _presses(desk)
        desk.prompt(f"press-{name}", f"Press button {name.upper()} of the robot.")
        if not (yield from desk.until(lambda before=before: _presses(desk) != before, PRESS_S)):  # type: ignore[misc]
            raise StepError(
                f"no press of button {name.upper()} in {PRESS_S:g} s",
                "look at the board's button; swarm flash",
            )
        pressed = [other for other, old, new in zip("abc", before, _presses(desk), strict=True) if new != old]
        if pressed != [name]:
            raise StepError(f"button {pressed[0].upper()} came for {name.upper()}", "press the one that is asked for")
        yield from desk.wait(0.5)
    desk.figures["buttons"] = "A B C"


def _presses(desk: Desk) -> tuple[int, int, int]:
    found = desk.robot.buttons
    return (0, 0, 0) if found is None else found.presses


def display(desk: Desk) -> Script:
    """Check that the display shows what it is told; a robot without one passes."""
    desk.robot.display = None
    desk.send(SetDisplay(f"{desk.subject.robot}\nA: I read this", 60.0))
    yield from desk.until(lambda: desk.robot.display is not None, DISPLAY_S)
    found = desk.robot.display
    desk.figures["display"] = "none" if found is None or not found.present else "there"
    if desk.figures["display"] == "none":
        desk.say("no display answers: it may be left out")
        return
    question = f"Does the display say '{desk.subject.robot}'? A or Enter: yes. C or n: no."
    seen = yield from desk.question("read-display", question)
    desk.send(SetDisplay(""))
    if not seen:
        raise StepError("the display answers and shows nothing", "check its cable; is it an SSD1306 of 128 x 64?")


def radio(desk: Desk) -> Script:
    """Measure the links to neighbours that are up; none need be."""
    yield from desk.until(lambda: desk.robot.links is not None, LINKS_S)
    links = () if desk.robot.links is None else desk.robot.links.links
    trips = {link.peer: link.rtt_median for link in links if link.state == "up" and link.rtt_median is not None}
    desk.figures["round_trips_ms"] = {peer: round(trip * 1e3, 2) for peer, trip in trips.items()}
    if not trips:
        desk.say("no neighbour is up: nothing is measured of the radio")
