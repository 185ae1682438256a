"""How many galaxies are measured at a time: fewer, once memory does not do for as many."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Final, TypeVar

from fdnt_xp.app.backends import Backend
from fdnt_xp.errors import FdntError, FdntWarning, RangeError

T = TypeVar("T")

CHUNK_ON_CPU: Final = 1024
"""Galaxies at a time, unless told otherwise: of fewer each takes longer (256: by a half)."""
CHUNK_ON_GPU: Final = 8192
"""Enough to fill a GPU; 64 x 64 pixels in float64 are 268 MB."""

_NAMES: Final = frozenset({"MemoryError", "OutOfMemoryError"})
"""Classes of Python and NumPy, torch and CuPy, known without importing any."""
_TEXTS: Final = ("out of memory", "can't allocate memory", "RESOURCE_EXHAUSTED")
"""What torch on the CPU and JAX say; their errors have no class of their own."""


class ChunkSize:
    """Galaxies at a time; it halves when there is no memory for as many, and stays so.

    Parameters
    ----------
    given : int or None
        At first; what suits the backend if None.
    backend : Backend
        Where it is computed.

    Raises
    ------
    RangeError
        If it is less than one.
    """

    def __init__(self, given: int | None, backend: Backend) -> None:
        if given is not None and given < 1:
            raise RangeError("chunk", given, 1, None)
        self.size = given or (CHUNK_ON_CPU if backend.on_cpu else CHUNK_ON_GPU)
        self._warned = False

    def each(self, start: int, stop: int, measure: Callable[[int, int], T]) -> Iterator[T]:
        """Yield what is measured of rows `start` to `stop - 1`, a chunk at a time.

        Warns (`FdntWarning`) the first time that memory does not do for a chunk.

        Raises
        ------
        FdntError
            If it does not do for a single galaxy.
        """
        while start < stop:
            end = min(start + self.size, stop)
            reason = None
            try:
                done = measure(start, end)
            except Exception as error:
                if not _is_out_of_memory(error):
                    raise
                reason = str(error).strip().partition("\n")[0] or type(error).__name__
            # Here the error is gone, and with it what its frames held.
            if reason is None:
                yield done
                start = end
            else:
                self._halve(end - start, reason)

    def _halve(self, n_gal: int, reason: str) -> None:
        if n_gal == 1:
            raise FdntError(f"there is no memory for a single galaxy: {reason}")
        if not self._warned:
            warnings.warn(
                f"there is no memory for {n_gal} galaxies at a time: going on with half as many, "
                "and half of that where need be; --chunk says how many from the start",
                FdntWarning,
                stacklevel=4,
            )
        self._warned = True
        self.size = n_gal // 2


def _is_out_of_memory(error: Exception) -> bool:
    if any(kind.__name__ in _NAMES for kind in type(error).__mro__):
        return True
    return isinstance(error, RuntimeError) and any(text in str(error) for text in _TEXTS)
