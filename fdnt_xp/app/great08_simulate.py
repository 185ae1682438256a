"""What `fdnt-xp great08 simulate` does, between its options and its last line."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from tqdm import tqdm

from fdnt_xp.app.workers import Failure, Workers, open_workers
from fdnt_xp.errors import FdntError, RangeError
from fdnt_xp.great08.sets import Simulation
from fdnt_xp.great08.simulate import begin_challenge, remove_leftovers, write_set


def run_simulate(
    directory: str,
    simulation: Simulation,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    quiet: bool = False,
) -> Iterator[str]:
    """Draw the sets that are not there yet, and yield the lines of the report.

    Parameters
    ----------
    directory : str
        A new or empty folder, or one that was begun with the same `simulation`.
    simulation : Simulation
        What to draw.
    jobs, scheduler
        Who draws: see `fdnt_xp.app.workers.open_workers`. Workers of a cluster must see the
        same files. What is drawn does not depend on them.
    quiet : bool
        Whether there is no progress bar.

    Raises
    ------
    FdntError
        If the directory cannot be used, or a set cannot be drawn or written. All sets that
        have an image are whole; the same call goes on.
    """
    if jobs < 1:
        raise RangeError("jobs", jobs, 1, None)
    n_gal, side = simulation.grid**2, simulation.grid * simulation.cell
    yield (
        f"simulating {simulation.n_sets} sets of {n_gal} galaxies, {simulation.branch}, "
        f"S/N {simulation.snr:g}, {simulation.n_shears} shears"
    )
    yield f"images     {side} x {side} pixels, cells of {simulation.cell}"
    folder = Path(directory).absolute()
    waiting = begin_challenge(folder, simulation)
    kept = simulation.n_sets - len(waiting)
    if kept:
        yield f"finished   {kept} sets were there already"
    began = time.perf_counter()
    with open_workers(jobs, scheduler) as workers:
        try:
            _draw_all(workers, folder, simulation, waiting, quiet=quiet)
        finally:
            remove_leftovers(folder)
    if waiting:
        seconds = time.perf_counter() - began
        each = 1e3 * seconds / (len(waiting) * n_gal)
        yield f"drawn      {len(waiting)} sets in {seconds:.1f} s, {each:.2f} ms per galaxy"
    yield f"written    {directory}"


def _draw_all(
    workers: Workers, folder: Path, simulation: Simulation, waiting: list[int], *, quiet: bool
) -> None:
    job = partial(_draw_one, folder=folder, simulation=simulation)
    hidden = quiet or not sys.stderr.isatty()
    n_sets = simulation.n_sets
    with tqdm(
        total=n_sets, initial=n_sets - len(waiting), unit=" sets", leave=False, disable=hidden
    ) as bar:
        for number, failure in workers.each(job, waiting):
            if failure is not None:  # a full disk, say: the others would fail as well
                raise FdntError(f"set {number} could not be drawn: {failure.reason}")
            bar.update()


def _draw_one(number: int, *, folder: Path, simulation: Simulation) -> Failure | None:
    """Draw and write a set; say why if it cannot be done."""
    try:
        write_set(folder, simulation, number)
    except FdntError as error:
        return Failure(" ".join(str(error).split()))
    return None
