"""Models of galaxies before the PSF, drawn as the stamps show them.

A model is given by its transform `psi~(k)`; times T(k) and transformed back it is the image,
which is then compared with the pixels, pixel by pixel. The k grid is finer than that of the
stamps, so that the wings of the model leave the stamp and do not come back on the other side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType

import numpy as np

from fdnt_xp.arrays import Array, DType, array_namespace, device_of
from fdnt_xp.fourier.grid import half_plane_disc
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.fourier.star_transform import half_plane_transform
from fdnt_xp.fourier.transform import complex_like, half_plane_axes


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """The modes on which models are evaluated, and the PSF there.

    Parameters
    ----------
    axis_x, axis_y : array, shapes (n_kx,) and (n_ky,)
        Modes along each axis of the `rfftn` of the padded stamp, rad/pixel.
    kx, ky : array, shape (n_k,)
        All of them, flattened.
    transfer : array, shape (n_psf, n_k), complex
        `T(k)` about the PSF's flux centroid, moved from the centre of the stamp to its first
        pixel; 0 on the Nyquist modes.
    stamp_shape, padded_shape : tuple of int
        (ny, nx) of the stamps and of the transform.
    """

    axis_x: Array
    axis_y: Array
    kx: Array
    ky: Array
    transfer: Array
    stamp_shape: tuple[int, int]
    padded_shape: tuple[int, int]

    @classmethod
    def through(
        cls, xp: ModuleType, psf: Psf, stamp_shape: tuple[int, int], padding: int, dtype: DType
    ) -> Drawing:
        """Return the drawing through a PSF, on a k grid `padding` times finer than the stamp's."""
        padded = (padding * stamp_shape[0], padding * stamp_shape[1])
        grid = half_plane_disc(xp, padded, float(np.pi), dtype=dtype, device=device_of(psf.image))
        axis_x, axis_y = half_plane_axes(grid)
        both = (int(axis_y.shape[0]), int(axis_x.shape[0]))
        kx = xp.reshape(xp.broadcast_to(axis_x[None, :], both), (-1,))
        ky = xp.reshape(xp.broadcast_to(axis_y[:, None], both), (-1,))
        drawing = cls(
            axis_x=axis_x,
            axis_y=axis_y,
            kx=kx,
            ky=ky,
            transfer=half_plane_transform(psf.image, grid, psf.oversampling),
            stamp_shape=stamp_shape,
            padded_shape=padded,
        )
        # The PSF comes to its centroid, and x = 0 from pixel (0, 0) to the stamp's centre.
        bare = drawing.without_psf()
        moved = bare.transfer * drawing.phase(-xp.astype(psf.centre, dtype))
        return replace(drawing, transfer=drawing.transfer * moved)

    def without_psf(self) -> Drawing:
        """Return the drawing of images that are seen as they are."""
        xp = array_namespace(kx=self.kx)
        ny, nx = self.stamp_shape
        like = {"dtype": self.kx.dtype, "device": device_of(self.kx)}
        moved = self.phase(xp.asarray([[0.5 * (nx - 1), 0.5 * (ny - 1)]], **like))
        below = (1.0 - 1e-6) * float(np.pi)  # Nyquist's mode is its own conjugate: no phase there
        inside = (xp.abs(self.kx) < below) & (xp.abs(self.ky) < below)
        return replace(self, transfer=xp.where(inside, moved, xp.zeros_like(moved)))

    def take(self, rows: Array) -> Drawing:
        """Return the drawing of the given galaxies (integer array)."""
        if int(self.transfer.shape[0]) == 1:
            return self
        xp = array_namespace(kx=self.kx, rows=rows)
        return replace(self, transfer=xp.take(self.transfer, rows, axis=0))

    def phase(self, position: Array) -> Array:
        """Return `exp(-i k.x)`, shape (n, n_k), complex; position in pixels, shape (n, 2)."""
        xp = array_namespace(position=position)
        along_x = xp.exp(complex_like(position[:, 0:1] * self.axis_x) * -1j)
        along_y = xp.exp(complex_like(position[:, 1:2] * self.axis_y) * -1j)
        product = along_y[:, :, None] * along_x[:, None, :]
        return xp.reshape(product, (int(position.shape[0]), -1))

    @cached_property
    def quadratics(self) -> tuple[Array, Array, Array]:
        """`kx² + ky²`, `kx² - ky²` and `2 kx ky`, each of shape (n_k,)."""
        return self.kx**2 + self.ky**2, self.kx**2 - self.ky**2, 2.0 * self.kx * self.ky

    def transform(self, images: Array) -> Array:
        """Return what sums products of images with models over the pixels.

        `sum_x I(x) M(x)` is the sum over k of the real part of this times the `psi~ transfer`
        that M was drawn from.

        Parameters
        ----------
        images : array, shape (n_gal, ny nx)

        Returns
        -------
        array, shape (n_gal, n_k), complex
        """
        xp = array_namespace(images=images)
        n_gal, padded = int(images.shape[0]), self.padded_shape
        stamps = xp.reshape(images, (n_gal, *self.stamp_shape))
        modes = xp.reshape(xp.fft.rfftn(stamps, s=padded, axes=(-2, -1)), (n_gal, -1))
        # The half plane that is not there counts with the one that is.
        one = xp.ones_like(self.kx)
        fold = xp.where(self.kx > 0, 2.0 * one, one) / float(padded[0] * padded[1])
        return fold * xp.conj(modes)

    def images(self, transforms: Array) -> Array:
        """Return images from transforms times T.

        Parameters
        ----------
        transforms : array, shape (n_gal, n_model, n_k), complex
            `psi~(k) transfer(k)`.

        Returns
        -------
        array, shape (n_gal, n_model, ny nx)
        """
        xp = array_namespace(transforms=transforms)
        n_gal, n_model, _ = (int(n) for n in transforms.shape)
        (ny, nx), padded = self.stamp_shape, self.padded_shape
        modes = (n_gal, n_model, int(self.axis_y.shape[0]), int(self.axis_x.shape[0]))
        whole = xp.fft.irfftn(xp.reshape(transforms, modes), s=padded, axes=(-2, -1))
        return xp.reshape(whole[:, :, :ny, :nx], (n_gal, n_model, ny * nx))
