"""Every message on the bus and the key it travels under, in a module for each service.

Services and tools import all messages from here, so no two of them can disagree.

Payloads are msgpack maps with these field names (`swarm.messages.codec`). SI units: m, rad, s, V. `t` is the sender's
monotonic clock in seconds, common to all processes of one robot; the mesh relates the robots' clocks. The
only binary payloads are what apps send each other: frames of the synchronous overlay (`swarm.core.lockstep`) and
what they flood and send (`swarm.app.overlays`).
"""

from swarm.errors import PayloadError
from swarm.messages import apps, balancer, devices, dwm, mesh, overlays, service, sim
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
from swarm.messages.codec import decode
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
from swarm.messages.keys import STOP, parse
from swarm.messages.mesh import (
    Arm,
    Clock,
    Echo,
    EchoRequest,
    GraphRobot,
    HoldLink,
    Links,
    LinkState,
    MeasuredHub,
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
from swarm.messages.service import Status, Stop, stop_of
from swarm.messages.sim import LedChange, Target, Truth

_TOPICS: dict[tuple[str, str], type] = {}
for _module in (apps, balancer, devices, dwm, mesh, overlays, service, sim):
    _TOPICS |= _module.TOPICS


def topics() -> dict[tuple[str, str], type]:
    """Message type of each key, by (service, topic); `*` is any one chunk. A test compares docs/reference/keys.md to
    it."""
    return _TOPICS


def type_of(key: str) -> type | None:
    """Return the message type that travels under `key`, None where the key is none of ours.

    Raises `PayloadError` for a key that is not even well formed.
    """
    if key == STOP:
        return Stop
    _, service, topic = parse(key)
    _, _, tail = topic.partition("/")
    head, _, _ = tail.rpartition("/")
    _, _, deep = tail.partition("/")
    own = (service, topic), (service, f"*/{tail}"), (service, f"*/{head}/*"), (service, f"*/*/{deep}")
    for candidate in (*own, ("*", topic)):
        if candidate in _TOPICS:
            return _TOPICS[candidate]
    return None


def read(key: str, payload: bytes) -> object:
    """Decode a payload by its key; `PayloadError` where the key is unknown or the payload not of its type.

    Any payload under `swarm/stop` is a `Stop`: every reader of that key has to take this function or `stop_of`.
    """
    if key == STOP:
        return stop_of(payload)
    kind = type_of(key)
    if kind is None:
        raise PayloadError(f"{key}: no message travels under this key (docs/reference/keys.md lists them)")
    return decode(kind, payload, key)
