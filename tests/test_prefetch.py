"""Items prepared by another thread: in order, a bounded number ahead, with their errors."""

from __future__ import annotations

import threading
import time

import pytest

from fdnt_xp.app.prefetch import prepared_ahead

PATIENCE = 10.0


class Watched:
    """Numbers from 0, and which of them were asked for so far."""

    def __init__(self, n, fails_at=None):
        self.n, self.fails_at, self.asked, self.threads = n, fails_at, [], set()

    def __iter__(self):
        for number in range(self.n):
            self.asked.append(number)
            self.threads.add(threading.current_thread())
            if number == self.fails_at:
                raise OSError(f"cannot read {number}")
            yield number


def until(holds):
    """Wait until something holds, which must be soon."""
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end
        time.sleep(1e-3)


def no_thread_is_left():
    return not any(thread.name.startswith("prefetch") for thread in threading.enumerate())


@pytest.mark.parametrize("n", [0, 1, 7])
@pytest.mark.parametrize("depth", [1, 3])
def test_all_in_order(n, depth):
    assert list(prepared_ahead(range(n), lambda i: i**2, depth=depth)) == [i**2 for i in range(n)]
    assert no_thread_is_left()


@pytest.mark.parametrize("depth", [1, 2])
def test_the_next_is_read_while_one_is_used_and_no_more(depth):
    items = Watched(10)
    ahead = prepared_ahead(items, lambda i: i, depth=depth)
    assert next(ahead) == 0
    until(lambda: len(items.asked) == 1 + depth)
    time.sleep(0.02)
    assert items.asked == list(range(1 + depth))
    assert threading.current_thread() not in items.threads
    ahead.close()


def test_preparing_overlaps_with_use():
    begun = threading.Event()

    def prepare(number):
        if number == 1:
            begun.set()
        return number

    for number in prepared_ahead(range(2), prepare):
        if number == 0:  # the second is under way though nobody has asked for it
            assert begun.wait(PATIENCE)


def test_an_error_comes_when_it_is_its_turn():
    found = []
    with pytest.raises(OSError, match="cannot read 2"):
        found.extend(prepared_ahead(Watched(5, fails_at=2), lambda i: i, depth=4))
    ahead = prepared_ahead(Watched(5, fails_at=2), lambda i: i, depth=4)
    assert [next(ahead), next(ahead)] == [0, 1]
    with pytest.raises(OSError, match="cannot read 2"):
        next(ahead)
    assert no_thread_is_left()


def test_an_error_of_preparing_is_raised_too():
    with pytest.raises(ZeroDivisionError):
        list(prepared_ahead([1, 0, 2], lambda i: 1 / i))


def test_an_interrupt_ends_it():
    items = Watched(1000)

    def interrupted():
        for number in prepared_ahead(items, lambda i: i):
            if number == 3:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    until(no_thread_is_left)
    assert len(items.asked) <= 3 + 3
