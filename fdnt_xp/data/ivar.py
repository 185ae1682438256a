"""The inverse variance of each pixel of the stamps: of a map, of a mask, or of both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.stamps import StampChunk, StampSource
from fdnt_xp.errors import FdntValueError


@dataclass(frozen=True, kw_only=True)
class IvarSource:
    """Inverse variances, a chunk of galaxies at a time; at least one of the two maps is given.

    Parameters
    ----------
    mask : StampSource, optional
        Beside that of the stamps: a pixel is missing where this is not 0.
    weight : StampSource, optional
        Beside that of the stamps: the inverse variance of each pixel, 0 where it is missing.
    variance : float, optional
        Of the noise of every pixel, if there is no `weight`.

    Raises
    ------
    FdntValueError
        If neither says what the noise is.
    """

    mask: StampSource | None = None
    weight: StampSource | None = None
    variance: float | None = None

    def __post_init__(self) -> None:
        if self.weight is None and self.variance is None:
            raise FdntValueError(
                "a mask alone does not say how noisy the other pixels are, and no noise was "
                "found on the borders of the stamps: give --noise-variance or --weight"
            )

    def read(self, chunk: StampChunk) -> NDArray[np.floating[Any]]:
        """Return those of a chunk, shape (n, ny, nx), of the dtype of its stamps.

        Where a galaxy has no whole stamp they are 1: that is not for missing pixels.
        """
        rows = np.arange(chunk.rows.start, chunk.rows.stop)
        even = 1.0 if self.variance is None else 1.0 / self.variance
        whole = np.full(chunk.stamps.shape, even)
        ivar = whole if self.weight is None else self.weight.take(rows)
        if self.mask is not None:
            ivar[self.mask.take(rows) != 0] = 0.0
        ivar[chunk.flags != 0] = 1.0
        return ivar.astype(chunk.stamps.dtype)
