"""From pixels to the deconvolved transform on the k grid."""

from __future__ import annotations

from dataclasses import dataclass

from fdnt_xp.arrays import Array, Rows, array_namespace, blocks_in_cache, device_of, rows_of
from fdnt_xp.fourier.grid import KGrid


@dataclass(frozen=True, kw_only=True)
class DeconvolvedStamps:
    """The galaxies before the PSF, mode by mode: `I~(k) = FFT(stamp)/T(k)`.

    Real and imaginary parts are kept as separate real arrays, which every backend
    multiplies fastest. The origin of x is the geometric centre of the stamp.

    Parameters
    ----------
    re, im : array, shape (n_gal, n_k)
        `I~` inside the disc.
    """

    re: Array
    im: Array

    def take(self, rows: Rows) -> DeconvolvedStamps:
        """Return the galaxies with the given row numbers."""
        return DeconvolvedStamps(re=rows_of(self.re, rows), im=rows_of(self.im, rows))

    def inner(self, n_k: int) -> DeconvolvedStamps:
        """Return the first modes, those of `KGrid.inner`."""
        return DeconvolvedStamps(re=self.re[:, :n_k], im=self.im[:, :n_k])

    def shifted(self, grid: KGrid, centroid: Array) -> tuple[Array, Array]:
        """Return `Re` and `Im` of `exp(+i k.x0) I~(k)`: the galaxies moved to the origin.

        Parameters
        ----------
        centroid : array, shape (n_gal, 2)
            x0 in pixels from the origin, in the frame of the grid.
        """
        xp = array_namespace(re=self.re)
        phase = mode_phase(grid, grid.on_stamp(centroid))
        cos, sin = xp.real(phase), xp.imag(phase)
        re, im = cos * self.re, sin * self.re
        re -= sin * self.im
        im += cos * self.im
        return re, im


def deconvolve(stamps: Array, inverse_transfer: Array, grid: KGrid) -> DeconvolvedStamps:
    """Transform stamps and divide by the transfer function of the PSF.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx), real floating
        Finite pixels.
    inverse_transfer : array, shape (n_gal or 1, n_k), complex
        `1/T(k)` about the flux centroid of the PSF, from `Psf.inverse_transfer`.
    grid : KGrid
        Its `shape` is that of the stamps, or larger: then they are padded with zeros.
    """
    xp = array_namespace(stamps=stamps)
    n_gal, ny, nx = (int(length) for length in stamps.shape)
    if n_gal == 0:  # which PyTorch does not transform
        none = xp.zeros((0, grid.n_k), dtype=stamps.dtype, device=device_of(stamps))
        return DeconvolvedStamps(re=none, im=none)
    # Pixel (0, 0) is at -middle from the centre of the stamp, which is where x = 0.
    middle = xp.asarray(
        [[-0.5 * (nx - 1), -0.5 * (ny - 1)]], dtype=stamps.dtype, device=device_of(stamps)
    )
    factor = inverse_transfer / mode_phase(grid, middle)
    re, im = [], []
    for rows in blocks_in_cache(xp.reshape(stamps, (n_gal, ny * nx))):
        spectrum = xp.fft.rfftn(stamps[rows, ...], s=grid.shape, axes=(-2, -1))
        spectrum = xp.reshape(spectrum, (rows.stop - rows.start, grid.n_half_plane))
        spectrum = xp.take(spectrum, grid.index, axis=1)
        spectrum = spectrum * (factor if int(factor.shape[0]) == 1 else factor[rows, :])
        re.append(xp.real(spectrum))
        im.append(xp.imag(spectrum))
    return DeconvolvedStamps(re=xp.concat(re), im=xp.concat(im))


def half_plane_axes(grid: KGrid) -> tuple[Array, Array]:
    """Return kx (nx//2 + 1,) and ky (ny,) of the `rfftn` of the grid, in rad/pixel."""
    xp = array_namespace(kx=grid.kx)
    device = device_of(grid.kx)
    ny, nx = grid.shape
    kx = xp.fft.rfftfreq(nx, dtype=grid.kx.dtype, device=device)
    ky = xp.fft.fftfreq(ny, dtype=grid.kx.dtype, device=device)
    return 2.0 * xp.pi * kx, 2.0 * xp.pi * ky


def mode_phase(grid: KGrid, position: Array) -> Array:
    """Return `exp(+i k.x)` on the modes of the data, shape (n, n_k), complex.

    The exponential of a sum is a product of two that are made along one axis each, which
    saves most of the exponentials. Uses the modes named by `grid.index`, not `grid.kx`: a
    counter-sheared grid has other coordinates for the same data.

    Parameters
    ----------
    position : array, shape (n, 2)
        x in pixels.
    """
    xp = array_namespace(position=position)
    kx, ky = half_plane_axes(grid)
    along_x = xp.exp(complex_like(position[:, 0:1] * kx) * 1j)
    along_y = xp.exp(complex_like(position[:, 1:2] * ky) * 1j)
    row, column = grid.row_and_column
    phase = xp.take(along_y, row, axis=1)
    phase *= xp.take(along_x, column, axis=1)
    return phase


def complex_like(array: Array) -> Array:
    """Return a real array as complex of the same precision."""
    xp = array_namespace(array=array)
    return xp.astype(array, xp.complex64 if array.dtype == xp.float32 else xp.complex128)
