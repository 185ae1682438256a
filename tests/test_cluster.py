"""Measured by a Dask cluster: the same results, whatever becomes of a worker."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from click.testing import CliRunner

from challenges import CELL, run, same_result, set_stamps, write_challenge
from fdnt_xp.app import parts
from fdnt_xp.app.cli import main
from fdnt_xp.app.great08_measure import MeasureOptions
from fdnt_xp.app.great08_run import measure_challenge
from fdnt_xp.app.workers import Failure, open_workers
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.images import write_image
from fdnt_xp.errors import FdntValueError, MissingExtraError
from images import star

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")
cloudpickle = pytest.importorskip("cloudpickle")
# The workers do not have the folder of the tests: what they are to run travels by value.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A directory of three sets, and a run over it in this process."""
    folder = tmp_path_factory.mktemp("great08")
    write_challenge(folder / "DIR", range(1, 4))
    measure_challenge(folder / "DIR", folder / "HERE", MeasureOptions(), cell=CELL)
    return folder


@pytest.fixture(scope="module")
def cluster():
    """Two workers, each a process with one thread; a task may kill one, not two."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
        ) as cluster,
    ):
        yield cluster


@pytest.fixture
def folder(made, tmp_path, monkeypatch):
    """A working directory with a copy of the challenge, `DIR`."""
    shutil.copytree(made / "DIR", tmp_path / "DIR")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def measure(scheduler: str, code: int = 0) -> str:
    return run("measure", "DIR", "-o", "OUT", "--cell", CELL, "--scheduler", scheduler, code=code)


def fdnt_xp(*arguments: object) -> None:
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output


def same_columns(one: Table, other: Table) -> None:
    assert one.colnames == other.colnames
    for name in one.colnames:
        np.testing.assert_array_equal(one[name], other[name])


def test_a_cluster_gives_the_same(cluster, folder, made):
    assert "3 measured, 0 failed" in measure(cluster.scheduler_address)
    same_result(Path("OUT"), made / "HERE")
    assert "0 measured, 3 before" in measure(cluster.scheduler_address)


@pytest.fixture
def cube(tmp_path, monkeypatch):
    """A working directory with `cube.fits` and `psf.fits`."""
    monkeypatch.chdir(tmp_path)
    write_image(set_stamps(1).reshape(-1, CELL, CELL), Path("cube.fits"))
    write_image(star((CELL, CELL)), Path("psf.fits"))
    return tmp_path


@pytest.mark.parametrize("kind", [(), ("--responses",)], ids=str)
def test_a_catalog_by_a_cluster_is_the_same(kind, cluster, cube):
    command = ("cube.fits", "--psf", "psf.fits", "--chunk", 4, "--quiet", *kind)
    fdnt_xp("measure", *command, "-o", "here.fits")
    # More parts than workers: files are found from wherever a worker is.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "PART", 8)
        fdnt_xp("measure", *command, "-o", "there.fits", "--scheduler", cluster.scheduler_address)
    same_columns(read_catalog("here.fits"), read_catalog("there.fits"))
    assert not Path("there.fits.parts").exists()


def test_objects_of_a_meds_file_by_a_cluster(cluster, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    meds_files = pytest.importorskip("meds_files")  # which needs GalSim
    cutouts = meds_files.drawn_cutouts()
    meds_files.write_meds(Path("tile.fits"), meds_files.objects_of(cutouts))
    command = ("measure-exposures", "tile.fits", "--chunk", 2, "--quiet")
    fdnt_xp(*command, "-o", "here.fits")
    fdnt_xp(*command, "-o", "there.fits", "--scheduler", cluster.scheduler_address)
    same_columns(read_catalog("here.fits"), read_catalog("there.fits"))


def test_a_bad_set_is_reported_and_resumed(cluster, folder, made):
    whole = Path("DIR/set0002.fit").read_bytes()
    Path("DIR/set0002.fit").write_bytes(whole[:9000])
    output = measure(cluster.scheduler_address, code=1)
    assert "2 measured, 1 failed" in output
    assert output.count("failed     set0002: cannot read the image of a set") == 1
    Path("DIR/set0002.fit").write_bytes(whole)
    assert "1 measured, 2 before, 0 failed" in measure(cluster.scheduler_address)
    same_result(Path("OUT"), made / "HERE")


def hold_set_2(folder: str) -> None:
    """Let the first worker that measures set 2 say who it is, and wait to be killed."""
    from fdnt_xp.app import great08_run

    measure_set = great08_run.measure_set

    def held(one, options):
        if one.number == 2:
            try:
                with Path(folder, "held").open("x") as file:
                    file.write(str(os.getpid()))
                time.sleep(60)
            except FileExistsError:
                pass
        return measure_set(one, options)

    great08_run.measure_set = held


def kill_who_holds(folder: Path, killed: list[int]) -> None:
    deadline = time.monotonic() + 50
    while not ((folder / "held").exists() and (folder / "held").read_text()):
        if time.monotonic() > deadline:
            return
        time.sleep(0.02)
    killed.append(int((folder / "held").read_text()))
    os.kill(killed[0], signal.SIGKILL)


def test_a_worker_that_is_killed_costs_nothing(cluster, folder, made):
    with distributed.Client(cluster, set_as_default=False) as client:
        client.wait_for_workers(2)
        client.run(partial(hold_set_2, str(folder)))
        killed: list[int] = []
        killer = threading.Thread(target=kill_who_holds, args=(folder, killed))
        killer.start()
        output = measure(cluster.scheduler_address)
        killer.join()
    assert len(killed) == 1
    assert "3 measured, 0 failed" in output
    same_result(Path("OUT"), made / "HERE")


def die(number):
    """End the worker that has task 2, every time."""
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def test_a_task_that_kills_is_given_up(cluster):
    with open_workers(scheduler=cluster.scheduler_address) as workers:
        done = dict(workers.each(die, range(8)))
    assert isinstance(done[2], Failure)
    assert "KilledWorker" in done[2].reason
    # To Dask the tasks that wait on a worker which dies are suspects too.
    others = [result for number, result in done.items() if result == number**2]
    assert len(others) >= 4
    assert all(isinstance(done[n], Failure) or done[n] == n**2 for n in range(8))


def test_who_stops_listening_cancels_the_rest(cluster):
    with distributed.Client(cluster, set_as_default=False) as client:
        client.wait_for_workers(2)
        with open_workers(scheduler=cluster.scheduler_address) as workers:
            results = workers.each(partial(sleep_and_return, seconds=0.2), range(50))
            next(results)
            results.close()
        deadline = time.monotonic() + 10
        while client.run_on_scheduler(n_tasks):
            assert time.monotonic() < deadline, "tasks are left"
            time.sleep(0.05)


def sleep_and_return(number, seconds):
    time.sleep(seconds)
    return number


def n_tasks(dask_scheduler):
    return len(dask_scheduler.tasks)


def test_no_scheduler_is_one_error_within_seconds(folder):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        start = time.monotonic()
        output = measure(address, code=1)
    assert time.monotonic() - start < 15
    assert output.startswith(f"Error: no Dask scheduler at {address}: ")
    assert output.count("\n") == 1
    assert not (folder / "OUT").exists()


@pytest.mark.parametrize("address", ["nonsense://here", "http//", "tcp://127.0.0.1"])
def test_no_address(address):
    with (
        pytest.raises(FdntValueError, match="no Dask scheduler at"),
        open_workers(scheduler=address),
    ):
        pass


def test_dask_that_is_not_installed_names_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(MissingExtraError, match=r"pip install 'fdnt-xp\[cluster\]'"),
        open_workers(scheduler="tcp://127.0.0.1:8786"),
    ):
        pass
