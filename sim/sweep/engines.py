"""The engines of a sweep's runs: processes of this machine, or a Dask cluster. The same runs give the same results,
since a run knows only its arguments."""

import contextlib
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from typing import Any, Protocol

from services.apps.loader import LoadedApp
from sim.sweep.measure import SweptRun, measure
from sim.sweep.plan import Job
from swarm.errors import MissingPackageError

ENGINES = ("local", "dask")


class Engine(Protocol):
    """A function that computes runs."""

    def __call__(self, jobs: Sequence[Job], done: Callable[[], None]) -> list[SweptRun]:
        """Compute all jobs and return their runs in the same order; `done()` is called after each."""


@contextlib.contextmanager
def here(app: LoadedApp) -> Iterator[Engine]:
    """Yield an engine that does one run after the other here: an app that is a class cannot go to another process."""

    def run(jobs: Sequence[Job], done: Callable[[], None]) -> list[SweptRun]:
        found = []
        for job in jobs:
            found.append(measure(job, app))
            done()
        return found

    yield run


@contextlib.contextmanager
def local(processes: int) -> Iterator[Engine]:
    """Yield an engine of so many processes of this machine."""
    # Not forked: what is imported here has threads of its own.
    context = multiprocessing.get_context("spawn")
    pool: Executor = ProcessPoolExecutor(processes, mp_context=context)
    try:
        yield lambda jobs, done: _collect([pool.submit(measure, job) for job in jobs], as_completed, done)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def dask(processes: int, scheduler: str | None) -> Iterator[Engine]:
    """Yield a Dask cluster: the one at the address `scheduler`, whose workers have this package; else one of this
    machine."""
    try:
        from dask import distributed
    except ImportError:
        raise MissingPackageError("--engine dask", "distributed", "dask") from None
    with contextlib.ExitStack() as held:
        if scheduler is None:
            cluster = distributed.LocalCluster(
                n_workers=processes,
                threads_per_worker=1,
                # Its pages cannot be left out, and would be there for the whole network.
                dashboard_address="127.0.0.1:0",
                worker_dashboard_address="127.0.0.1:0",
            )
            scheduler = held.enter_context(cluster)
        client = held.enter_context(distributed.Client(scheduler))
        # Pure by name a run would be computed once for all sweeps of the cluster; each sweep is to compute its own.
        yield lambda jobs, done: _collect(client.map(measure, jobs, pure=False), distributed.as_completed, done)


def _collect(futures: Sequence[Any], completed: Callable[[Any], Any], done: Callable[[], None]) -> list[SweptRun]:
    for _ in completed(futures):
        done()
    return [future.result() for future in futures]
