"""Measurement flags: one integer per galaxy, each bit a named reason.

Bits 0 to 13 keep the positions of the original FDNT code's flags, so that catalogs of
both can be compared; those that this library never sets are not defined here. Bits from
14 up are ours. A galaxy is measured when none of the bits in `FAILED` is set; the other
bits tell how it was measured.
"""

from __future__ import annotations

from enum import IntFlag
from typing import Final


class Flag(IntFlag):
    """Why a galaxy was not measured, or what to know about its measurement."""

    EDGE = 1 << 0
    """The stamp around the position is cut by the edge of the image."""
    CENTROID_OFF_STAMP = 1 << 3
    """The centroid left the stamp: there is no such galaxy here."""
    SIZE_AT_BOUND = 1 << 4
    """The size equation asked for a weight outside the bounds; it was held there."""
    SIZE_FIXED = 1 << 5
    """The size of the weight was given by the caller, not solved for."""
    RADIUS_TOO_SMALL = 1 << 7
    """The trust region shrank to nothing: no root near the start."""
    DID_NOT_CONVERGE = 1 << 8
    """The iteration limit was reached before the null tests vanished."""
    SINGULAR = 1 << 9
    """The null tests do not respond to the parameters at the solution."""
    TOO_ELLIPTICAL = 1 << 12
    """The root lies where the weight covers too little of k-space to trust it."""
    GL_FAILURE = 1 << 13
    """The pixels that are there do not carry a Gauss-Laguerre fit, or no basis matches."""
    NO_ATTEMPT = 1 << 14
    """The galaxy was never measured (set until something clears it)."""
    NON_FINITE_PIXEL = 1 << 15
    """A pixel of the stamp or its `ivar` is NaN or infinite, or the latter negative."""
    NO_SIGNAL = 1 << 16
    """The stamp is constant, or its flux under the weight is not positive."""
    BAD_PSF = 1 << 17
    """The galaxy's own PSF is not finite, has no positive sum, or is too wide."""
    NON_FINITE_RESULT = 1 << 18
    """The null tests became NaN or infinite during the solution."""
    FINE_GRID = 1 << 19
    """Measured on the zero-padded k grid, because the galaxy is very elongated."""
    OFF_IMAGE = 1 << 20
    """The position that was given is not on the image, or not a number."""
    LOST_IN_FRAME = 1 << 21
    """No centroid was found in one of the counter-sheared frames, where the galaxy counts 0."""
    MASKED = 1 << 22
    """Pixels are missing: more than the method can do without, or all of them."""
    FILLED = 1 << 23
    """Missing pixels were filled from the others."""
    BAD_JACOBIAN = 1 << 24
    """The galaxy's own Jacobian is not finite, or singular."""
    NO_EXPOSURE = 1 << 25
    """Of many exposures there is none, or none that can be used."""
    BAD_NOISE = 1 << 26
    """The exposure's own noise variance is not finite and positive: it has no weight."""


INFORMATION: Final = (
    Flag.SIZE_AT_BOUND | Flag.SIZE_FIXED | Flag.FINE_GRID | Flag.LOST_IN_FRAME | Flag.FILLED
)
"""Bits that tell how a shape was measured; it may be used all the same."""

FAILED: Final = ~INFORMATION & Flag(sum(int(flag) for flag in Flag))
"""Bits with which eta is NaN."""


def flag_names(value: int) -> list[str]:
    """Return the names of the bits that are set in one flag value, lowest bit first.

    Examples
    --------
    >>> from fdnt_xp.flags import flag_names
    >>> flag_names((1 << 4) | (1 << 19))
    ['SIZE_AT_BOUND', 'FINE_GRID']
    """
    return [flag.name or str(int(flag)) for flag in Flag if int(value) & int(flag)]


def flag_text(name: str) -> str:
    """Return the sentence that explains a flag, for tables and closing summaries."""
    return _TEXT[name]


_TEXT: Final[dict[str, str]] = {
    "EDGE": "stamp cut by the edge of the image",
    "CENTROID_OFF_STAMP": "centroid outside the stamp",
    "SIZE_AT_BOUND": "weight size held at its bound",
    "SIZE_FIXED": "weight size given by the caller",
    "RADIUS_TOO_SMALL": "trust region shrank to nothing",
    "DID_NOT_CONVERGE": "iteration limit reached",
    "SINGULAR": "null tests do not respond at the solution",
    "TOO_ELLIPTICAL": "weight covers too little of k-space",
    "GL_FAILURE": "no Gauss-Laguerre fit to the pixels",
    "NO_ATTEMPT": "never measured",
    "NON_FINITE_PIXEL": "NaN or infinite pixel",
    "NO_SIGNAL": "no positive flux",
    "BAD_PSF": "unusable PSF",
    "NON_FINITE_RESULT": "null tests not finite",
    "FINE_GRID": "measured on the zero-padded k grid",
    "OFF_IMAGE": "position not on the image",
    "LOST_IN_FRAME": "no centroid in a counter-sheared frame",
    "MASKED": "pixels missing",
    "FILLED": "missing pixels filled from the others",
    "BAD_JACOBIAN": "Jacobian singular or not finite",
    "NO_EXPOSURE": "no usable exposure",
    "BAD_NOISE": "noise variance not finite and positive",
}
