"""The shell around one lockstep of an app: its frames on the bus, its steps, its snapshots, state and progress."""

import contextlib
import secrets
from collections.abc import Callable, Mapping
from functools import partial

from services.apps.core.lockstep_run import ALONE, LockstepRun, Renew
from services.apps.core.terms import AppAnswer, Terms
from services.apps.equipment.measurements import Measurements
from services.apps.faults import bounded
from services.apps.host.app_status import LOOK_EVERY, REPEAT, AppStatus
from services.apps.host.observer import Observer, StepRecord
from services.apps.host.topology import RunPlace, TopologyWatch
from services.apps.persistence.ballots import told
from services.apps.persistence.storage import Storage
from services.apps.runner import Runner
from swarm.core.asynchronous import HANG
from swarm.core.epochs.actions import EpochRequest, SaveEpochs, SendToNeighbours, SwitchEpoch
from swarm.core.epochs.notes import LOST, Epoch, EpochNote
from swarm.core.lockstep.actions import Advanced, Compute, Fault, Finished, Save, Send, Waiting, key_of
from swarm.core.lockstep.frames import Channel, Snapshot
from swarm.errors import PayloadError, SwarmError
from swarm.messages import AppProgress, AppState, Measurement
from swarm.messages.codec import Value, encode
from swarm.messages.keys import key
from swarm.process.runtime import Runtime, Timer

IDLE_AFTER = 2.0
"""Seconds without a step after which an app counts as idle: what it drives stands still until its next step."""
CLOSE_WITHIN = 2.0
"""Seconds that running steps have when the process is to end."""
CLOSE_LEAST = 0.1
"""Seconds that each of them has, however long others took: an idle thread ends at once."""


class LockstepDriver:
    """Drives one lockstep, from the first state or a snapshot to the last iteration."""

    def __init__(
        self,
        runtime: Runtime,
        app: str,
        part: str,
        runner: Runner,
        terms: Terms,
        place: RunPlace,
        storage: Storage,
        watch: TopologyWatch,
        measurements: Measurements | None,
        observer: Observer | None,
        on_change: Callable[[], None],
    ) -> None:
        """`part` names the channel within the app; it is empty for an app that is one lockstep. `on_change()` is called
        where the app has begun, has come to another epoch, or has ended. Raises `LocalError` where the lockstep's
        files cannot be had."""
        self.robot = runtime.robot
        self.app = app
        self.part = part
        self.runner = runner
        self.watch = watch
        self.latest: Advanced | None = None
        """The newest iteration and its packed state; None before the first one."""
        self._runtime = runtime
        self._bus = runtime.bus
        self._observer = observer
        self._on_change = on_change
        file = f"{app}.{part}" if part else app
        self._snapshots = storage.snapshots(file, len(place.names) + 1)
        self._votes = storage.votes(file)
        kept, vote_lost = self._votes.read(), 0
        if self._votes.lost:
            vote_lost = 1 + secrets.randbelow(LOST - 1)
            runtime.log.warning("the file with this robot's votes is damaged: it votes again from the next epoch on")
        self.run = LockstepRun(
            self.robot, place.names, terms, place.begin, place.graph, place.incarnation, runner, kept, vote_lost
        )
        if self.run.epochs.number != place.begin.number:
            self._need(self.run.epochs.epoch)
        self._prefix = key(self.robot, f"app/{app}", "sync")
        self._notes = f"{self._prefix}/{terms.notes}"
        self._channel = self.run.channel
        self._sync = f"{self._prefix}/{self._channel.text}"
        self._measurements = measurements
        self._measured: Measurement | None = None
        """What the step that runs computes with."""
        self._measuring_since: float | None = None
        self._worker = runtime.worker(f"steps {part}".strip())
        self._closed = self._muted = False
        self._told_waiting = False
        """Whether the observer was last told that the lockstep waits for others."""
        self._performing = False
        """Whether it is planned to do what the frames of this moment call for."""
        self._timer = Timer(runtime.at, self._handle_timer)
        topics = f"app/{app}/{part}" if part else f"app/{app}"
        self._counted = f"{part}_sync" if part else "sync"
        self._epoch_key = key(self.robot, topics, "epoch")
        self._status = AppStatus(runtime, topics, lambda: self.progress, self._look_at_state)
        self._bus.serve(self._epoch_key, lambda *_: encode(told(self.run.epochs.epoch, runtime.now)))

    @property
    def failed(self) -> bool:
        """Whether it has stopped for a fault."""
        return self.run.phase == "fault"

    @property
    def idle(self) -> bool:
        """Whether it makes no steps: it is done, has no part in the epoch, or has waited for others for a while."""
        late = not self._worker.busy and self._runtime.now - self.run.progress_at >= IDLE_AFTER
        return late or self.run.phase == "done"

    @property
    def progress(self) -> AppProgress:
        """Return the lockstep's progress, and what holds it up."""
        return AppProgress(self._runtime.now, *self._report())

    def start(self) -> None:
        """Go on from a snapshot of this run, or let the app begin, of a new run as soon as there is a measurement where
        it wants one."""
        pages = self._snapshots.read()
        saved = self.run.saved(pages)
        if pages and not saved:
            self._runtime.log.info("the snapshot is of another run, this one begins anew")
        if saved and saved[-1].k > 0:
            self.runner.forget_inputs()
        if self.run.epochs.new and not saved:
            self._measure(0, partial(self._start, saved))
        else:  # without a first state to set, so that the others need not wait for what it has to say
            if not saved and self.run.terms.drop and self._measurements is not None:
                # It begins with a measurement. Nobody is to take it in before it has one: all would wait for it.
                self.run.epochs.well = False
                self._measure(0, _ignore)
            self._start(saved, None)
        self._runtime.every(LOOK_EVERY, self.look, self._status.keys)

    def close(self, within: float) -> bool:
        """Let go of the files. A step that runs is waited for at most `within` s; False if it did not end."""
        self._runtime.entry(self._stop)()
        ended = self._worker.close(within)
        if not ended:
            self._runtime.log.warning("the app does not end: %s", self.runner.hangs(self._worker.thread, CLOSE_WITHIN))
        else:
            self._snapshots.close()
            self._votes.close()
        return ended

    def _stop(self) -> None:
        """Do nothing from now on: whoever closes the files afterwards closes them under nobody's hands."""
        self._closed = True

    # What happens

    def perform_soon(self) -> None:
        """Carry out what the frames of this moment call for, once for all of them."""
        if not self._performing:
            self._performing = True
            self._runtime.soon(self._perform)

    def receive_note(self, sender: str, payload: bytes) -> None:
        """Take a robot's note about the members, passed on by `sender`. Where it tells of a later epoch, a robot that
        still waits for its first measurement is outside, and says so: all would wait for it."""
        if self.run.terms.drop and self.run.phase == "starting" and self._measuring_since is not None:
            with contextlib.suppress(PayloadError):
                if EpochNote.decode(payload).epoch.counter > 0:
                    self.run.epochs.well = False
        self.run.receive_note(sender, payload, self._runtime.now)
        self._perform()

    def request(self, request: EpochRequest) -> None:
        """The operator asks for other members."""
        self.run.request(request, self._runtime.now)
        self._perform()

    def nudge(self) -> None:
        """The bus or a link came up: ask now for what is missing."""
        self.run.nudge(self._runtime.now)
        self._perform()

    def change(self, changed: Callable[[], None], values: Mapping[str, Value]) -> None:
        """Other values for live parameters from the next step on; then `changed()` is called."""
        self.runner.changed = changed
        self.runner.change(values)

    def look(self) -> None:
        """Publish state and progress where they are new, or were told a while ago."""
        run, now = self.run, self._runtime.now
        since = self._worker.running_since
        if since is not None and now - since >= HANG:
            self._fail(self.runner.hangs(self._worker.thread, HANG))
        waited = self._measuring_since
        if run.terms.drop and run.epochs.well and waited is not None and now - waited >= run.terms.after:
            run.epochs.withdraw(now)  # the others need not wait for a measurement that does not come
            self._perform()
        repeated, _ = self._status.look()
        if repeated:
            if not run.begun:
                self._runtime.waits(self.progress.reason)
            for name, count in run.counters.items():
                self._runtime.counters[f"{self._counted}_{name.replace(' ', '_')}"] = count

    # The app's steps

    def _measure(self, k: int, ready: Callable[[Measurement | None], None]) -> None:
        """Call `ready` with the measurement for step k, or with None where the app wants none."""
        if self._measurements is None:
            ready(None)
        else:
            self._measuring_since = self._runtime.now
            self._measurements.get(k, partial(self._take_measurement, ready))

    def _measure_alone(self, k: int, asked: Channel, ready: Callable[[Measurement | None], None]) -> None:
        """Measure for a step that was planned a while ago. A void one must not take the place of another request."""
        if self._counts(asked):
            self._measure(k, ready)

    def _counts(self, asked: Channel) -> bool:
        """Return whether a step asked for under a channel counts: it is void as soon as there is a newer epoch, even
        while the app goes over to that."""
        return asked is self.run.channel and asked.epoch == self.run.epochs.number

    def _take_measurement(self, ready: Callable[[Measurement | None], None], measurement: Measurement) -> None:
        self._measuring_since = None
        if not self._closed and not self.failed:
            self._take_part()
            ready(measurement)

    def _take_part(self) -> None:
        """Let the others take this robot into the run, since a measurement has come."""
        if not self.run.epochs.well:
            self.run.epochs.take_part(self._runtime.now)
            self._perform()

    def _start(self, saved: list[Snapshot], measurement: Measurement | None) -> None:
        self._worker.run(partial(self.run.start, saved, measurement), partial(self._begin, saved), self._app_failed)

    def _begin(self, saved: list[Snapshot], first: AppAnswer | None) -> None:
        run, log = self.run, self._runtime.log
        if self._closed or self.failed:
            return
        run.begin(saved, first, self._runtime.now)
        if saved:
            log.info("goes on at iteration %d", run.k)
        elif run.lost:
            log.warning("this robot has lost its state of the run and waits for the next epoch")
        self._perform()
        self._on_change()

    def _step(self, todo: Compute, asked: Channel, measurement: Measurement | None) -> None:
        if not self._closed and not self.failed and self._counts(asked):
            self._measured = measurement
            self._worker.run(
                partial(self.run.compute, todo, measurement), partial(self._computed, todo, asked), self._app_failed
            )

    def _computed(self, todo: Compute, asked: Channel, answer: AppAnswer) -> None:
        if not self.failed and self._counts(asked):
            self.run.computed(todo, answer, self._runtime.now)
            self._perform()

    def _renew(self, epoch: Epoch, measurement: Measurement | None) -> None:
        if not self._closed and not self.failed and epoch.number == self.run.epochs.number:
            self._measured = None
            self._worker.run(
                partial(self.run.renew, epoch, measurement), partial(self._renewed, epoch), self._app_failed
            )

    def _renewed(self, epoch: Epoch, answer: AppAnswer | None) -> None:
        if not self.failed:
            self.run.renewed(epoch, answer, self._runtime.now)
            self._perform()

    def _app_failed(self, error: SwarmError) -> None:
        self._fail(bounded(error))

    # What the lockstep wants

    def _perform(self) -> None:
        """Carry out what the lockstep wants, in its order."""
        run = self.run
        self._performing = False
        if self._closed:
            return
        for action in run.actions():
            if self._muted:
                return
            if type(action) is Save:
                self._keep(self._snapshots.keep, action.snapshot)
            elif type(action) is Send:
                if self._channel is not run.channel:
                    self._channel = run.channel
                    self._sync = f"{self._prefix}/{self._channel.text}"
                sync = key_of(self._sync, action.to, around=action.around)
                self._bus.publish(sync, action.data, urgent=True)
            elif type(action) is Advanced:
                begun, self.latest = self.latest is not None, action
                self._advanced(action.k, begun=begun)
            elif type(action) is Compute:
                step = partial(self._step, action, run.channel)
                if action.values:
                    self._runtime.soon(self._measure, action.k, step)
                else:  # not from within: a robot without neighbours would never come back
                    self._runtime.at(self._runtime.now + ALONE, self._measure_alone, action.k, run.channel, step)
            elif type(action) is SaveEpochs:
                self._keep(self._votes.write, action.kept)
            elif type(action) is SendToNeighbours:
                self._bus.publish(self._notes, action.data, urgent=True)
            elif type(action) is SwitchEpoch:
                self._switched(action.epoch)
            elif type(action) is Renew:
                self._runtime.soon(self._measure, action.epoch.k, partial(self._renew, action.epoch))
            elif type(action) is Waiting:
                self._tell_observer()
            elif type(action) is Fault:
                self._ended(action.reason)
            elif type(action) is Finished:
                self._ended("")
        self._timer.plan(run.next_deadline(self._runtime.now))

    def _handle_timer(self) -> None:
        now = self._runtime.now
        deadline = self.run.next_deadline(now)
        if not self._closed and deadline is not None and deadline <= now:
            self.run.handle_timer(now)
        self._perform()

    def _advanced(self, k: int, *, begun: bool) -> None:
        """Tell that iteration k is reached; `begun`: it is not the first one that this process reaches."""
        if not begun:
            self._on_change()  # only now: after a reboot there is no state before the next epoch
        if self._observer is not None:
            if not begun or self._told_waiting:
                self._tell_observer()
            assert self.run.told is not None
            self._observer.advanced(self, StepRecord(k, self.run.computed_at, *self.run.told, self._measured))
        if self._status.late:
            self._status.publish_state()

    def _switched(self, epoch: Epoch) -> None:
        self._runtime.log.info("epoch %d from iteration %d on: %s", epoch.counter, epoch.k, " ".join(epoch.members))
        self._need(epoch)
        message = told(epoch, self._runtime.now)
        self._bus.publish(self._epoch_key, message)
        if self._observer is not None:
            self._observer.switched(self, message)
            self._told_waiting = self.progress.phase == "waiting"
        self._on_change()

    def _need(self, epoch: Epoch) -> None:
        self.watch.need(epoch.graph.neighbours(self.robot) if self.robot in epoch.members else ())

    def _tell_observer(self) -> None:
        if self._observer is not None:
            self._told_waiting = self.progress.phase == "waiting"
            self._observer.progressed(self)

    def _keep(self, write: Callable[..., None], what: object) -> None:
        try:
            write(what)
        except SwarmError as error:
            # What was not written must never be sent (R5): the neighbours keep what they had of us.
            self._muted = True
            self._fail(str(error))

    def _fail(self, reason: str) -> None:
        """Compute no more, say why, and stay: neighbours still get answers."""
        if self.run.fail(reason, self._runtime.now):
            self._ended(reason)

    def _ended(self, fault: str) -> None:
        """The lockstep is at its last iteration, or has failed."""
        if fault:
            self._runtime.log.error("%s", fault)
            self._runtime.degraded(fault)
        if self._observer is not None:
            self._observer.ended(self)
        self._on_change()

    # What is told

    def _look_at_state(self) -> AppState | None:
        run = self.run
        if run.phase not in ("running", "done") or run.told is None:
            return None
        return AppState(run.computed_at, run.k, run.told.state, self.runner.known(run.told.result))

    def _report(self) -> tuple[str, int, tuple[str, ...], str]:
        """Phase, iteration, robots waited for, reason."""
        run, since = self.run, self._measuring_since
        if run.phase in ("starting", "running") and since is not None and self._runtime.now - since >= REPEAT:
            return "waiting", run.k, (), "the dwm service gives no measurement"
        if run.phase == "running" and (reason := run.obstacle):
            return "waiting", run.k, run.waiting, reason
        if run.phase == "running" and run.waiting:
            return "waiting", run.k, run.waiting, self.watch.reason(run.waiting)
        return run.phase, run.k, (), run.reason


def _ignore(_: Measurement | None) -> None:
    """Drop a measurement that was only asked for to see that measurements come."""
