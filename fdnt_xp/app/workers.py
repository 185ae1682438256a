"""One job for many tasks: done here, by processes of this machine, or by a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeVar

from fdnt_xp.errors import FdntValueError, FdntWarning, MissingExtraError

T = TypeVar("T")
R = TypeVar("R")

_CONNECT_SECONDS: Final = 5
"""Within which a scheduler must answer."""
_DEATHS_AT_MOST: Final = 2
"""Of processes that had a task, before it is given up; on a cluster Dask counts them."""
_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""How libraries are told at their start how many threads to take."""


@dataclass(frozen=True)
class Failure:
    """What there is of a task that has no result.

    Parameters
    ----------
    reason : str
        One line.
    """

    reason: str


class Workers(Protocol):
    """Those who do the job."""

    def each(self, job: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[T, R | Failure]]:
        """Do the job for each task; yield task and result as they are done, in any order.

        The job is a function of a module, or a `functools.partial` of one. It returns
        `Failure` instead of raising. A task whose worker dies is given to another, and given
        up if they die repeatedly.
        """


@contextmanager
def open_workers(jobs: int = 1, scheduler: str | None = None) -> Iterator[Workers]:
    """Give the workers that were asked for.

    Parameters
    ----------
    jobs : int
        Processes on this machine, each with one thread; 1 does everything in this process.
    scheduler : str, optional
        Address of a Dask scheduler, `tcp://host:8786`: instead, its workers do the job.

    Raises
    ------
    FdntValueError
        If both are given, or no scheduler answers at that address.
    MissingExtraError
        If `distributed` is needed and not installed.
    """
    if scheduler is None:
        yield _Here() if jobs == 1 else _Processes(jobs)
        return
    if jobs != 1:
        raise FdntValueError("give --jobs or --scheduler, not both")
    client = _connect(scheduler)
    try:
        yield _Cluster(client)
    finally:
        client.close()


def warn_of_too_many(jobs: int) -> None:
    """Warn (`FdntWarning`) if processes and their threads are more than this machine's cores."""
    asked = os.environ.get(_THREADS[0], "")
    threads = int(asked) if asked.isdecimal() else 1
    allowed = getattr(os, "sched_getaffinity", None)
    cores = len(allowed(0)) if allowed is not None else os.cpu_count() or 1
    if jobs * threads > cores:
        of_each = f" of {_THREADS[0]}={threads} threads" if threads > 1 else ""
        many = "process" if jobs == 1 else "processes"
        warnings.warn(
            f"{jobs} {many}{of_each} are more than the {cores} cores there are: "
            "fewer would be as fast",
            FdntWarning,
            stacklevel=2,
        )


@dataclass(frozen=True)
class _Here:
    """The process that asks."""

    def each(self, job: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[T, R | Failure]]:
        """Do one task after the other."""
        for task in tasks:
            yield task, job(task)


@dataclass(frozen=True)
class _Processes:
    """Processes of this machine; they end with this one, however it ends."""

    jobs: int

    def each(self, job: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[T, R | Failure]]:
        """Do as many tasks at a time as there are processes."""
        waiting = list(range(len(tasks)))
        deaths: Counter[int] = Counter()
        while waiting:
            for number, future in self._round(job, tasks, waiting):
                if not isinstance(future.exception(), BrokenProcessPool):
                    waiting.remove(number)
                    yield tasks[number], future.result()
            # Tasks are begun in their order: the first that are left were in work when a
            # process died, and it may be one of them that killed it.
            suspects, waiting = waiting[: self.jobs], waiting[self.jobs :]
            deaths.update(suspects)
            for number in suspects:
                if deaths[number] < _DEATHS_AT_MOST:
                    waiting.append(number)
                else:
                    yield tasks[number], Failure("its process died: killed, or out of memory")

    def _round(
        self, job: Callable[[T], R], tasks: Sequence[T], numbers: list[int]
    ) -> Iterator[tuple[int, Future[R]]]:
        """Yield tasks as they are done; once a process dies, all that are left."""
        others = set(multiprocessing.active_children())
        with ProcessPoolExecutor(
            min(self.jobs, len(numbers)),
            # A fork of a process with threads may hang, and CUDA does not survive it.
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_begin_process,
        ) as pool:
            try:
                with _one_thread_each():
                    futures = {pool.submit(job, tasks[number]): number for number in numbers}
                for future in as_completed(futures):
                    yield futures[future], future
            except BaseException:  # an interrupt, or the caller wants no more
                ours = set(multiprocessing.active_children()) - others
                for process in ours:
                    process.terminate()
                for process in ours:
                    process.join()
                pool.shutdown(cancel_futures=True)
                raise


@dataclass(frozen=True)
class _Cluster:
    """The workers of a Dask scheduler, by its client."""

    client: Any

    def each(self, job: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[T, R | Failure]]:
        """Hand all tasks to the scheduler."""
        from distributed import as_completed as as_completed_there

        if tasks and not self.client.scheduler_info()["workers"]:
            warnings.warn(
                "the Dask scheduler has no workers yet: waiting for one", FdntWarning, stacklevel=2
            )
        futures = dict(zip(self.client.map(job, tasks, pure=False), tasks, strict=True))
        try:
            for future in as_completed_there(list(futures), loop=self.client.loop):
                yield futures.pop(future), _result_of(future)
        finally:
            self.client.cancel(list(futures))


def _connect(scheduler: str) -> Any:
    """Return a Dask client."""
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtraError(
            "--scheduler needs distributed, which is not installed: pip install 'fdnt-xp[cluster]'"
        ) from error
    try:
        return Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, ImportError) as error:
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise FdntValueError(f"no Dask scheduler at {scheduler}: {reason}") from error


def _result_of(future: Any) -> Any:
    """Return the result of a Dask future, or why there is none."""
    try:
        return future.result()
    except Exception as error:
        # The job itself raises nothing: its workers died, or cannot run it, or all is lost.
        reason = " ".join(str(error).split())
        return Failure(f"the cluster gave it up: {type(error).__name__}: {reason}")


def _begin_process() -> None:
    """Let Ctrl-C be for the process that began this one, and end with that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait until the process that began this one is gone; else this one would wait for it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes that begin now take one thread, unless the environment says otherwise."""
    new = [name for name in _THREADS if name not in os.environ]
    os.environ.update(dict.fromkeys(new, "1"))
    try:
        yield
    finally:
        for name in new:
            del os.environ[name]
