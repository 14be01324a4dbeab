"""The process of one app on one robot: `python -m services.apps NAME_OR_FILE [--iterations K] [--run HEX] [--set
NAME=VALUE]`.

Exit codes: 0 stopped by SIGTERM, 2 a wrong app, parameter, config or command, 3 stopped after a fault of the
app (it raised, gave a wrong state, or its trajectory would have forked); neither 2 nor 3 is mended by a
restart.
"""

import argparse
import hashlib
import os
import threading
from urllib.parse import unquote

from services.apps import loader
from services.apps.equipment.equipment import equip
from services.apps.equipment.measurements import source_of
from services.apps.equipment.recorded_values import RecordedValues
from services.apps.equipment.speaker import let_speak, prints_heard
from services.apps.event_runner import EventRunner
from services.apps.faults import line_of
from services.apps.host import topology
from services.apps.host.event_host import EventHost
from services.apps.host.host import LockstepHost, Part
from services.apps.persistence.claim import AppLock
from services.apps.persistence.recording import AppRecording, place_of
from services.apps.persistence.storage import FileStorage
from services.apps.runner import Runner, metrics_of
from swarm.app import run_options
from swarm.app.event_app import EventApp
from swarm.app.settings import Setting, parse, with_settings
from swarm.app.sync_app import BaseApp, SyncApp
from swarm.app.truth import TruthWatch
from swarm.config import Config
from swarm.core.asynchronous import HANG
from swarm.core.lockstep.frames import MAX_ITERATION
from swarm.errors import AppError, ConfigError, LocalError
from swarm.process.arguments import whole
from swarm.process.paths import state_dir
from swarm.process.service import Service, run
from swarm.process.threads import ThreadedRuntime

FAULT = 3
"""Exit code of a host whose app is in fault."""


def main() -> int:
    """Run the app until told to stop; after the last iteration its result stays to be read."""
    options = _options()
    app = loader.load(options.app)
    host: LockstepHost | EventHost | None = None
    runtime: ThreadedRuntime | None = None

    def on_bus(connected: bool) -> None:
        if connected and host is not None and runtime is not None:
            runtime.entry(host.nudge)()

    with Service(f"app/{app.name}", on_bus=on_bus, direct=True) as service:
        service.config = with_settings(service.config, app.name, options.settings)
        number = options.run if options.run is not None else _default_run(app, service.config, options.settings)
        seed = _number("SWARM_SEED", os.environ.get("SWARM_SEED") or str(number), 10)
        instance = _make(service, app, service.config, seed)  # what is wrong with it is said at once
        how = run_options.of(options)
        if isinstance(instance, EventApp) and how.rule is not None:
            raise ConfigError(f"--until and --for are for apps in lockstep, which {app.name} is not")
        runtime = ThreadedRuntime(service)
        measured = isinstance(instance, SyncApp) and instance.measured
        measurements = source_of(runtime, service.config, options.iterations) if measured else None
        links = topology.of_run(service, app.name, number)
        if links is None:
            return 0
        if links.config.edges != service.config.edges:
            instance = _make(service, app, links.config, seed)
        overlays = equip(instance.robot, service.bus, service.log)
        if metrics_of(type(instance)):
            instance.robot.truth = TruthWatch(service.bus, service.robot, app.name, type(instance), service.config)
        storage = FileStorage(service.runtime)
        claim = AppLock(service.runtime, app.name, state_dir())
        if not links.kept:
            topology.save(service.runtime, app.name, number, links)
        folder = place_of(app.name, number, wanted=options.record)
        recording = AppRecording(service, app, number, seed, folder, options.settings) if folder is not None else None
        recorder = None
        if recording is not None:
            recorder = recording.recorder
            overlays.asked = recording.watch.asked
        keep = recorder.value if recorder is not None else None
        instance.robot.recording = RecordedValues(service.bus, service.robot, app.name, keep)
        let_speak(instance.robot, service.bus, service.log, *([recorder.said] if recorder is not None else []))
        place = topology.RunPlace.of(number, app.digest, how, links.config, links.epoch, claim.incarnation)
        if isinstance(instance, EventApp):
            events = EventRunner(instance, app.source)
            host = EventHost(runtime, app.name, events, place, service.config, storage, recorder)
        else:
            assert isinstance(instance, SyncApp)
            overlays.collect()
            parts = [Part("", Runner(instance, app.source, how.tolerance), measurements)]
            host = LockstepHost(runtime, app.name, parts, place, storage, recorder)
        with prints_heard(service.log):
            runtime.entry(host.start)()
            service.stopping.wait()
            host.close()
        runtime.close()
        claim.close()
        if recording is not None:
            recording.close()
        return FAULT if host.failed else 0


def _make(service: Service, app: loader.LoadedApp, config: Config, seed: int) -> BaseApp:
    """Make the app. The author's code in it may never return: then its line is named, and a stop ends the process,
    which has opened nothing yet."""
    made, thread = threading.Event(), threading.get_ident()

    def end() -> None:
        if not service.stopping.wait(HANG) and not made.is_set():
            service.waits(f"{line_of(thread, app.source)}the app is not made within {HANG:g} s")
        service.stopping.wait()
        if not made.is_set():
            os._exit(0)

    threading.Thread(target=end, name="make", daemon=True).start()
    try:
        return app.make(config, service.robot, seed)
    finally:
        made.set()


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m services.apps", description="Run one app on this robot.")
    text = f"{', '.join(loader.BUILT_IN)}, or the path of a Python file with an app"
    parser.add_argument("app", metavar="APP", help=text)
    number = whole(0, MAX_ITERATION)
    parser.add_argument("--iterations", type=number, metavar="K", help="end after K iterations (default: no end)")
    run_options.add_arguments(parser)
    parser.add_argument(
        "--run",
        metavar="HEX",
        help="number of the run, the same on all robots (default: SWARM_RUN, else by app and config)",
    )
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        type=_setting,
        default=[],
        metavar="[ROBOT.]NAME=VALUE",
        help="a parameter in place of that in swarm.toml; give the same ones on all robots",
    )
    escaped = "settings of --set with special characters as %%XX, as swarm run writes them"
    parser.add_argument("--escaped", dest="settings", action="append", type=_escaped, metavar="SETTINGS", help=escaped)
    parser.add_argument(
        "--record", action="store_true", help="record the run (default: only if SWARM_RECORD names a folder)"
    )
    options = parser.parse_args()
    given: str | None = options.run or os.environ.get("SWARM_RUN")
    options.run = None if not given else _number("--run or SWARM_RUN", given, 16)
    return options


def _setting(text: str) -> Setting:
    try:
        return parse(text)
    except AppError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _escaped(text: str) -> Setting:
    return _setting(unquote(text))


def _number(name: str, text: str, base: int) -> int:
    try:
        number = int(text, base)
    except ValueError:
        number = -1
    if not 0 <= number < 1 << 64:
        kind = "hexadecimal" if base == 16 else "whole"
        raise LocalError(f"{name}: expected a {kind} number of 64 bits, got {text!r}")
    return number


def _default_run(app: loader.LoadedApp, config: Config, settings: list[Setting]) -> int:
    """Return the default number of a run, by the sources of app and config and by the settings. So robots that
    differ in these are never in one run."""
    text = app.digest + config.path.read_bytes() + "".join(map(repr, settings)).encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "big")


if __name__ == "__main__":
    run(main)
