"""The shape and size of the PSF, by the same null tests as those of the galaxies.

The star is measured as a galaxy before a PSF that is a point: eta is the shear after which it
looks round under a weight of its own size. The pixel response is part of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.arrays import Array, array_namespace, device_of, to_numpy
from fdnt_xp.errors import FdntTypeError, ShapeMismatchError
from fdnt_xp.fourier.jacobian import unit_jacobian
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shapes.sky import sky_frame


@dataclass(frozen=True, kw_only=True)
class PsfShapes:
    """Shapes of the PSFs of galaxies, or of the one PSF of all.

    Parameters
    ----------
    eta : array, shape (n_gal or 1, 2)
        Conformal shear; on the sky where a Jacobian was given. NaN where there is none.
    size : array, shape (n_gal or 1,)
        sigma of the Gaussian factor of the weight that is matched to the star, in pixels of
        the galaxies, or in the unit of the sky.
    """

    eta: Array
    size: Array

    def columns(self, n_gal: int) -> dict[str, NDArray[Any]]:
        """Return the columns of a table of `n_gal` galaxies.

        Raises
        ------
        ShapeMismatchError
            If these are of another number.
        """
        if int(self.size.shape[0]) not in (1, n_gal):
            raise ShapeMismatchError(
                f"psf_shapes are of {int(self.size.shape[0])} galaxies, but there are {n_gal}"
            )
        eta = np.broadcast_to(to_numpy(self.eta), (n_gal, 2))
        size = np.broadcast_to(to_numpy(self.size), (n_gal,))
        return {"psf_eta1": eta[:, 0], "psf_eta2": eta[:, 1], "psf_size": size}


def measure_psf_shapes(psf: Psf, *, jacobian: Array | None = None) -> PsfShapes:
    """Measure the shape of each galaxy's PSF; each different star once.

    Parameters
    ----------
    psf : Psf
    jacobian : array, shape (2, 2) or (n_gal, 2, 2), optional
        As in `measure_shapes`.

    Returns
    -------
    PsfShapes
        One row for each galaxy, or one for all; NaN for an unusable PSF or Jacobian.

    Raises
    ------
    FdntTypeError, NamespaceError, ShapeMismatchError, FdntValueError
        As `measure_shapes` does.
    """
    if not isinstance(psf, Psf):
        raise FdntTypeError(f"psf must be a Psf, not {type(psf).__name__}")
    image = psf.image
    xp = array_namespace(image=image)
    ny, nx = (int(n) for n in image.shape[1:])
    stars, usable, index = image, psf.usable, psf.index
    unit = xp.eye(2, dtype=image.dtype, device=device_of(image))[None, :, :]
    scale, regular = xp.ones_like(psf.kmax[:1]), xp.ones_like(psf.kmax[:1]) > 0
    if jacobian is not None:
        n_gal = psf.n_gal
        if n_gal is None:
            n_gal = int(jacobian.shape[0]) if getattr(jacobian, "ndim", 0) == 3 else 1
        sky = sky_frame(xp, image, n_gal, jacobian)
        unit, scale, regular = unit_jacobian(sky.jacobian), sky.scale, sky.regular
        if int(unit.shape[0]) > 1:
            rows, index = psf.pairs(unit)
            unit = xp.take(unit, rows, axis=0)
            numbers = xp.zeros_like(rows) if psf.n_gal is None else psf.numbers_of(rows)
            stars, usable = xp.take(image, numbers, axis=0), xp.take(usable, numbers, axis=0)
    n_star = int(stars.shape[0])
    pixel = xp.arange(ny * nx, dtype=xp.int64, device=device_of(image))
    point = xp.astype(pixel == (ny // 2) * nx + nx // 2, image.dtype)
    shapes = measure_shapes(
        stars,
        Psf.from_image(xp.reshape(point, (ny, nx))),
        jacobian=xp.broadcast_to(unit, (n_star, 2, 2)) / psf.oversampling,
    )
    nan = xp.full_like(shapes.size, float("nan"))
    eta = xp.where(usable[:, None], shapes.eta, nan[:, None])
    size = xp.where(usable, shapes.size, nan)
    if index is not None:
        eta, size = xp.take(eta, index, axis=0), xp.take(size, index, axis=0)
    size = size * scale
    eta = xp.broadcast_to(eta, (int(size.shape[0]), 2))
    nan = xp.full_like(size, float("nan"))
    return PsfShapes(
        eta=xp.where(regular[:, None], eta, nan[:, None]), size=xp.where(regular, size, nan)
    )
