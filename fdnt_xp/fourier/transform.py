"""From pixels to the deconvolved transform on the k grid."""

from __future__ import annotations

from dataclasses import dataclass

from fdnt_xp.arrays import Array, array_namespace, device_of
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

    def take(self, rows: Array) -> DeconvolvedStamps:
        """Return the galaxies with the given row numbers."""
        xp = array_namespace(re=self.re)
        return DeconvolvedStamps(
            re=xp.take(self.re, rows, axis=0), im=xp.take(self.im, rows, axis=0)
        )

    def shifted(self, grid: KGrid, centroid: Array) -> tuple[Array, Array]:
        """Return `Re` and `Im` of `exp(+i k.x0) I~(k)`: the galaxies moved to the origin.

        Parameters
        ----------
        centroid : array, shape (n_gal, 2)
            x0 in pixels from the origin.
        """
        xp = array_namespace(re=self.re)
        angle = centroid[:, 0:1] * grid.kx[None, :] + centroid[:, 1:2] * grid.ky[None, :]
        cos, sin = xp.cos(angle), xp.sin(angle)
        return cos * self.re - sin * self.im, sin * self.re + cos * self.im


def deconvolve(stamps: Array, inverse_transfer: Array, grid: KGrid) -> DeconvolvedStamps:
    """Transform stamps and divide by the transfer function of the PSF.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx), real floating
        Finite pixels.
    inverse_transfer : array, shape (n_gal or 1, n_k), complex
        `1/T(k)` about the centre of the PSF image, from `Psf.inverse_transfer`.
    grid : KGrid
        Its `shape` is that of the stamps, or larger: then they are padded with zeros.
    """
    xp = array_namespace(stamps=stamps)
    n_gal, ny, nx = stamps.shape
    spectrum = xp.fft.rfftn(stamps, s=grid.shape, axes=(-2, -1))
    spectrum = xp.reshape(spectrum, (n_gal, grid.shape[0] * (grid.shape[1] // 2 + 1)))
    spectrum = xp.take(spectrum, grid.index, axis=1)
    # exp(+i k.c) moves the origin from pixel (0, 0) to the centre of the stamp.
    centre = mode_phase(grid, 0.5 * (nx - 1), 0.5 * (ny - 1))
    spectrum = spectrum * (inverse_transfer * centre[None, :])
    return DeconvolvedStamps(re=xp.real(spectrum), im=xp.imag(spectrum))


def mode_phase(grid: KGrid, x: float, y: float) -> Array:
    """Return `exp(+i k.x)` on the modes of the data, shape (n_k,), complex.

    Uses the modes named by `grid.index`, not `grid.kx`: a counter-sheared grid has other
    coordinates for the same data.
    """
    xp = array_namespace(kx=grid.kx)
    device = device_of(grid.kx)
    ny, nx = grid.shape
    ky = xp.fft.fftfreq(ny, dtype=grid.kx.dtype, device=device)
    kx = xp.fft.rfftfreq(nx, dtype=grid.kx.dtype, device=device)
    turns = x * kx[None, :] + y * ky[:, None]
    # Whole turns are taken off first: cos(2 pi t) of a large t costs float32 its digits.
    angle = 2.0 * xp.pi * xp.take(xp.reshape(turns - xp.round(turns), (-1,)), grid.index, axis=0)
    complex_dtype = xp.complex64 if angle.dtype == xp.float32 else xp.complex128
    return xp.exp(1j * xp.astype(angle, complex_dtype))
