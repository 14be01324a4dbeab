"""Messages of the hosts of apps."""

from dataclasses import field

from swarm.frozen import frozen
from swarm.messages.codec import Value, with_telemetry
from swarm.messages.service import Status


@frozen
class AppState:
    """An app's shared state by name, on `swarm/<robot>/app/<app>/state`, at most 10 Hz and at the end. A channel of an
    app has its name behind the app's: `.../app/<app>/<channel>/state`."""

    t: float
    k: int
    """The app's iteration."""
    state: dict[str, Value]
    result: dict[str, Value]
    """What the app reports as its result so far (units in docs of the app)."""


@frozen
class AppProgress:
    """The progress of an app, on `swarm/<robot>/app/<app>/progress`: on change and once a second."""

    t: float
    phase: str
    """starting, waiting, running, done or fault."""
    k: int
    waiting_for: tuple[str, ...]
    """Neighbours whose value is missing (named within 3 s)."""
    reason: str
    """Why it is in fault or waits, or that it is done and has not converged; empty otherwise."""


@frozen
class AppEpoch:
    """The members of a lockstep run, on `swarm/<robot>/app/<app>/epoch`: on change, and answered to queries. The key
    of a channel has the channel's name behind the app's."""

    t: float
    epoch: int
    """The number of earlier epochs in this run."""
    k: int
    """The iteration at which it began."""
    members: tuple[str, ...]
    links: tuple[tuple[str, str], ...]
    """Pairs of members."""
    away: tuple[str, ...]
    """Robots that an operator has dropped."""
    forced: bool
    """Whether an operator has ordered it without a majority."""
    frames: int
    """The epoch's number in the frames' keys."""


@frozen
class SetAppEpoch:
    """Command on `swarm/<robot>/app/<app>/set/epoch`: agree on other members, or on the links in force, now."""

    ticket: str
    """The name of the request. A repetition of it is not carried out again."""
    drop: tuple[str, ...]
    """Robots that are to leave the run."""
    add: tuple[str, ...]
    """Robots that were dropped and may come back."""
    force: bool
    """Whether to go on without a majority. Use it only if the others are known to have stopped."""


@frozen
class AppOutput:
    """A value of an app: from `robot.publish`, on `swarm/<robot>/app/<app>/out/<topic>`, or from `robot.record`, on
    `swarm/<robot>/app/<app>/record/<name>`."""

    t: float
    values: dict[str, Value]
    """The values by name; a single one is called `value`."""


@frozen
class AppLog:
    """A line that an app has printed, or given to `robot.log`, on `swarm/<robot>/app/<app>/log`."""

    t: float
    level: str
    """debug, info, warning, error, critical, or print."""
    text: str


@frozen
class AppParameter:
    """One parameter of an app that runs."""

    value: Value
    unit: str
    expected: str
    """The allowed values, in words."""
    live: bool
    """Whether it may be changed while the app runs."""
    kind: str = ""
    """float, int, bool or str."""
    low: float | None = None
    """The smallest value that it may have; None without such a bound."""
    high: float | None = None
    """The largest one."""
    choices: tuple[str, ...] = ()
    """The texts that it may be; empty where all are allowed."""


@frozen
class AppParameters:
    """An app's parameters, on `swarm/<robot>/app/<app>/parameters`: on change, and answered to queries."""

    t: float
    parameters: dict[str, AppParameter]
    states: dict[str, str] = field(default_factory=dict)
    """The layout of shared states in the frames between robots, the app's own by an empty name, those of its
    channels by theirs: `value=d x=2d`, little endian, in the letters of Python's struct."""


@frozen
class SetAppParameters:
    """Command on `swarm/<robot>/app/<app>/set/parameters`: change some, all or none of them."""

    ticket: str
    """Names the request; the answer carries it."""
    parameters: dict[str, Value]


@frozen
class AppParametersSet:
    """The answer, on `swarm/<robot>/app/<app>/parameters_set`."""

    t: float
    ticket: str
    problem: str
    """Why none was changed; empty where all were."""


TOPICS = with_telemetry(
    {
        ("app", "*/status"): Status,
        ("app", "*/state"): AppState,
        ("app", "*/state/throttled"): AppState,
        ("app", "*/progress"): AppProgress,
        ("app", "*/*/state"): AppState,
        ("app", "*/*/state/throttled"): AppState,
        ("app", "*/*/progress"): AppProgress,
        ("app", "*/epoch"): AppEpoch,
        ("app", "*/*/epoch"): AppEpoch,
        ("app", "*/set/epoch"): SetAppEpoch,
        ("app", "*/out/*"): AppOutput,
        ("app", "*/record/*"): AppOutput,
        ("app", "*/log"): AppLog,
        ("app", "*/parameters"): AppParameters,
        ("app", "*/set/parameters"): SetAppParameters,
        ("app", "*/parameters_set"): AppParametersSet,
    }
)
"""Message type of each key, by (service, topic); `*` is any one chunk."""
