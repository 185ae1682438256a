"""Shapes on the sky: the Jacobians of a batch, and what becomes of its results.

The null tests themselves are made at wave numbers of the sky (`Psf.through`); what is left to
do here is to count lengths in its units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType

from fdnt_xp.arrays import Array, array_namespace, as_floating, device_of, require_dtype
from fdnt_xp.errors import FdntValueError, ShapeMismatchError
from fdnt_xp.flags import FAILED, Flag
from fdnt_xp.fourier.jacobian import is_regular, pixel_scale
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.results import ShapeResult


@dataclass(frozen=True, kw_only=True)
class SkyFrame:
    """The Jacobian of the galaxies' pixels: one for all, or one for each.

    Parameters
    ----------
    jacobian : array, shape (1, 2, 2) or (n_gal, 2, 2)
        J of `(u, v) = J (x, y)`; the unit matrix where the one that was given is not regular.
    regular : array, shape (1,) or (n_gal,), bool
        Whether it was.
    """

    jacobian: Array
    regular: Array

    @property
    def scale(self) -> Array:
        """Side of a pixel on the sky, shape (1,) or (n_gal,)."""
        return pixel_scale(self.jacobian)

    def seen_by(self, psf: Psf) -> Psf:
        """Return the PSF with weights that are round on the sky."""
        return psf.through(self.jacobian)

    def on_sky(self, result: ShapeResult, stamp_shape: tuple[int, int]) -> ShapeResult:
        """Return a result with its lengths on the sky, and NaN where there is no such place.

        Parameters
        ----------
        result : ShapeResult
            Of tests that were made at wave numbers of the sky, all galaxies in their order.
        stamp_shape : tuple of int
            (ny, nx).
        """
        xp = array_namespace(eta=result.eta)
        ny, nx = stamp_shape
        j = self.jacobian
        x = result.centroid[:, 0] - 0.5 * (nx - 1)
        y = result.centroid[:, 1] - 0.5 * (ny - 1)
        offset = xp.stack([j[:, i, 0] * x + j[:, i, 1] * y for i in (0, 1)], axis=-1)
        result = replace(result, size=result.size * self.scale, sky_offset=offset)
        regular = xp.broadcast_to(self.regular, result.flags.shape)
        why = xp.bitwise_and(result.flags, xp.full_like(result.flags, int(FAILED)))
        why = xp.bitwise_or(why, xp.full_like(why, int(Flag.BAD_JACOBIAN)))
        kept = {}
        for name, values in result.columns().items():
            if name != "masked_fraction" and xp.isdtype(values.dtype, "real floating"):
                where = xp.reshape(regular, (-1,) + (1,) * (values.ndim - 1))
                kept[name] = xp.where(where, values, xp.full_like(values, float("nan")))
        return replace(result, **kept, flags=xp.where(regular, result.flags, why))


def sky_frame(xp: ModuleType, like: Array, n_gal: int, jacobian: Array) -> SkyFrame:
    """Check the Jacobians of galaxies, and make those harmless that no galaxy can have.

    Parameters
    ----------
    like : array
        Of the library, dtype and device that they must have.
    n_gal : int
    jacobian : array, shape (2, 2) or (n_gal, 2, 2)

    Raises
    ------
    NamespaceError
        If they are of another library, dtype or device.
    ShapeMismatchError
        If there is neither one, nor one for each galaxy.
    FdntValueError
        If a single one for all is not regular.
    """
    array_namespace(stamps=like, jacobian=jacobian)
    jacobian = as_floating(xp, jacobian, "jacobian")
    require_dtype(like.dtype, jacobian=jacobian)
    if tuple(jacobian.shape) not in ((2, 2), (n_gal, 2, 2)):
        raise ShapeMismatchError(
            f"jacobian must have the shape (2, 2), or ({n_gal}, 2, 2) for {n_gal} galaxies, "
            f"not {tuple(jacobian.shape)}"
        )
    single = jacobian.ndim == 2
    jacobian = jacobian[None, :, :] if single else jacobian
    regular = is_regular(jacobian)
    if single and not bool(xp.all(regular)):
        raise FdntValueError(
            "jacobian must be finite and not singular: d(u, v)/d(x, y) of the pixels"
        )
    unit = xp.eye(2, dtype=like.dtype, device=device_of(like))[None, :, :]
    jacobian = xp.where(regular[:, None, None], jacobian, unit)
    return SkyFrame(jacobian=jacobian, regular=regular)
