"""How jobs are run: by processes of this machine, or by the workers of a dask scheduler.

The scheduler's address is all that changes: ``--scheduler tcp://HOST:8786`` of a command, or dask's
own environment variable ``DASK_SCHEDULER_ADDRESS`` for notebooks. Workers need the same code and
packages, which is checked, and the same folders, since policies and check-points are files there.
Rows come back to the one process that asked for them, and it alone writes them.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import joblib
from threadpoolctl import threadpool_limits

from experiments import origin
from experiments.orphans import end_with

Job = Callable[[], Any]
ADDRESS = "DASK_SCHEDULER_ADDRESS"
TO_CONNECT = 10  # seconds


class WorkError(RuntimeError):
    """Jobs that cannot be run, or not to the end; what was finished has been handed over."""


def finished(
    jobs: Sequence[Job], num_workers: int | None = None, scheduler: str | None = None
) -> Iterator[Any]:
    """The results of jobs, each as soon as it is there.

    Args:
        jobs: functions without arguments; they and their results can be pickled.
        num_workers: processes on this machine; ``None`` leaves it to ``joblib.parallel_config``.
        scheduler: address of a dask scheduler, whose workers run the jobs instead; ``None``: that
            of the environment variable, if there is one. A job whose worker dies is run again.

    Raises:
        WorkError: a scheduler that cannot be reached or is lost, or a worker that is not like us.
    """
    if scheduler := scheduler or os.environ.get(ADDRESS):
        yield from _on_cluster(jobs, scheduler)
    else:
        run = parallel(num_workers, return_as="generator_unordered")
        yield from run(joblib.delayed(_in_one_thread)(job) for job in jobs)


def _in_one_thread(job: Job) -> Any:
    """As on any worker, so that rows do not depend on who computes them, and threads not wait."""
    import torch  # noqa: F401  (threads are limited of what is loaded; who only reads needs it not)

    with threadpool_limits(1):
        return job()


def parallel(num_workers: int | None, **options: Any) -> joblib.Parallel:
    """``joblib.Parallel``, whose workers end with this process however it ends.

    Left alone, they would wait 300 seconds for more work from a parent that is no more.
    """
    return joblib.Parallel(
        n_jobs=num_workers, initializer=end_with, initargs=(os.getpid(),), **options
    )


def num_at_once(num_workers: int | None, scheduler: str | None = None) -> int:
    """How many jobs are run at the same time: by so many processes, or by a scheduler's workers.

    Workers may come later, as those of a queue do; there will be at least one.
    """
    if scheduler := scheduler or os.environ.get(ADDRESS):
        with _client(scheduler) as client:
            return max(1, len(client.nthreads()))
    return joblib.effective_n_jobs(num_workers)


def _on_cluster(jobs: Sequence[Job], scheduler: str) -> Iterator[Any]:
    from distributed import CancelledError, as_completed

    with _client(scheduler) as client:
        wanted = _alike(num_threads=1)
        futures = [client.submit(_run, job, wanted, pure=False) for job in jobs]
        try:
            for future in as_completed(futures, loop=client.loop):
                yield future.result()
        except CancelledError as error:
            raise WorkError(
                f"scheduler = {scheduler!r}: was lost. What was finished is saved, and the same "
                "call goes on from there"
            ) from error


def _client(scheduler: str) -> Any:
    try:
        from distributed import Client
        from distributed.comm import get_address_host_port
    except ImportError as error:
        raise WorkError(
            f"scheduler = {scheduler!r}: needs dask: pip install -e 'notebooks[cluster]'"
        ) from error
    try:  # a client that finds nobody goes on looking in the background
        socket.create_connection(get_address_host_port(scheduler), TO_CONNECT).close()
        return Client(scheduler, timeout=TO_CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkError(f"scheduler = {scheduler!r}: cannot be reached: {error}") from error


def _run(job: Job, wanted: dict[str, Any]) -> Any:
    """A job on a worker, which must be like the one who asks: rows would be others, unnoticed."""
    from distributed import get_worker

    worker = get_worker()
    found = _alike(worker.state.nthreads)
    for name, value in wanted.items():
        if found[name] != value:
            raise WorkError(
                f"worker {worker.address}: {name} = {found[name]!r}, must be {value!r} as here"
            )
    return job()


def _alike(num_threads: int) -> dict[str, Any]:
    """What must be the same on all workers. A worker with two threads would mix up two jobs."""
    return {**origin.versions(), "commit": origin.commit(), "num_threads": num_threads}
