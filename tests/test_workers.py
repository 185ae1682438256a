"""Jobs that are done by processes: all results come, whatever dies."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from fdnt_xp.app.workers import Failure, open_workers
from fdnt_xp.errors import FdntValueError


def square(number):
    return number**2


def threads_of(_):
    return os.environ["OMP_NUM_THREADS"], os.environ["MKL_NUM_THREADS"]


def die_once(number, folder):
    """Kill the process that has task 2, but only the first one."""
    try:
        if number == 2:
            (folder / "died").touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGKILL)
    except FileExistsError:
        pass
    return number**2


def die(number):
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def say_pid_and_wait(number, folder):
    (folder / f"{number}.pid").write_text(str(os.getpid()))
    time.sleep(60)


@pytest.mark.parametrize("jobs", [1, 2])
def test_each_task_is_done_once(jobs):
    with open_workers(jobs) as workers:
        done = list(workers.each(square, range(5)))
    assert sorted(done) == [(n, n**2) for n in range(5)]


@pytest.mark.parametrize("jobs", [1, 2])
def test_there_may_be_nothing_to_do(jobs):
    with open_workers(jobs) as workers:
        assert list(workers.each(square, [])) == []


def test_processes_take_one_thread_unless_told_otherwise(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with open_workers(2) as workers:
        assert list(workers.each(threads_of, [0])) == [(0, ("3", "1"))]
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_process_that_dies_costs_nothing(tmp_path):
    with open_workers(2) as workers:
        done = list(workers.each(partial(die_once, folder=tmp_path), range(5)))
    assert (tmp_path / "died").exists()
    assert sorted(done) == [(n, n**2) for n in range(5)]


def test_a_task_that_kills_is_given_up_and_the_others_done():
    with open_workers(2) as workers:
        done = dict(workers.each(die, range(6)))
    assert isinstance(done[2], Failure)
    assert "died" in done[2].reason
    # At most the one that was beside it both times goes with it.
    assert sum(isinstance(result, Failure) for result in done.values()) <= 2
    assert all(result in (n**2, done[2]) for n, result in done.items())


def test_an_interrupt_ends_the_processes(tmp_path):
    before = set(multiprocessing.active_children())
    beginning = threading.Thread(target=interrupt_once_there_is, args=(tmp_path / "0.pid",))
    beginning.start()
    with open_workers(2) as workers, pytest.raises(KeyboardInterrupt):
        list(workers.each(partial(say_pid_and_wait, folder=tmp_path), range(3)))
    beginning.join()
    assert set(multiprocessing.active_children()) == before


def interrupt_once_there_is(path):
    wait_for(path)
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_the_one_that_began_them(number, tmp_path):
    program = (
        "import sys; from functools import partial; from pathlib import Path\n"
        "from fdnt_xp.app.workers import open_workers; from test_workers import say_pid_and_wait\n"
        "if __name__ == '__main__':\n"
        "    with open_workers(2) as workers:\n"
        "        list(workers.each(partial(say_pid_and_wait, folder=Path(sys.argv[1])), [1, 2]))\n"
    )
    script = tmp_path / "program.py"
    script.write_text(program)
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    parent = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)],
        env={**os.environ, "PYTHONPATH": path},
        stderr=subprocess.DEVNULL,
    )
    pids = [int(wait_for(tmp_path / f"{n}.pid")) for n in (1, 2)]
    parent.send_signal(number)
    assert parent.wait(timeout=20) != 0
    deadline = time.monotonic() + 20
    while any(map(is_running, pids)):
        assert time.monotonic() < deadline, "a process goes on without its parent"
        time.sleep(0.05)


def wait_for(path: Path) -> str:
    """Return the content of a file once it has some."""
    deadline = time.monotonic() + 30
    while not (path.exists() and path.read_text()):
        assert time.monotonic() < deadline, f"{path.name} never came"
        time.sleep(0.05)
    return path.read_text()


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # One that has ended but that nobody has asked about is no longer running.
    status = Path(f"/proc/{pid}/stat")
    return not (status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z")


def test_processes_and_a_cluster_are_refused_together():
    with (
        pytest.raises(FdntValueError, match="--jobs or --scheduler, not both"),
        open_workers(2, "tcp://nowhere:8786"),
    ):
        pass
