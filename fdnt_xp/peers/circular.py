"""Circular models: a round profile, sheared, convolved with the PSF, fitted to the pixels.

The model is `sum_a c_a psi_a(S_eta^-1 (x - x0)/r) (x) T`, with all components of one centre,
shape and size r: sums of Gaussians of fixed ratios of sizes, 1 : 2.5 : 6.25 : ... (Kuijken
1999; Voigt and Bridle 2010), the exponential disc, de Vaucouleurs' law (lensfit, Miller et al.
2007). Maximum of the likelihood for independent Gaussian noise, white or known pixel by pixel.

Unbiased where the galaxy is such a model, and only there: B10 §3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.peers.batch import Weighted, measure_in_chunks, shapes_of
from fdnt_xp.peers.drawing import Drawing
from fdnt_xp.peers.image_fit import ImageFit, fit_images
from fdnt_xp.peers.profiles import GAUSSIAN_RATIO, Profile, de_vaucouleurs, exponential, gaussians
from fdnt_xp.shapes.results import ShapeResult

_COMPLEX_FIELDS: Final = 24
"""Complex arrays of the size of the k grid that an evaluation holds."""


@dataclass(frozen=True, kw_only=True)
class CircularMethod:
    """A shape method: fit one profile; called as `measure_shapes` is.

    `size` of the result, and the one that may be fixed, is the half-light radius of the
    model before the PSF, in pixels, in the frame where it is round; of Gaussians it is the
    sigma of the narrowest. `flux` is that of the whole model, and `snr` that over its error
    at fixed shape. There is no ellipticity gradient: `eg` is 0.

    Parameters
    ----------
    profile : Profile
    finer : int
        The k grid of the models is this much finer than the stamps'. The wings of a model
        that is larger than this many stamps come back on the other side.
    start : float
        Size to start from, over the sigma of the observed image.
    max_iter : int
        Steps of the fit.
    """

    profile: Profile
    start: float
    finer: int = 2
    max_iter: int = 100

    def __call__(
        self,
        stamps: Array,
        psf: Psf,
        *,
        noise_variance: float | Array | None = None,
        ivar: Array | None = None,
        size: float | None = None,
        padding: int = 1,
        chunk_size: int | None = None,
    ) -> ShapeResult:
        """Measure the galaxy on each stamp; see `measure_shapes` for the arguments."""
        shape = (int(stamps.shape[-2]), int(stamps.shape[-1])) if stamps.ndim == 3 else (1, 1)

        def measure(pixels: Weighted, psf: Psf, flags: Array) -> ShapeResult:
            xp = array_namespace(stamps=pixels.stamps)
            drawing = Drawing.through(xp, psf, shape, self.finer * padding, pixels.stamps.dtype)
            problem = ImageFit.of(
                drawing, self.profile, pixels.stamps, weights=pixels.weights, size=size
            )
            fit = fit_images(problem, self.start, self.max_iter)
            return shapes_of(fit, pixels.noise, flags, stamp_shape=shape, fixed=size is not None)

        return measure_in_chunks(
            measure,
            stamps,
            psf,
            noise_variance=noise_variance,
            ivar=ivar,
            size=size,
            padding=padding,
            chunk_size=chunk_size,
            numbers_a_galaxy=_COMPLEX_FIELDS * (self.finer * padding) ** 2 * shape[0] * shape[1],
        )


def _gaussian_method(n: int) -> CircularMethod:
    return CircularMethod(profile=gaussians(n), start=0.7 / math.sqrt(GAUSSIAN_RATIO ** (n - 1)))


CIRCULAR_METHODS: Final = {
    **{f"gauss-{n}": _gaussian_method(n) for n in (1, 2, 3, 4)},
    "exponential": CircularMethod(profile=exponential(), start=0.8),
    "devaucouleurs": CircularMethod(profile=de_vaucouleurs(), start=0.8, finer=4),
}
"""By the names they are registered by."""
