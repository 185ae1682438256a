"""Samples whose shear is that on the sky: Jacobians checked, and one unit of length for all."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Final

from fdnt_xp.arrays import Array, array_namespace, count_true
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.sky import SkyFrame, sky_frame

_MOST_UNLIKE: Final = 1000.0
"""Side of a pixel over that of the typical one, or the inverse, beyond which it is a mistake."""


@dataclass(frozen=True, kw_only=True)
class SampleSky:
    """How a sample is seen on the sky.

    Parameters
    ----------
    psf : Psf
        With weights that are round there; wave numbers in rad over `unit_length`.
    unit_length : float
        Side of the largest pixel, in the unit of the sky.
    regular : array, shape (1,) or (n_gal,), bool
        Whose Jacobian is one; those of pixels a thousand times as large or as small as those of
        the others are not.
    """

    psf: Psf
    unit_length: float
    regular: Array

    @classmethod
    def of(cls, xp: ModuleType, stamps: Array, psf: Psf, jacobian: Array) -> SampleSky:
        """Check the Jacobians of galaxies; see `fdnt_xp.shapes.sky.sky_frame` for what it raises.

        One length for all keeps the weight the same on the sky, whatever size pixels have.
        """
        frame = sky_frame(xp, stamps, int(stamps.shape[0]), jacobian)
        regular = _of_like_size(frame)
        scale = xp.where(regular, frame.scale, xp.zeros_like(frame.scale))
        largest = float(xp.max(scale)) if int(scale.shape[0]) else 0.0
        length = largest if largest > 0.0 else 1.0
        # Whoever has none is given that of another, which makes no tables of its own.
        first = xp.argmax(xp.astype(regular, xp.int32))[None] if largest > 0.0 else None
        other = frame.jacobian if first is None else xp.take(frame.jacobian, first, axis=0)
        matrices = xp.where(regular[:, None, None], frame.jacobian, other)
        seen = psf.through(matrices, unit_length=length)
        return cls(psf=seen, unit_length=length, regular=regular)


def _of_like_size(frame: SkyFrame) -> Array:
    """Return whose Jacobian is one, and has pixels of a size that others could have; bool."""
    xp = array_namespace(scale=frame.scale)
    scale = xp.where(frame.regular, frame.scale, xp.full_like(frame.scale, math.inf))
    n_regular = count_true(frame.regular)
    if n_regular < 2:
        return frame.regular
    typical = float(xp.sort(scale)[(n_regular - 1) // 2])
    return frame.regular & (scale < typical * _MOST_UNLIKE) & (scale > typical / _MOST_UNLIKE)
