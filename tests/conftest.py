"""Fixtures of all tests: a short runtime directory, processes that never outlive a test, a real router; and which of
the test processes runs what."""

import contextlib
import gc
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from bench.rigs.running import robots_folder

if TYPE_CHECKING:
    from xdist.scheduler import LoadScopeScheduling

    from swarm.bus.zenoh_bus import Bus

with contextlib.suppress(ImportError):  # a machine of the lab has none
    from hypothesis import HealthCheck, is_hypothesis_test, settings

    # A property is about values; how long an example takes is the machine's matter (a busy one made good tests fail).
    untimed = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.register_profile("suite", untimed, max_examples=20)
    settings.register_profile("thorough", untimed)
    settings.load_profile("suite")

try:
    from fork_server import start
except ImportError:  # nor this; its services have a fork server of their own (tests/lab/inside/inside_fork_server.py)
    start = subprocess.Popen

CONFIG = """\
network = "test"
[[robots]]
name = "r0"
link = "sim:{runtime}/r0.sock"
[[robots]]
name = "r1"
link = "sim:{runtime}/r1.sock"
[topology]
shape = "line"
[mesh]
insecure = true
"""


@cache
def shares(file: str) -> bool:
    """Whether tests of a file share what is made once: a simulation, a browser, a booted system."""
    return 'scope="' in Path(file).read_text()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> "LoadScopeScheduling":
    """Each test goes to the process that is free, with all of its parameters, since telling a process what to do takes
    as long as a short test; among the slow rigs without them. The tests of a file that share something go together.
    Whole files to each process would leave one of them alone with a long one in the end."""
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.split("::", 1)[0]
            if shares(str(config.rootpath / file)):
                return file
            return nodeid if _thorough else nodeid.partition("[")[0]

    return Scheduling(config, log)


_thorough = False
"""Whether this is the run of the slow rigs."""


def pytest_configure(config: pytest.Config) -> None:
    """Before any test module is read."""
    global _thorough
    _thorough = config.option.markexpr == "slow"
    if _thorough:
        settings.load_profile("thorough")
    # No test meets a simulation that runs on this machine in the usual folder.
    place = tempfile.TemporaryDirectory(prefix="swarm-")
    config.add_cleanup(place.cleanup)
    os.environ["XDG_RUNTIME_DIR"] = place.name


def costly(count: int) -> Callable[[Any], Any]:
    """Decorates a property whose examples take long: a third of `count` in the suite, all among the slow rigs."""
    return settings(max_examples=examples(count))


def examples(count: int) -> int:
    """How many of `count` costly examples, or seconds of a costly run, this run has time for."""
    return count if _thorough else count // 3


def thinned(values: Iterable[Any]) -> list[Any]:
    """Parameters of a test that takes long: every third value is for the suite, the others are for the slow rigs."""
    return [
        pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=[pytest.mark.slow] if number % 3 else [])
        for number, value in enumerate(values)
    ]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is collected stays: the garbage collector need not look through it again and again. Nor need it look at what
    tests make as often as it would, which takes a twentieth of their time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 20, 100)
        gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Each of the test processes begins with another part of a folder, so that in a fresh clone each compiles a part of
    the files, not all of them all files."""
    report = yield
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker and isinstance(collector, pytest.Directory) and report.result:
        count = int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        first = len(report.result) * int(worker.removeprefix("gw")) // count
        report.result = report.result[first:] + report.result[:first]
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that may take longest begin first, or all would wait for them in the end. All test processes need the same
    order, whatever they have begun with. Properties run once more among the slow rigs, where most try more examples."""
    for item in items if _thorough else ():
        is_property = isinstance(item, pytest.Function) and is_hypothesis_test(item.obj)
        if is_property or item.get_closest_marker("costly"):
            item.add_marker("slow")

    def allowed(item: pytest.Item) -> float:
        mark = item.get_closest_marker("timeout")
        return mark.args[0] if mark else 0.0

    items.sort(key=lambda item: (-allowed(item), item.path))


def pytest_terminal_summary(terminalreporter: "pytest.TerminalReporter") -> None:
    """What tests have measured (`record_property("measured", TEXT)`) is shown at the end. The name of the argument's
    type is younger than the pytest of the lab's machines."""
    reports = [report for state in ("passed", "failed") for report in terminalreporter.getreports(state)]
    told = [(report.nodeid, text) for report in reports for name, text in report.user_properties if name == "measured"]
    if told:
        terminalreporter.section("measured")
    for test, text in sorted(told):
        terminalreporter.write_line(f"{test.partition('::')[2]}: {text}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Each test begins with Ctrl-C heard. What a test that fails has left open goes with it: its traceback holds that
    until the next one runs, which the warnings would otherwise fail."""
    # Ctrl-C is ignored where a shell has started the tests in the background, and after a command that was interrupted
    # in a test of this process. Every process that a test starts would then ignore it, too.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    failed = item.session.testsfailed
    outcome = yield
    if item.session.testsfailed > failed:
        for name in ("last_value", "last_traceback", "last_exc"):
            vars(sys).pop(name, None)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            gc.collect()
    return outcome


def open_files(pid: int) -> set[str]:
    """What the descriptors of a process stand for: paths of files, `socket:[INODE]` and the like."""
    found = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # it was closed meanwhile
            found.add(str(descriptor.readlink()))
    return found


def wait_until(condition: Callable[[], object], timeout: float = 60.0, what: str | Callable[[], str] = "") -> None:
    """Poll until `condition()` is true; the deadline only bounds a failure, which tells `what` was awaited (a function
    is asked for it then)."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"not within {timeout} s: {(what() if callable(what) else what) or condition}")
        time.sleep(0.01)


def ask(bus: "Bus", key: str, **parameters: object) -> bytes:
    """The answer to a question, which is repeated until one comes: who answers may just be starting."""
    answers: list[bytes] = []
    again = 0.0

    def answered() -> bool:
        nonlocal again
        if not answers and time.monotonic() >= again:
            again = time.monotonic() + 0.5
            bus.ask(key, lambda _, payload: answers.append(payload), timeout_s=60.0, **parameters)
        return bool(answers)

    wait_until(answered, what=f"an answer to {key}")
    return answers[0]


def _read_on(sock: socket.socket) -> None:
    """Take what comes until the socket is shut down."""
    with contextlib.suppress(OSError):
        sock.settimeout(None)
        while sock.recv(4096):
            pass


class Processes:
    """Starts Python processes of the project for a runtime directory and ends them with the test."""

    def __init__(self, runtime: Path) -> None:
        self.runtime = runtime
        self.config = runtime / "swarm.toml"
        self.config.write_text(CONFIG.format(runtime=runtime))
        self._started: list[subprocess.Popen[str]] = []
        self._sockets: list[socket.socket] = []

    def environment(self, **extra: str) -> dict[str, str]:
        """The variables a service is started with; `extra` overrides."""
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("SWARM_")}
        own = {"SWARM_CONFIG": str(self.config), "SWARM_ROBOT": "r0", "SWARM_RUNTIME": str(self.runtime)}
        return inherited | own | {"XDG_RUNTIME_DIR": str(self.runtime)} | extra

    def start(self, *arguments: str, program: str = sys.executable, **environment: str) -> subprocess.Popen[str]:
        """Start `python ARGUMENTS` with pipes for all three streams."""
        process = start(
            [program, *arguments],
            env=self.environment(**environment),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._started.append(process)
        return process

    def start_ready(self, *arguments: str, until: str = "READY=1", **environment: str) -> subprocess.Popen[str]:
        """Start a service and return when it has told systemd (us) that it is ready, or something else."""
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sockets.append(sock)
        address = str(self.runtime / f"notify{sock.fileno()}")
        sock.bind(address)
        sock.settimeout(0.1)
        process = self.start(*arguments, NOTIFY_SOCKET=address, **environment)
        deadline = time.monotonic() + 60
        while True:
            try:
                if until in sock.recv(4096).decode():
                    # As systemd does. A socket that nobody reads takes ten messages, then holds each sender up for 1 s.
                    threading.Thread(target=_read_on, args=(sock,), daemon=True).start()
                    return process
            except TimeoutError:
                if process.poll() is not None or time.monotonic() > deadline:
                    process.kill()
                    pytest.fail(f"{arguments} did not say {until}:\n{process.communicate()[1]}")

    def router(self, **environment: str) -> subprocess.Popen[str]:
        """Start the bus service of this runtime directory and wait until it listens."""
        return self.start_ready("-m", "services.bus", **environment)

    def end(self) -> None:
        """Kill what still runs and close the pipes."""
        for process in self._started:
            if process.poll() is None:
                process.kill()
        for process in self._started:
            process.wait()
            for stream in (process.stdin, process.stdout, process.stderr):
                with contextlib.suppress(OSError):
                    stream.close()
        for sock in self._sockets:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)  # wakes who reads it
            sock.close()


@pytest.fixture
def runtime() -> Iterator[Path]:
    """A runtime directory."""
    with robots_folder() as path:
        yield Path(path)


@pytest.fixture
def processes(runtime: Path) -> Iterator[Processes]:
    """Starts processes in `runtime`; all of them are gone after the test."""
    started = Processes(runtime)
    yield started
    started.end()


@pytest.fixture
def router(runtime: Path) -> Iterator[None]:
    """The bus of `runtime`, in this process: it starts a hundred times faster than `bus_service`."""
    from swarm.bus.zenoh_bus import Router
    from swarm.process.paths import bus_endpoint

    with Router(bus_endpoint(runtime)):
        yield


@pytest.fixture
def bus_service(processes: Processes) -> subprocess.Popen[str]:
    """The bus of `runtime` as robots have it, which can be stopped and killed."""
    return processes.router()


@pytest.fixture(autouse=True)
def _no_swarm_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests see no robot, config or run of the machine they run on."""
    for name in [name for name in os.environ if name.startswith("SWARM_")]:
        monkeypatch.delenv(name)


def stop(process: subprocess.Popen[str], timeout: float = 60.0) -> int:
    """End a service as systemd does, by SIGTERM, and return its exit code."""
    process.send_signal(signal.SIGTERM)
    return process.wait(timeout)
