"""The transform of a star on the modes of a k grid: by FFT where it fits, or by direct sums."""

from __future__ import annotations

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.fourier.circles import pixels_from_middle
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.transform import complex_like, half_plane_axes, mode_phase


def transform_on_modes(image: Array, grid: KGrid, oversampling: float) -> Array:
    """Return the transform of images, about the middle of their arrays, on a grid's modes.

    Parameters
    ----------
    image : array, shape (n_psf, ny, nx)
    oversampling : float
        Pixels of `image` per pixel of the galaxies.

    Returns
    -------
    array, shape (n_psf, n_k), complex
    """
    xp = array_namespace(image=image)
    n_psf, ny, nx = (int(n) for n in image.shape)
    fits = oversampling == 1.0 and ny <= grid.shape[0] and nx <= grid.shape[1]
    if fits and n_psf > 0:  # PyTorch does not transform none
        # The same sums, by a fast transform.
        middle = xp.asarray(
            [[0.5 * (nx - 1), 0.5 * (ny - 1)]], dtype=image.dtype, device=device_of(image)
        )
        half_plane = xp.fft.rfftn(image, s=grid.shape, axes=(-2, -1))
        half_plane = xp.reshape(half_plane, (n_psf, grid.n_half_plane))
        return xp.take(half_plane, grid.index, axis=1) * mode_phase(grid, middle)
    return xp.take(half_plane_transform(image, grid, oversampling), grid.index, axis=1)


def half_plane_transform(image: Array, grid: KGrid, oversampling: float) -> Array:
    """Return the same on all modes of the grid's `rfftn`, shape (n_psf, n_half_plane).

    `exp(-i k.x)` separates, `T = along_y @ image @ along_xᵀ`, so the direct sums are two
    matrix products.
    """
    xp = array_namespace(image=image)
    n_psf, ny, nx = image.shape
    kx, ky = half_plane_axes(grid)
    along_x, along_y = _waves(kx, nx, oversampling), _waves(ky, ny, oversampling)
    image = xp.astype(image, along_x.dtype)
    half_plane = xp.matmul(xp.matmul(along_y, image), xp.matrix_transpose(along_x))
    return xp.reshape(half_plane, (n_psf, grid.n_half_plane))


def _waves(k: Array, n: int, oversampling: float) -> Array:
    """Return `exp(-i k x)`, shape (n_k, n), x in galaxy pixels from the middle of the array."""
    xp = array_namespace(k=k)
    angle = k[:, None] * (pixels_from_middle(n, k) / oversampling)[None, :]
    return xp.exp(complex_like(angle) * -1j)
