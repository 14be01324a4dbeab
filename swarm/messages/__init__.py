"""Every message on the bus and the key it travels under. One place, so that no two services can disagree; a
module for each service, all of them to be had from here.

Each is imported when something of it is first asked for: a robot's processes take those they speak, and making all of
these classes is a third of what a small service needs until it runs.

Payloads are msgpack maps with these field names (`swarm.messages.codec`). SI units: m, rad, s, V. `t` is the sender's
monotonic clock in seconds, common to all processes of one robot; the mesh relates the robots' clocks. The
only binary payloads are what apps send each other: frames of the synchronous overlay (`swarm.core.lockstep`) and
what they flood and send (`swarm.app.overlays`).
"""

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

from swarm.errors import PayloadError
from swarm.messages.codec import decode
from swarm.messages.keys import STOP, parse

if TYPE_CHECKING:  # the same names, for type checkers; a test compares them to `_NAMES`
    from swarm.messages.apps import (
        AppEpoch,
        AppLog,
        AppOutput,
        AppParameter,
        AppParameters,
        AppParametersSet,
        AppProgress,
        AppState,
        SetAppEpoch,
        SetAppParameters,
    )
    from swarm.messages.balancer import (
        BalancerFault,
        BalancerState,
        Leds,
        Notice,
        Odometry,
        Parameters,
        SetLeds,
        SetMode,
        SetParameters,
        SetVelocity,
        TryMotors,
    )
    from swarm.messages.devices import (
        Battery,
        Buttons,
        Display,
        Firmware,
        I2CRates,
        ImuRequest,
        ImuSample,
        MeasureI2C,
        ModuleAnswer,
        ModuleRequest,
        Note,
        SetDisplay,
        SetNotes,
        Uwb,
        UwbRange,
    )
    from swarm.messages.dwm import ExternalReport, Measurement, Pose, Range, Ranges
    from swarm.messages.mesh import (
        Arm,
        Clock,
        Echo,
        EchoRequest,
        GraphRobot,
        HoldLink,
        Links,
        LinkState,
        Member,
        MemberChange,
        Members,
        MeshGraph,
        Stopped,
        Topology,
        TopologyRequest,
        TopologySet,
        View,
        Watch,
    )
    from swarm.messages.overlays import Flooded, FloodRequest, Passed, Progress, Reminder, SendRequest, Sent
    from swarm.messages.service import Status, Stop
    from swarm.messages.sim import LedChange, Target, Truth


_NAMES = {
    "apps": (
        "AppEpoch AppLog AppOutput AppParameter AppParameters AppParametersSet AppProgress AppState SetAppEpoch "
        "SetAppParameters"
    ),
    "balancer": (
        "BalancerFault BalancerState Leds Notice Odometry Parameters "
        "SetLeds SetMode SetParameters SetVelocity TryMotors"
    ),
    "devices": (
        "Battery Buttons Display Firmware I2CRates ImuRequest ImuSample MeasureI2C ModuleAnswer ModuleRequest "
        "Note SetDisplay SetNotes Uwb UwbRange"
    ),
    "dwm": "ExternalReport Measurement Pose Range Ranges",
    "mesh": (
        "Arm Clock Echo EchoRequest GraphRobot HoldLink Links LinkState Member MemberChange Members MeshGraph Stopped "
        "Topology TopologyRequest TopologySet View Watch"
    ),
    "overlays": "Flooded FloodRequest Passed Progress Reminder SendRequest Sent",
    "service": "Status Stop",
    "sim": "LedChange Target Truth",
}
"""What each module has for others."""

_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}

_OF_SERVICE = {
    "mesh": ("mesh", "overlays"),
    "balancer": ("balancer", "devices"),
    "dwm": ("dwm",),
    "app": ("apps",),
    "sim": ("sim",),
}
"""Modules with the topics of a service; `service` has those of all."""


def __getattr__(name: str) -> type:
    """A message type that is asked for by name (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    kind: type = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = kind
    return kind


@cache
def _topics(modules: tuple[str, ...]) -> dict[tuple[str, str], type]:
    table: dict[tuple[str, str], type] = {}
    for module in modules:
        table |= import_module(f"{__name__}.{module}").TOPICS
    return table


def topics() -> dict[tuple[str, str], type]:
    """Message type of each key, by (service, topic); `*` is any one chunk. A test compares docs/reference/keys.md to
    it."""
    return _topics(tuple(_NAMES))


def type_of(key: str) -> type | None:
    """The message type that travels under `key`, None where the key is none of ours.

    Raises `PayloadError` for a key that is not even well formed.
    """
    if key == STOP:
        from swarm.messages.service import Stop

        return Stop
    _, service, topic = parse(key)
    known = _topics(("service", *_OF_SERVICE.get(service, ())))
    _, _, tail = topic.partition("/")
    head, _, _ = tail.rpartition("/")
    _, _, deep = tail.partition("/")
    own = (service, topic), (service, f"*/{tail}"), (service, f"*/{head}/*"), (service, f"*/*/{deep}")
    for candidate in (*own, ("*", topic)):
        if candidate in known:
            return known[candidate]
    return None


def read(key: str, payload: bytes) -> object:
    """Decode a payload by its key; `PayloadError` where the key is unknown or the payload not of its type.

    Any payload under `swarm/stop` is a `Stop`: every reader of that key has to take this function.
    """
    if key == STOP:
        from swarm.messages.service import stop_of

        return stop_of(payload)
    kind = type_of(key)
    if kind is None:
        raise PayloadError(f"{key}: no message travels under this key (docs/reference/keys.md lists them)")
    return decode(kind, payload, key)
