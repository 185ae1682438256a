"""How long calls take beside one that all are compared with, and what memory they need.

Calls are timed in turn, round after round, each together with the floor: what else the
machine does, or how fast its clock is, then slows both alike.
"""

from __future__ import annotations

import math
import os
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np

from fdnt_xp.app.backends import Backend
from fdnt_xp.errors import FdntValueError

_MOST_ROUNDS: Final = 25
_FLOOR_SECONDS: Final = 0.02
"""Least time of the floor, which is repeated: ticks of the clock and interrupts are in it."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """Something to time.

    Parameters
    ----------
    name : str
    n_gal : int
        Galaxies that one call takes.
    run : callable
        Does it, waits until it is done, and returns the fraction of the galaxies it could use.
    """

    name: str
    n_gal: int
    run: Callable[[], float]


@dataclass(frozen=True, kw_only=True)
class Timing:
    """How long a case took.

    Parameters
    ----------
    name : str
    n_gal : int
        Galaxies that one call took.
    seconds : float
        Of a galaxy: median of the rounds.
    ratio, ratio_err : float
        Of the time of a galaxy to that of the floor in the same round: median, and half the
        distance of the quartiles.
    n_rounds : int
    used : float
        Fraction of the galaxies.
    peak_bytes : int or None
        Most memory that it held at a time, beyond its arguments; None if that is not known.
    """

    name: str
    n_gal: int
    seconds: float
    ratio: float
    ratio_err: float
    n_rounds: int
    used: float
    peak_bytes: int | None


@dataclass(frozen=True, kw_only=True)
class Clock:
    """A clock and what to call it."""

    name: str
    now: Callable[[], float]


def clock_for(backend: Backend, threads: int) -> Clock:
    """Return CPU time where one thread does all the work, else wall time."""
    if threads == 1 and backend.library in ("numpy", "torch") and backend.on_cpu:
        return Clock(name="CPU time", now=time.process_time)
    return Clock(name="wall time", now=time.perf_counter)


def time_cases(
    floor: Case, cases: Sequence[Case], *, backend: Backend, clock: Clock, seconds: float
) -> list[Timing]:
    """Time cases in turn; the first of the list is the floor itself.

    Parameters
    ----------
    floor : Case
        What the others are compared with; it is called before each of them.
    cases : sequence of Case
    backend : Backend
        Where they run.
    clock : Clock
    seconds : float
        Of wall time; rounds begin while there is enough left, and there is one at least.
    """
    started = time.perf_counter()
    everything = [floor, *cases]
    # The first call makes tables and compiles; it counts for nothing else.
    used = [case.run() for case in everything]
    peaks = [_peak_bytes(case, backend) for case in everything]
    once = _timed(floor, clock) * floor.n_gal
    repeats = math.ceil(min(100.0, _FLOOR_SECONDS / max(once, 1e-9)))
    times: list[list[tuple[float, float]]] = []
    longest = 0.0
    while len(times) < _MOST_ROUNDS:
        begun = time.perf_counter()
        times.append([(_timed(floor, clock, repeats), _timed(case, clock)) for case in everything])
        longest = max(longest, time.perf_counter() - begun)
        if time.perf_counter() - started + longest > seconds:
            break
    by_case = np.array(times)  # (round, case, floor or case)
    ratios = by_case[:, :, 1] / by_case[:, :, 0]
    quartiles = np.quantile(ratios, [0.25, 0.75], axis=0)
    return [
        Timing(
            name=case.name,
            n_gal=case.n_gal,
            seconds=float(np.median(by_case[:, i, 1])),
            ratio=float(np.median(ratios[:, i])),
            ratio_err=float(0.5 * (quartiles[1, i] - quartiles[0, i])),
            n_rounds=len(times),
            used=used[i],
            peak_bytes=peaks[i],
        )
        for i, case in enumerate(everything)
    ]


def cores() -> int:
    """Return how many cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        return os.cpu_count() or 1


def check_threads(threads: int) -> None:
    """Refuse more threads than cores, and none."""
    if not 1 <= threads <= cores():
        raise FdntValueError(
            f"--threads must be 1 to {cores()}, the cores that this process may use, not {threads}"
        )


@contextmanager
def limited_threads(backend: Backend, threads: int) -> Iterator[str | None]:
    """Let a library compute with as many threads; give the remark to make if it cannot be told.

    Raises
    ------
    FdntValueError
        If there are fewer cores.
    """
    check_threads(threads)
    remark = None
    with ExitStack() as stack:
        if backend.library == "torch":
            import torch

            stack.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(threads)
        elif backend.library == "numpy":
            try:
                from threadpoolctl import threadpool_limits
            except ImportError:
                remark = (
                    "threads of NumPy's BLAS are as the environment has them: "
                    "pip install threadpoolctl"
                )
            else:
                stack.enter_context(threadpool_limits(limits=threads))
        elif backend.on_cpu:
            remark = f"{backend.library} chooses its threads itself"
        yield remark


def _timed(case: Case, clock: Clock, repeats: int = 1) -> float:
    """Return the time of a galaxy."""
    start = clock.now()
    for _ in range(repeats):
        case.run()
    return (clock.now() - start) / (repeats * case.n_gal)


def _peak_bytes(case: Case, backend: Backend) -> int | None:
    """Return the most memory that a call holds at a time; None where nothing counts it."""
    if backend.library == "numpy":
        tracemalloc.start()
        try:
            case.run()
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    if backend.library == "torch" and not backend.on_cpu:
        import torch

        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        case.run()
        return int(torch.cuda.max_memory_allocated() - before)
    return None
