"""Where a catalog came from: what goes into its header so that it can be made again."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Final

import numpy as np

import fdnt_xp

Value = str | int | float | bool

SCHEMA: Final = 1
"""Version of the columns: what they are called and mean, and in which units.

It grows when a column goes, or means something else; new columns alone do not change it.

1. The first that is documented.
"""

COMMENTS: Final[dict[str, str]] = {
    "CREATOR": "program that made this table",
    "FDNTVER": "its version",
    "SCHEMA": "version of the columns",
    "NUMPYVER": "version of NumPy",
    "DATE": "when it was made (UTC)",
    "METHOD": "shape method, responses, exposures",
    "BACKEND": "array library",
    "LIBVER": "its version",
    "DEVICE": "where the arrays were",
    "DTYPE": "precision of the computation",
    "IMAGE": "image that was measured",
    "PSFIMAGE": "image of the PSF, or model of it",
    "PSFMODEL": "kind of model: psfex, piff",
    "POSCAT": "table of positions",
    "LAYOUT": "how stamps were found: grid, cube, meds, ...",
    "CELL": "[pix] side of a grid cell",
    "STAMPSIZ": "[pix] side of a stamp",
    "XCOLUMN": "column of x in the table of positions",
    "YCOLUMN": "column of y in the table of positions",
    "ORIGIN": "first pixel's coordinate in that table",
    "CUTOUTS": "which cutouts were taken: all, epochs, first",
    "BADBITS": "bits of the mask that make a pixel missing",
    "SEGMENTS": "pixels of other objects: mask, ignore",
    "OVERSAMP": "PSF pixels per image pixel",
    "NOISEVAR": "noise variance per pixel that was used",
    "NOISEERR": "its relative standard error",
    "NOISESRC": "where that number came from",
    "NOISEIMG": "image of blank sky it was measured on",
    "IVARIMG": "map of the inverse variance of each pixel",
    "MASKIMG": "image of missing pixels",
    "NOISECOR": "whether noise was taken for correlated",
    "JACOBIAN": "of the pixels",
    "BORDLVL": "median of the stamps' border pixels",
    "WTSIZE": "[pix] weight size, if it was fixed",
    "CHUNK": "galaxies measured at a time",
    "SEED": "seed of the simulation, of synthetic noise",
    "RSTEP": "reduced shear of the frames of responses",
    "SHEAR1": "applied shear g1",
    "SHEAR2": "applied shear g2",
    "SNR": "signal to noise of every galaxy",
}
"""Keywords of `table.meta`, and thus of the FITS header, with what each means."""


def provenance(**facts: Value | None) -> dict[str, Value]:
    """Return the `meta` of a table: versions, date, and the facts given.

    Parameters
    ----------
    **facts
        By keyword of `COMMENTS`, in lower case. None and NaN mean that there is nothing to
        say; characters that FITS cannot hold are written as escapes.
    """
    meta: dict[str, Value] = {
        "CREATOR": "fdnt_xp",
        "FDNTVER": fdnt_xp.__version__,
        "SCHEMA": SCHEMA,
        "NUMPYVER": np.__version__,
        "DATE": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"),
    }
    for name, value in facts.items():
        keyword = name.upper()
        if keyword not in COMMENTS:
            raise KeyError(keyword)
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            continue
        if isinstance(value, str):
            value = value.encode("ascii", "backslashreplace").decode("ascii")
        meta[keyword] = value
    return meta
