"""The runtime of a process, and that of virtual time: what a shell may rely on holds on both."""

import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterator

import pytest
from conftest import wait_until
from hypothesis import given
from hypothesis import strategies as st

from sim.virtual.bus import VirtualBus, VirtualRouter
from sim.virtual.events import EventQueue
from sim.virtual.runtime import VirtualRuntime
from swarm.errors import AppError, SwarmError
from swarm.process import threads
from swarm.process.runtime import Runtime
from swarm.process.threads import ThreadedRuntime

PATIENCE = 20.0


class FakeService:
    """What a runtime needs of a service."""

    def __init__(self) -> None:
        self.robot = "r0"
        self.log = logging.getLogger("test")
        self.counters: Counter[str] = Counter()
        self.bus = VirtualBus(VirtualRouter(EventQueue()))
        self.fed = threading.Event()

    def watchdog(self) -> None:
        self.fed.set()


class Bench:
    """A runtime, and a way to let its time pass."""

    def __init__(self, kind: str) -> None:
        self.service = FakeService()
        self.queue = EventQueue()
        self.threaded = kind == "threads"
        self.runtime: Runtime
        if self.threaded:
            self.runtime = ThreadedRuntime(self.service)  # type: ignore[arg-type]
        else:
            self.runtime = VirtualRuntime("r0", self.queue, VirtualBus(VirtualRouter(self.queue)))

    def until(self, done: threading.Event) -> None:
        if self.threaded:
            assert done.wait(PATIENCE)
        else:
            self.queue.run(1.0)
            assert done.is_set()

    def close(self) -> None:
        if isinstance(self.runtime, ThreadedRuntime):
            self.runtime.close()


@pytest.fixture(params=["threads", "virtual"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    bench = Bench(request.param)
    yield bench
    bench.close()


def fail(error: SwarmError) -> None:
    raise AssertionError(error)


def test_what_is_soon_comes_after_what_runs_and_in_its_order(bench: Bench) -> None:
    found: list[str] = []
    done = threading.Event()

    def call() -> None:
        bench.runtime.soon(found.append, "second")
        bench.runtime.soon(lambda: (bench.runtime.soon(done.set), found.append("third")))
        found.append("first")

    bench.runtime.entry(call)()
    bench.until(done)
    assert found == ["first", "second", "third"]


def test_planned_calls_come_in_the_order_of_their_times(bench: Bench) -> None:
    found: list[int] = []
    done = threading.Event()
    now = bench.runtime.now

    def plan() -> None:
        for number in (3, 1, 2):
            bench.runtime.at(now + 0.02 * number, found.append, number)
        bench.runtime.at(now + 0.08, done.set)
        bench.runtime.at(now - 1.0, found.append, 0)

    bench.runtime.entry(plan)()
    bench.until(done)
    assert found == [0, 1, 2, 3]


def test_a_worker_does_its_jobs_in_turn_and_tells_what_came_of_them(bench: Bench) -> None:
    worker = bench.runtime.worker("jobs")
    found: list[object] = []
    done = threading.Event()

    def breaks() -> int:
        raise AppError("no more")

    def give() -> None:
        worker.run(lambda: 1, found.append, fail)
        worker.run(breaks, found.append, lambda error: found.append(str(error)))
        worker.run(lambda: 3, lambda result: (found.append(result), done.set()), fail)  # type: ignore[arg-type]

    bench.runtime.entry(give)()
    bench.until(done)
    assert found == [1, "no more", 3]
    assert not worker.busy
    assert worker.running_since is None
    assert worker.close(PATIENCE)


def test_what_follows_a_job_may_fail_like_the_job(bench: Bench) -> None:
    worker = bench.runtime.worker("jobs")
    found: list[str] = []
    done = threading.Event()

    def breaks(_: object) -> None:
        raise AppError("too late")

    def give() -> None:
        worker.run(lambda: 1, breaks, lambda error: found.append(str(error)))
        worker.run(lambda: 2, lambda _: done.set(), fail)

    bench.runtime.entry(give)()
    bench.until(done)
    assert found == ["too late"]


def test_a_wrong_sample_leaves_what_is_soon_to_come() -> None:
    """What an entry raises costs that entry; nothing planned before or after is lost."""
    bench = Bench("threads")
    found: list[str] = []

    def wrong() -> None:
        bench.runtime.soon(found.append, "before")
        raise AppError("no sample")

    def later() -> None:
        bench.runtime.soon(breaks)
        bench.runtime.soon(found.append, "behind it")

    def breaks() -> None:
        raise AppError("no call")

    for entry in (wrong, later):
        with pytest.raises(AppError):
            bench.runtime.entry(entry)()
    bench.runtime.entry(lambda: bench.runtime.soon(found.append, "last"))()
    assert found == ["before", "behind it", "last"]
    bench.close()


def test_of_entries_on_many_threads_one_runs_at_a_time() -> None:
    bench = Bench("threads")
    inside, most, total = 0, 0, 0

    def call() -> None:
        nonlocal inside, most, total
        inside += 1
        most = max(most, inside)
        total += 1
        bench.runtime.soon(lambda: None)
        inside -= 1

    def many() -> None:
        for _ in range(500):
            bench.runtime.entry(call)()

    callers = [threading.Thread(target=many) for _ in range(4)]
    for thread in callers:
        thread.start()
    for thread in callers:
        thread.join(PATIENCE)
    bench.close()
    assert (total, most) == (2000, 1)


def test_a_job_that_runs_holds_up_no_entry_and_is_seen_as_busy() -> None:
    bench = Bench("threads")
    worker = bench.runtime.worker("jobs")
    running, free, entered, ended = (threading.Event() for _ in range(4))

    def job() -> None:
        running.set()
        assert free.wait(PATIENCE)

    bench.runtime.entry(lambda: worker.run(job, lambda _: ended.set(), fail))()
    assert running.wait(PATIENCE)
    assert worker.busy
    assert worker.running_since is not None
    bench.runtime.entry(entered.set)()
    assert entered.is_set()
    free.set()
    assert ended.wait(PATIENCE)
    bench.close()


def test_a_job_that_does_not_end_is_left_behind_and_says_nothing_any_more() -> None:
    bench = Bench("threads")
    worker = bench.runtime.worker("jobs")
    running, free = threading.Event(), threading.Event()
    found: list[object] = []

    def job() -> int:
        running.set()
        free.wait(PATIENCE)
        return 1

    bench.runtime.entry(lambda: worker.run(job, found.append, fail))()
    assert running.wait(PATIENCE)
    assert not worker.close(0.05)
    free.set()
    assert worker.close(PATIENCE)
    assert found == []
    bench.close()


def test_a_regular_call_is_frequent_while_it_is_heard_and_rare_while_it_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """The times are those that it plans: nothing is measured."""
    bench = Bench("threads")
    runtime = bench.runtime
    assert isinstance(runtime, ThreadedRuntime)
    planned: list[float] = []
    plain = runtime.at

    def at(time: float, call: Callable[..., object], *arguments: object) -> None:
        planned.append(time - runtime.now)
        plain(time, call, *arguments)

    monkeypatch.setattr(runtime, "at", at)
    called = threading.Semaphore(0)
    heard = VirtualBus(bench.service.bus._router)
    subscription = heard.subscribe("swarm/r0/app/x/state", lambda key, payload: None)
    runtime.every(0.01, called.release, ("swarm/r0/app/x/state",))
    assert called.acquire(timeout=PATIENCE)
    assert called.acquire(timeout=PATIENCE)
    assert max(planned) <= 0.01
    subscription.close()
    planned.clear()
    wait_until(lambda: planned and planned[-1] > threads.SELDOM - 0.1, what="the next call is planned for later")
    assert max(planned) <= threads.SELDOM
    bench.close()


def test_the_watchdog_is_fed_while_nothing_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_FEED", 0.01)
    monkeypatch.setattr(threads, "HANG", 0.02)
    bench = Bench("threads")
    runtime = bench.runtime
    assert bench.service.fed.wait(PATIENCE)
    worker = runtime.worker("jobs")
    running, free = threading.Event(), threading.Event()

    def job() -> None:
        running.set()
        free.wait(PATIENCE)

    runtime.entry(lambda: worker.run(job, lambda _: None, fail))()
    assert running.wait(PATIENCE)
    looks = threading.Semaphore(0)
    for _ in range(4):  # until the job has run for long enough to be stuck
        runtime.at(runtime.now + 0.03, looks.release)
        assert looks.acquire(timeout=PATIENCE)
    bench.service.fed.clear()
    for _ in range(4):
        runtime.at(runtime.now + 0.02, looks.release)
        assert looks.acquire(timeout=PATIENCE)
    assert not bench.service.fed.is_set()
    free.set()
    assert bench.service.fed.wait(PATIENCE)
    bench.close()


@given(st.lists(st.sampled_from(["entry", "soon", "at"]), max_size=30))
def test_whatever_is_asked_for_is_called_once(wishes: list[str]) -> None:
    bench = Bench("virtual")
    found: list[int] = []
    for number, wish in enumerate(wishes):
        if wish == "entry":
            bench.runtime.entry(found.append)(number)
        elif wish == "soon":
            bench.runtime.soon(found.append, number)
        else:
            bench.runtime.at(bench.runtime.now + 0.001 * number, found.append, number)
    bench.queue.run(10.0)
    assert sorted(found) == list(range(len(wishes)))
