"""The limits of commands to the devices. The bridge refuses commands beyond them, so the loop need not check again."""

from services.balancer.core.control.manoeuvres.motor_trial import check_test
from services.balancer.core.devices.mailbox import check_request
from services.balancer.core.devices.rates import check_measurement
from services.balancer.core.devices.tune import check_notes
from swarm.errors import LocalError
from swarm.messages import ImuRequest, MeasureI2C, ModuleRequest, SetDisplay, SetNotes, SetParameters, TryMotors

IMU_RATE = 100.0
"""The highest rate of IMU samples, Hz: that of the control loop."""
IMU_DURATION_S = 60.0
TEXT_LIMIT = 200
"""The most letters of a text for the display, which is more than it can show."""
MAX_PARAMETERS, MAX_NAME = 32, 40
"""The most parameters of a command, and letters of a name: more than there are."""
TEXT_SECONDS = 60.0
"""The most seconds of a claim of the display. A longer claim must be renewed."""


def check(command: object) -> None:
    """Raises `LocalError` where a command to a device is out of range."""
    match command:
        case MeasureI2C():
            check_measurement(command)
        case ModuleRequest():
            check_request(command)
        case SetNotes():
            check_notes(command)
        case TryMotors():
            check_test(command)
        case SetParameters(values):
            if len(values) > MAX_PARAMETERS or any(len(name) > MAX_NAME for name in values):
                raise LocalError(f"parameters: expected at most {MAX_PARAMETERS}, with names of {MAX_NAME} letters")
        case SetDisplay(text, seconds):
            if len(text) > TEXT_LIMIT:
                raise LocalError(f"text: {len(text)} letters, at most {TEXT_LIMIT}")
            if seconds is not None:
                _in_range("seconds", seconds, 0.0, TEXT_SECONDS, "s")
        case ImuRequest(rate, duration):
            _in_range("rate", rate, 0.01, IMU_RATE, "Hz")
            _in_range("duration", duration, 0.0, IMU_DURATION_S, "s")


def _in_range(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not low <= value <= high:
        raise LocalError(f"{name}: {value:g} {unit}, expected {low:g} to {high:g}")
