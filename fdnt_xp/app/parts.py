"""A catalog made part by part, by processes if need be: what a kill leaves is gone on with.

The folder `CATALOG.parts` holds what is finished until the catalog is whole:

- `run.json`: the options, the files as they were, and the versions that began it;
- `rows0000000000-0000008192.npz`: the columns of some galaxies, each file whole or not there.

The catalog is put together of all parts and renamed in one step; then the folder is removed.
"""

from __future__ import annotations

import math
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from astropy.table import Table, vstack
from astropy.table.meta import get_header_from_yaml, get_yaml_from_table

from fdnt_xp.app.resume import RUN, begin_run
from fdnt_xp.app.runner import galaxy_bar
from fdnt_xp.app.workers import Failure, Workers, open_workers
from fdnt_xp.data.files import new_file
from fdnt_xp.data.provenance import Value
from fdnt_xp.data.row_batches import new_catalog
from fdnt_xp.errors import CatalogError, FdntError, FdntWarning

PART: Final = 8192
"""Galaxies in a part, at most: some seconds of work, and so much is lost by a kill."""
_PARTS_PER_JOB: Final = 4
"""At least, so that all processes end at about the same time."""
_HEADER: Final = "__header__"
_ONE_AT_A_TIME: Final = threading.Lock()
"""Warnings are recorded for a whole process, and a worker of a cluster may have several threads."""


class Rows(NamedTuple):
    """Galaxies `start` to `stop - 1`."""

    start: int
    stop: int

    @property
    def name(self) -> str:
        """Of the file of this part."""
        return f"rows{self.start:010d}-{self.stop:010d}.npz"


class PartJob(Protocol):
    """Measures some galaxies; a function of a module or a `functools.partial` of one."""

    def __call__(self, rows: Rows, *, report: Callable[[int], object] | None) -> Table:
        """Return their table, and say to `report` how many are done as they are."""


@dataclass(frozen=True, kw_only=True)
class PartsReport:
    """How a catalog was made.

    Parameters
    ----------
    kept : astropy.table.Table
        Those columns of it that were asked for, with its header.
    n_before : int
        How many galaxies an earlier run had measured.
    seconds : float
        That measuring took.
    """

    kept: Table
    n_before: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class PartsRun:
    """What is to be made of parts.

    Parameters
    ----------
    output : Path
        The catalog.
    n_gal : int
        Its rows.
    chunk : int
        Galaxies that are measured at a time: parts are a whole number of them.
    options : mapping
        What must be the same when it is resumed; see `fdnt_xp.app.resume.begin_run`.
    shown : mapping
        What the user calls them.
    overwrite : bool
        Whether the catalog may replace a file.
    largest_part : int, optional
        Galaxies in a part, at most; `PART` without it.
    command : str
        Whose run it is.
    """

    output: Path
    n_gal: int
    chunk: int
    options: Mapping[str, Any]
    shown: Mapping[str, str]
    overwrite: bool = False
    largest_part: int | None = None
    command: str = "measure"

    @property
    def folder(self) -> Path:
        """Where the parts are."""
        return self.output.with_name(f"{self.output.name}.parts")

    @property
    def whole(self) -> Path:
        """The catalog before it has its name."""
        return self.folder / f"whole{self.output.suffix}"

    def make(
        self,
        job: PartJob,
        meta: Callable[[Mapping[str, Any]], dict[str, Value]],
        *,
        keep: Sequence[str] = (),
        jobs: int = 1,
        scheduler: str | None = None,
        quiet: bool = True,
    ) -> PartsReport:
        """Measure the parts that are not there yet, and write the catalog of all.

        Parameters
        ----------
        job : callable
            Measures a part.
        meta : callable
            Makes the header of the catalog, given that of the first part.
        keep : sequence of str
            Columns to return; the others are on disk only.
        jobs, scheduler
            Who measures: see `fdnt_xp.app.workers.open_workers`.
        quiet : bool
            No progress bar.

        Raises
        ------
        FdntError
            If a part cannot be measured or written; if the folder of parts is one of a run
            with other options. Parts that are finished stay, and the same call goes on.
        """
        folder, start = self.folder, time.perf_counter()
        with open_workers(jobs, scheduler) as workers:
            parts = self._begin(jobs)
            waiting = [rows for rows in parts if not (folder / rows.name).exists()]
            n_before = self.n_gal - sum(rows.stop - rows.start for rows in waiting)
            try:
                with galaxy_bar(self.n_gal, quiet=quiet, n_before=n_before) as bar:
                    here = bar.update if jobs == 1 and scheduler is None else None
                    each = partial(finish_part, job=job, folder=folder.absolute(), report=here)
                    _do_all(workers, each, waiting, None if here else bar.update)
                seconds = time.perf_counter() - start
                kept = self._put_together(parts, meta, keep)
            except (FdntError, KeyboardInterrupt) as error:
                if not (said := self._kept_parts()):
                    raise
                if isinstance(error, KeyboardInterrupt):
                    raise KeyboardInterrupt(said) from error
                raise FdntError(f"{error}; {said}") from error
            finally:
                self._remove_if_empty()
        return PartsReport(kept=kept, n_before=n_before, seconds=seconds)

    def _begin(self, jobs: int) -> list[Rows]:
        """Return all parts: those of the run that was begun, if there is one."""
        self._remove_if_empty()
        most = self.largest_part or PART
        share = math.ceil(self.n_gal / (_PARTS_PER_JOB * jobs)) if jobs > 1 else most
        n_chunks = max(min(share, most) // self.chunk, 1)
        choices = begin_run(
            self.folder,
            {"galaxies": self.n_gal, **self.options},
            command=self.command,
            remedy=f"remove {self.folder}",
            shown=self.shown,
            choices={"part": n_chunks * self.chunk},
            unfinished=self._unfinished,
        )
        size = int(choices["part"])
        starts = range(0, max(self.n_gal, 1), size)
        return [Rows(first, min(first + size, self.n_gal)) for first in starts]

    def _put_together(
        self,
        parts: Sequence[Rows],
        meta: Callable[[Mapping[str, Any]], dict[str, Value]],
        keep: Sequence[str],
    ) -> Table:
        """Write the catalog; return the columns that are kept."""
        first = _read_part(self.folder / parts[0].name)
        header = meta(first.meta)
        kept = []
        with new_catalog(self.whole, overwrite=True, meta=header) as catalog:
            for rows in parts:
                table = _read_part(self.folder / rows.name)
                catalog.append(table)
                kept.append(table[list(keep)])
        with new_file(self.output, overwrite=self.overwrite) as temporary:
            self.whole.replace(temporary)
        for rows in parts:
            (self.folder / rows.name).unlink()
        columns = vstack(kept, metadata_conflicts="silent") if keep else Table()
        columns.meta = header
        return columns

    def _kept_parts(self) -> str:
        """Say what there is to go on with, if anything."""
        ends = [file.stem.removeprefix("rows").split("-") for file in self._finished()]
        n_kept = sum(int(stop) - int(start) for start, stop in ends)
        if not n_kept:
            return ""
        return (
            f"{n_kept} of {self.n_gal} galaxies are in {self.folder}, and the same command "
            "goes on with them"
        )

    def _finished(self) -> list[Path]:
        return list(self.folder.glob("rows*.npz"))

    def _remove_if_empty(self) -> None:
        """Remove the folder if it holds no part: nothing is lost."""
        if self._finished() or not (self.folder / RUN).is_file():
            return
        for pattern in (*self._unfinished, ".run-*.json", RUN):
            for file in self.folder.glob(pattern):
                file.unlink(missing_ok=True)
        with suppress(OSError):  # something that is not ours is in it
            self.folder.rmdir()

    @property
    def _unfinished(self) -> tuple[str, ...]:
        return ".rows*.npz", f".whole-*{self.output.suffix}", self.whole.name


@dataclass(frozen=True, kw_only=True)
class PartNews:
    """What there is to say of a part.

    Parameters
    ----------
    warnings : tuple of str
    problem : str or None
        Why it is not finished.
    """

    warnings: tuple[str, ...]
    problem: str | None


def finish_part(
    rows: Rows, *, job: PartJob, folder: Path, report: Callable[[int], object] | None
) -> PartNews:
    """Measure a part and write it, whole or not at all."""
    problem = None
    with _ONE_AT_A_TIME, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FdntWarning)
        try:
            _write_part(job(rows, report=report), folder / rows.name)
        except FdntError as error:
            problem = " ".join(str(error).split())
    said = [str(w.message) for w in caught if issubclass(w.category, FdntWarning)]
    return PartNews(warnings=tuple(dict.fromkeys(said)), problem=problem)


def _do_all(
    workers: Workers,
    job: Callable[[Rows], PartNews],
    parts: Sequence[Rows],
    report: Callable[[int], object] | None,
) -> None:
    """Let all parts be finished, and say once what is warned of."""
    said: set[str] = set()
    for rows, news in workers.each(job, parts):
        if isinstance(news, Failure):
            raise FdntError(news.reason)
        for text in news.warnings:
            if text not in said:
                warnings.warn(text, FdntWarning, stacklevel=2)
        said.update(news.warnings)
        if news.problem is not None:  # what stops one part would stop the others
            raise FdntError(news.problem)
        if report is not None:
            report(rows.stop - rows.start)


def _write_part(table: Table, path: Path) -> None:
    stored: dict[str, Any] = {name: np.asarray(table[name]) for name in table.colnames}
    stored[_HEADER] = np.array("\n".join(get_yaml_from_table(table)))
    with new_file(path, overwrite=True) as temporary:
        np.savez(temporary, **stored)


def _read_part(path: Path) -> Table:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            header = get_header_from_yaml(str(stored[_HEADER]).split("\n"))
            table = Table({column["name"]: stored[column["name"]] for column in header["datatype"]})
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise CatalogError(f"{path} is not what was written: remove it") from error
    for column in header["datatype"]:
        table[column["name"]].unit = column.get("unit")
        table[column["name"]].description = column.get("description")
    table.meta.update(header.get("meta", {}))
    return table
