"""Stars of a model of the PSF, one for each galaxy, drawn when they are read."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.psf_models import draw_stars

MODELS: Final = ("image", "psfex", "piff")
"""What a PSF may come as: a picture of it, or a model."""


class ModelStars:
    """A cube of stars that is not in memory; indexed like one, by galaxy.

    Parameters
    ----------
    model : piff.PSF or galsim.des.DES_PSFEx
    positions : array, shape (n_gal, 2)
        (x, y) on the exposure, as `draw_stars` takes them.
    size : int
        Side of the images, in their pixels.
    oversampling : float
        Their pixels per pixel of the galaxies.

    Raises
    ------
    FdntTypeError, FdntValueError, RangeError
        As `draw_stars`.
    """

    ndim = 3
    dtype = np.dtype(np.float64)

    def __init__(
        self, model: Any, positions: NDArray[np.float64], *, size: int, oversampling: float
    ) -> None:
        self._model, self._positions = model, positions
        self._size, self._oversampling = size, oversampling
        self.shape = (len(positions), size, size)
        self._draw(positions[:0])  # so that what is wrong is said at once

    def __len__(self) -> int:
        return len(self._positions)

    def __getitem__(self, rows: int | slice) -> NDArray[np.float64]:
        """Draw the star of one galaxy, or those of a range."""
        if isinstance(rows, slice):
            return self._draw(self._positions[rows])
        star: NDArray[np.float64] = self._draw(self._positions[rows : rows + 1])[0]
        return star

    def _draw(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        stars = draw_stars(self._model, positions, size=self._size, oversampling=self._oversampling)
        return stars.images[stars.psf_index]
