"""Files, thread and keys of one strand of an app: a lockstep with its snapshot, recording, state and progress."""

import queue
import secrets
import threading
from collections.abc import Callable, Mapping

from services.apps import topology
from services.apps.ballots import BallotFile, told
from services.apps.core.strand import ALONE, Action, Renew, Strand
from services.apps.core.terms import Terms
from services.apps.measurements import Measurements
from services.apps.recorder import Recorder
from services.apps.runner import Runner
from services.apps.snapshot import SnapshotFile
from swarm import clock
from swarm.bus.throttle import APP_STATE_S, Throttle
from swarm.core.epoch_actions import Keep, Order, Switch, Tell
from swarm.core.epoch_notes import LOST, first
from swarm.core.lockstep import Advanced, Channel, Compute, Fault, Save, Send
from swarm.errors import AppError, SwarmError
from swarm.frozen import frozen
from swarm.messages import AppEpoch, AppProgress, AppState, Measurement, SetAppEpoch, Topology
from swarm.messages.codec import Value, encode
from swarm.messages.keys import key
from swarm.process.service import Service

EVERY = 1.0
"""s between two messages of progress and state when nothing changes; a measurement that late is given as a
reason."""
CLOSE_WITHIN = 2.0
"""s that a running step has when the process is to end."""
LETTING_GO = 0.2
"""s that the last step's thread is given to let go of the app, so that who hears of the end finds its state."""
STUCK = 10.0
"""s after which a step that still runs is a fault, and no longer feeds systemd's watchdog."""


@frozen
class Latest:
    """A state as others may read it while steps run: the newest one, whole."""

    k: int
    t: float
    """s, when it was computed."""
    state: dict[str, Value]


class Worker:
    """Runs one strand: takes its frames, runs its steps in a thread of its own, keeps its files."""

    def __init__(
        self,
        service: Service,
        app: str,
        part: str,
        runner: Runner,
        terms: Terms,
        incarnation: int,
        links: topology.Links,
        measurements: Measurements | None,
        recorder: Recorder | None,
    ) -> None:
        """`part` names the channel within the app; it is empty for an app that is one lockstep. Raises `LocalError`
        where the files of the strand cannot be had."""
        self.latest: Latest | None = None
        self._service = service
        self._runner = runner
        self._part = part
        self._recorder = recorder
        self._file = f"{app}.{part}" if part else app
        self._keys = f"app/{app}/{part}" if part else f"app/{app}"
        self._counted = f"{part}_sync" if part else "sync"
        names = service.config.names
        self._snapshots = SnapshotFile(service.runtime / f"app.{self._file}.snapshot", len(names) + 1)
        self._ballots = BallotFile(self._file)
        begin = first(names, links.config.edges, links.epoch)
        kept, graph = self._ballots.read(), links.config.graph
        vote_lost = 0
        if self._ballots.lost:
            vote_lost = 1 + secrets.randbelow(LOST - 1)
            service.log.warning("the file with this robot's votes is damaged: it votes again from the next epoch on")
        names_of = frozenset(names)
        self._strand = Strand(service.robot, names_of, terms, begin, graph, incarnation, runner, kept, vote_lost)
        self._prefix = key(service.robot, f"app/{app}", "sync")
        self._notes = f"{self._prefix}/{terms.notes}"
        self._channel = self._strand.channel
        self._sync = f"{self._prefix}/{self._channel.text}"
        self._measurements = measurements
        self._lock = threading.Lock()  # around the strand
        self._app_lock = threading.Lock()  # around the app, taken first: results are looked at between steps only
        self._todo: queue.SimpleQueue[Compute | Renew | None] = queue.SimpleQueue()
        """Steps to be run, the oldest first; None asks the worker to look whether it shall end."""
        self._closing = False
        self._step_began: float | None = None
        self._measuring: float | None = None
        self._muted = False
        self._state: AppState | None = None
        self._state_key = key(service.robot, self._keys, "state")
        self._throttle = Throttle(service.bus, self._state_key, APP_STATE_S)
        self._told: tuple[object, ...] = ()
        self._told_at = 0.0
        self._watch = topology.Watch(links, service.robot, lambda text: service.log.warning("%s", text))
        service.bus.serve(self._state_key, self._answer)
        service.bus.serve(key(service.robot, self._keys, "progress"), lambda *_: encode(self._progress()))
        service.bus.serve(key(service.robot, self._keys, "epoch"), lambda *_: encode(self._epoch()))
        # A daemon: a step that never returns must not keep the process from ending.
        self._thread = threading.Thread(target=self._guarded, name=f"steps {part}".strip(), daemon=True)

    def start(self) -> None:
        """Begin; frames may come at once."""
        self._thread.start()

    @property
    def failed(self) -> bool:
        """Whether it has stopped for a fault."""
        return self._strand.phase == "fault"

    @property
    def reason(self) -> str:
        """Of a fault."""
        return self._strand.reason

    @property
    def begun(self) -> bool:
        """Whether it has its first state."""
        return self._strand.begun

    @property
    def busy(self) -> bool:
        """Whether it runs a step, or waits for what a step needs."""
        return self._step_began is not None or self._measuring is not None

    @property
    def watched(self) -> bool:
        """Whether anybody hears its states."""
        return self._service.bus.wanted(self._state_key)

    @property
    def stuck(self) -> bool:
        """Whether a step does not end. Waiting for others is no fault of ours."""
        began = self._step_began
        return began is not None and clock.now() - began >= STUCK

    def stop(self) -> None:
        """Wish the thread to end."""
        self._closing = True
        self._todo.put(None)

    def close(self) -> bool:
        """Let go of the files. A step that runs is waited for, but not for ever; False if it did not end."""
        self._thread.join(CLOSE_WITHIN)
        if self._thread.is_alive():
            self._service.log.warning("the step of iteration %d does not end", self._strand.k)
            return False
        self._snapshots.close()
        self._ballots.close()
        return True

    # On Zenoh's thread

    def receive(self, sender: str, channel: Channel, payload: bytes, *, around: bool) -> None:
        """Take a frame of this run and this strand; `around`: it came over other robots, not over the link with its
        sender."""
        with self._lock:
            if sender != self._service.robot:
                self._watch.heard(sender, channel, self._strand.channel)
            self._strand.receive(sender, channel, payload, clock.now(), around=around)
            self._perform()

    def stranger(self, sender: str, channel: Channel) -> None:
        """A frame of something else that calls itself this app."""
        with self._lock:
            self._watch.heard(sender, channel, self._strand.channel)

    def receive_note(self, sender: str, payload: bytes) -> None:
        """What a robot has to say about the members, passed on by `sender`."""
        with self._lock:
            self._strand.receive_note(sender, payload, clock.now())
            self._perform()

    def order(self, wish: SetAppEpoch) -> None:
        """The operator wants other members."""
        with self._lock:
            self._strand.order(Order(wish.drop, wish.add, wish.force), clock.now())
            self._perform()

    def change(self, changed: Callable[[], None], values: Mapping[str, Value]) -> None:
        """Other values for live parameters from the next step on; then `changed()` is called."""
        self._runner.changed = changed
        self._runner.change(values)

    def nudge(self) -> None:
        """The bus or a link came up: ask now for what is missing."""
        with self._lock:
            self._strand.nudge(clock.now())
            self._perform()

    def take_rtt(self, rtt: float) -> None:
        """The slowest link's usual round-trip time, s."""
        self._strand.rtt = rtt

    def take(self, in_force: Topology) -> None:
        """The mesh's topology."""
        with self._lock:
            self._watch.take(in_force)
            self._strand.epochs.take_links(in_force.edges)

    # On the worker's thread

    def _work(self) -> None:
        if not self._begin():
            return
        while (todo := self._todo.get()) is not None:
            if isinstance(todo, Compute) and not todo.values:
                self._service.stopping.wait(ALONE)
            k = todo.k if isinstance(todo, Compute) else todo.epoch.k
            measurement = self._measure(k)
            if self._closing or self.failed:
                return
            if measurement is not None and self._recorder is not None:
                self._recorder.measurement(k, clock.now(), measurement)
            with self._app_lock:
                self._step_began = clock.now()
                if isinstance(todo, Compute):
                    answer = self._strand.compute(todo, measurement)
                    self._step_began = None
                    with self._lock:
                        self._strand.computed(todo, answer, clock.now())
                        self._perform()
                else:
                    renewed = self._strand.renew(todo.epoch, measurement)
                    self._step_began = None
                    with self._lock:
                        self._strand.renewed(todo.epoch, renewed, clock.now())
                        self._perform()

    def _begin(self) -> bool:
        """Go on from a snapshot of this run, or begin it; False when told to stop before there was a
        measurement."""
        pages = self._snapshots.read()
        saved = self._strand.saved(pages)
        if pages and not saved:
            self._service.log.info("the snapshot is of another run, this one begins anew")
        measurement = None if saved else self._measure(0)
        if self._closing:
            return False
        with self._app_lock, self._lock:
            self._strand.begin(saved, measurement, clock.now())
            if saved:
                self._service.log.info("goes on at iteration %d", self._strand.k)
            elif self._strand.lost:
                self._service.log.warning("this robot has lost its state of the run and waits for the next epoch")
            self._perform()
        return True

    def _measure(self, k: int) -> Measurement | None:
        """The measurement for step k where the app wants one; waits for it."""
        if self._measurements is None:
            return None
        self._measuring = clock.now()
        measurement = self._measurements.get(k)
        self._measuring = None
        return measurement

    def _guarded(self) -> None:
        """Run the steps; what the app's code raises is a fault of the app. Anything else ends the process."""
        try:
            self._work()
        except SwarmError as error:
            self._fail(str(error))
        while not self._closing:  # after a fault neighbours still get answers
            self._todo.get()

    # On the ticker's thread

    def next_deadline(self) -> float | None:
        """When `tick` is wanted at the latest."""
        with self._lock:
            return self._strand.next_deadline(clock.now())

    def tick(self) -> bool:
        """Run the timers, publish what is new; True where something was."""
        now = clock.now()
        with self._lock:
            if self.stuck:
                where = f"iteration {self._strand.k}"
                self._failed(self._runner.hangs(where, self._thread.ident, STUCK))
            deadline = self._strand.next_deadline(now)
            if deadline is not None and now >= deadline:
                self._strand.handle_timer(now)
                self._perform()
            news = self._report(now)
        repeat = now - self._told_at >= EVERY
        if repeat:
            for name, count in self._strand.counters.items():
                self._service.counters[f"{self._counted}_{name.replace(' ', '_')}"] = count
        self._show(repeat)
        if not repeat and news == self._told:
            return False
        progress = self._progress()
        if self._recorder is not None and news != self._told:
            self._recorder.progress(progress, self._part)
        self._told, self._told_at = news, now
        self._publish("progress", progress)
        return True

    def _show(self, repeat: bool) -> None:
        """Publish the state if it is new and no step is running (else the next look will find it)."""
        state, strand = self._state, self._strand
        if strand.phase not in ("running", "done") or (state is not None and state.k == strand.k and not repeat):
            return
        # When all is done no step is waited for, but the thread may still be about to let go of the last one.
        if self._app_lock.acquire(timeout=LETTING_GO if strand.phase == "done" else 0.0):
            runner = self._runner
            try:
                state = AppState(strand.computed_at, runner.k, runner.state(), runner.result())
            except AppError as error:
                self._fail(str(error))
                return
            finally:
                self._app_lock.release()
            self._state = state
            self._service.bus.publish(self._state_key, state)
            self._throttle.publish(state, clock.now(), news=strand.phase == "done")

    def _report(self, now: float) -> tuple[str, tuple[str, ...], str]:
        """Phase, robots waited for, reason."""
        strand, measuring = self._strand, self._measuring
        if strand.phase in ("starting", "running") and measuring is not None and now - measuring >= EVERY:
            return "waiting", (), "the dwm service gives no measurement"
        if strand.phase == "running" and (reason := strand.obstacle):
            return "waiting", strand.waiting, reason
        if strand.phase == "running" and strand.waiting:
            return "waiting", strand.waiting, self._watch.reason(strand.waiting)
        return strand.phase, (), strand.reason

    def _progress(self) -> AppProgress:
        now = clock.now()
        phase, peers, reason = self._report(now)
        return AppProgress(now, phase, self._strand.k, peers, reason)

    def _epoch(self) -> AppEpoch:
        return told(self._strand.epochs.epoch, clock.now())

    def _answer(self, *_: object) -> bytes | None:
        state = self._state
        return None if state is None else encode(state)

    # Everywhere

    def _perform(self) -> None:
        """Carry out what the strand wants, in its order; the lock is held."""
        for action in self._strand.actions():
            if not self._muted:
                self._do(action)

    def _do(self, action: Action) -> None:
        match action:  # what is of each iteration first
            case Save(snapshot):
                self._keep(lambda: self._snapshots.write(snapshot.encode()))
            case Send(data):
                if self._channel is not self._strand.channel:
                    self._channel = self._strand.channel
                    self._sync = f"{self._prefix}/{self._channel.text}"
                self._service.bus.publish(action.key(self._sync), data, urgent=True)
            case Advanced(k, _):
                self.latest = Latest(k, self._strand.computed_at, self._runner.state())
                if self._recorder is not None:
                    self._recorder.state(k, self.latest.t, self.latest.state, self._runner.result(), self._part)
            case Compute() | Renew():
                self._todo.put(action)
            case Keep(kept):
                self._keep(lambda: self._ballots.write(kept))
            case Tell(data):
                self._service.bus.publish(self._notes, data, urgent=True)
            case Switch(epoch):
                self._service.log.info(
                    "epoch %d from iteration %d on: %s", epoch.counter, epoch.k, " ".join(epoch.members)
                )
                message = self._epoch()
                self._publish("epoch", message)
                if self._recorder is not None:
                    self._recorder.epoch(message, self._part)
            case Fault(reason):
                self._tell(reason)

    def _keep(self, write: Callable[[], None]) -> None:
        try:
            write()
        except SwarmError as error:
            # What was not written must never be sent (R5): the neighbours keep what they had of us.
            self._muted = True
            self._failed(str(error))

    def _fail(self, reason: str) -> None:
        with self._lock:
            self._failed(reason)

    def _failed(self, reason: str) -> None:
        """Stop computing, say why, and stay; the lock is held."""
        if self._strand.fail(reason, clock.now()):
            self._tell(reason)

    def _tell(self, reason: str) -> None:
        self._service.log.error("%s", reason)
        self._service.degraded(reason)

    def _publish(self, topic: str, message: object) -> None:
        self._service.bus.publish(key(self._service.robot, self._keys, topic), message)
