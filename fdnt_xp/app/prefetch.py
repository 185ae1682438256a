"""Read and convert what comes next while what is there is measured."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, TypeVar

_Item = TypeVar("_Item")
_Ready = TypeVar("_Ready")
_END: Final = object()


def prepared_ahead(
    items: Iterable[_Item], prepare: Callable[[_Item], _Ready], *, depth: int = 1
) -> Iterator[_Ready]:
    """Yield items in order, each prepared by one other thread before it is asked for.

    That thread alone walks through `items`, which may read files. It pays where reading and
    `prepare` leave Python, as copies, file systems and devices do. If the caller stops early or
    is interrupted, what has been begun is finished, and no more is.

    Parameters
    ----------
    items : iterable
    prepare : callable
    depth : int
        Most items that are ready, or in work, beyond the one that the caller has: it bounds
        the memory.

    Raises
    ------
    Exception
        What `items` or `prepare` raised, when it is the turn of that item.

    Examples
    --------
    >>> list(prepared_ahead([1, 2, 3], str))
    ['1', '2', '3']
    """
    source = iter(items)

    def step() -> _Ready | object:
        # StopIteration cannot pass through a future into a generator.
        item = next(source, _END)
        return _END if item is _END else prepare(item)  # type: ignore[arg-type]

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch") as pool:
        waiting: deque[Future[_Ready | object]] = deque(pool.submit(step) for _ in range(depth))
        try:
            while (ready := waiting.popleft().result()) is not _END:
                waiting.append(pool.submit(step))
                yield ready  # type: ignore[misc]
        finally:
            for future in waiting:
                future.cancel()
