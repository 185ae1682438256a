"""Missing pixels, from what the PSF lets pass.

An image that a PSF has smoothed holds next to nothing at high k, so its pixels are not
independent of each other: a few that are missing follow from the rest. They are set to what
minimises the power of the image against what the PSF passes::

    sum_k |D(k)|² Λ(k),   Λ(k) = 1/(|T(k)|² + ε),

which is a linear system for the missing pixels alone. It knows the PSF and no galaxy, it
is linear in the image, and what it does to a galaxy does not depend on the galaxy's flux
or on the noise (docs, "Missing pixels").
"""

from __future__ import annotations

from typing import Final

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.fourier.grid import KGrid, half_plane_disc
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.fourier.star_transform import half_plane_transform
from fdnt_xp.fourier.transform import complex_like

_FLOOR: Final = 1e-4
"""ε: power that is taken for noise. From 1e-6 to 1e-4 the bias of the shear is the same."""


def fill_missing(stamps: Array, missing: Array, psf: Psf) -> Array:
    """Return stamps with their missing pixels filled from the others.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
        What missing pixels hold does not matter.
    missing : array, shape (n_gal, ny, nx), bool
    psf : Psf
        One for all, or one for each.

    Notes
    -----
    The system of each galaxy has as many unknowns as the galaxy with the most missing
    pixels: memory and time go with the square and the cube of that number.
    """
    xp = array_namespace(stamps=stamps)
    n_gal, ny, nx = stamps.shape
    n_most = int(xp.max(xp.count_nonzero(xp.reshape(missing, (n_gal, -1)), axis=-1)))
    if n_most == 0:
        return stamps
    known = xp.where(missing, xp.zeros_like(stamps), stamps)
    like = {"dtype": stamps.dtype, "device": device_of(stamps)}
    penalty = _penalty(psf, half_plane_disc(xp, (int(ny), int(nx)), 1.0, **like))
    flat = xp.astype(xp.reshape(missing, (n_gal, ny * nx)), xp.int32)
    # The missing pixels of each stamp first; what follows them in the shorter lists is idle.
    place = xp.argsort(-flat, axis=-1, stable=True)[:, :n_most]
    idle = xp.take_along_axis(flat, place, axis=-1) == 0
    matrix = _coupling(penalty, place, (ny, nx))
    either = idle[:, :, None] | idle[:, None, :]
    one = xp.eye(n_most, **like)[None, :, :]
    matrix = xp.where(either, one, matrix)
    pull = xp.fft.irfftn(xp.fft.rfftn(known, axes=(-2, -1)) * penalty, s=(ny, nx), axes=(-2, -1))
    pull = xp.take_along_axis(xp.reshape(pull, (n_gal, ny * nx)), place, axis=-1)
    pull = xp.where(idle, xp.zeros_like(pull), pull)
    values = -xp.linalg.solve(matrix, pull[:, :, None])[:, :, 0]
    # Back to where they belong: the rank of each pixel in the list of its stamp.
    rank = xp.cumulative_sum(flat, axis=-1) - 1
    rank = xp.minimum(xp.maximum(rank, xp.zeros_like(rank)), xp.full_like(rank, n_most - 1))
    spread = xp.take_along_axis(values, xp.astype(rank, xp.int64), axis=-1)
    return xp.where(missing, xp.reshape(spread, (n_gal, ny, nx)), stamps)


def _penalty(psf: Psf, grid: KGrid) -> Array:
    """Return Λ in the layout of `rfftn`, shape (n_psf, ny, nx//2 + 1)."""
    xp = array_namespace(image=psf.image)
    ny, nx = grid.shape
    transfer = half_plane_transform(psf.image, grid, psf.oversampling)
    power = xp.real(transfer) ** 2 + xp.imag(transfer) ** 2
    return xp.reshape(1.0 / (power + _FLOOR), (psf.n_psf, ny, nx // 2 + 1))


def _coupling(penalty: Array, place: Array, shape: tuple[int, int]) -> Array:
    """Return Λ between the pixels of each list, shape (n_gal, n_most, n_most)."""
    xp = array_namespace(place=place)
    ny, nx = shape
    n_gal, n_most = place.shape
    kernel = xp.fft.irfftn(complex_like(penalty), s=shape, axes=(-2, -1))
    row, column = place // nx, place % nx
    rows = (row[:, :, None] - row[:, None, :]) % ny
    columns = (column[:, :, None] - column[:, None, :]) % nx
    lag = xp.reshape(rows * nx + columns, (n_gal, n_most * n_most))
    kernel = xp.reshape(kernel, (-1, ny * nx))
    kernel = xp.broadcast_to(kernel, (n_gal, ny * nx))
    return xp.reshape(xp.take_along_axis(kernel, lag, axis=-1), (n_gal, n_most, n_most))
