"""From a source of stamps to one table, chunk by chunk."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from fdnt_xp.app.backends import Backend
from fdnt_xp.data.images import Pixels, native_pixels
from fdnt_xp.data.noise import BorderNoise, measure_border_noise
from fdnt_xp.data.stamps import StampChunk, StampSource
from fdnt_xp.errors import FdntWarning, RangeError, ShapeMismatchError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import measure_shapes

if TYPE_CHECKING:
    from astropy.table import Table

CHUNK_ON_CPU = 256
"""Galaxies at a time, unless told otherwise: the progress bar moves every second or so."""
CHUNK_ON_GPU = 8192
"""Enough to fill a GPU; 64 x 64 pixels in float64 are 268 MB."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """The noise variance that is handed to the measurement.

    Parameters
    ----------
    variance : float or None
        Per pixel; None if there is none.
    border : BorderNoise or None
        What it was measured from; None if it was given.
    """

    variance: float | None
    border: BorderNoise | None = None


def find_noise(source: StampSource, given: float | None = None) -> Noise:
    """Return the variance given, or that of the stamps' borders.

    Warns (`FdntWarning`) of a background left in the image, and if there is no noise.
    """
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise RangeError("noise_variance", given, 0.0, None)
        return Noise(variance=given)
    border = measure_border_noise(source)
    if border.has_background:
        warnings.warn(
            f"the borders of the stamps are not at zero but at {border.level:.4g} +- "
            f"{border.level_err:.2g} (noise {border.variance**0.5:.4g}): "
            "take the background off the image",
            FdntWarning,
            stacklevel=2,
        )
    if not border.known and source.n_gal:
        warnings.warn(
            "no noise can be measured on the borders of the stamps, so there are no errors "
            "and no S/N; give the variance (--noise-variance)",
            FdntWarning,
            stacklevel=2,
        )
    return Noise(variance=border.variance if border.known else None, border=border)


def measure_source(
    source: StampSource,
    psf_pixels: Pixels,
    *,
    backend: Backend,
    noise_variance: float | None,
    oversampling: int = 1,
    size: float | None = None,
    chunk: int | None = None,
    quiet: bool = True,
) -> Table:
    """Measure every galaxy of a source; memory is that of one chunk and the table.

    Parameters
    ----------
    source : StampSource
        The stamps.
    psf_pixels : array, shape (ny, nx) or (n_gal, ny, nx)
        The PSF of all, or of each galaxy.
    backend : Backend
        Where to compute.
    noise_variance : float or None
        Per pixel.
    oversampling : int
        PSF pixels per image pixel.
    size : float, optional
        Weight size in pixels, if it is not to be solved for.
    chunk : int, optional
        Galaxies at a time.
    quiet : bool
        No progress bar; there is none either where stderr is not a terminal.

    Returns
    -------
    astropy.table.Table
        One row for each galaxy, in order: those without a whole stamp are NaN and flagged.

    Raises
    ------
    ShapeMismatchError
        If there are PSFs for another number of galaxies.
    """
    if psf_pixels.ndim == 3 and len(psf_pixels) not in (1, source.n_gal):
        raise ShapeMismatchError(
            f"there are {len(psf_pixels)} PSF images but {source.n_gal} galaxies; "
            "give one PSF, or one for each"
        )
    if psf_pixels.ndim == 3 and len(psf_pixels) == 1:
        psf_pixels = psf_pixels[0]
    chunk = chunk or (CHUNK_ON_CPU if backend.on_cpu else CHUNK_ON_GPU)

    def psf_of(rows: slice) -> Psf:
        pixels = psf_pixels if psf_pixels.ndim == 2 else psf_pixels[rows]
        image = backend.from_numpy(native_pixels(pixels))
        return Psf.from_image(image, oversampling=oversampling)

    common = psf_of(slice(0)) if psf_pixels.ndim == 2 else None
    tables = []
    bar = tqdm(
        total=source.n_gal, unit=" galaxies", leave=False, disable=quiet or not sys.stderr.isatty()
    )
    with bar:
        # An empty source still gives its one table, of no rows.
        for part in source.chunks(chunk) if source.n_gal else [source.read(0, 0)]:
            shapes = measure_shapes(
                backend.from_numpy(part.stamps),
                common or psf_of(part.rows),
                noise_variance=noise_variance,
                size=size,
            )
            tables.append(_table(source, part, shapes.to_table()))
            bar.update(len(part.flags))
    return _stack(tables)


def _table(source: StampSource, part: StampChunk, shapes: Table) -> Table:
    """Put the columns of the image before those of the shape."""
    from astropy.table import Table

    centroid = np.stack([shapes["x"], shapes["y"]], axis=-1) + source.corners[part.rows]
    _withdraw(shapes, part.flags)
    table = Table()
    columns: dict[str, tuple[NDArray[Any], str | None, str]] = {
        "id": (source.ids[part.rows], None, "name or number of the galaxy"),
        "x": (source.positions[part.rows, 0], "pix", "position given, along columns, 0-based"),
        "y": (source.positions[part.rows, 1], "pix", "position given, along rows, 0-based"),
        "x_image": (centroid[:, 0], "pix", "centroid on the image, along columns, 0-based"),
        "y_image": (centroid[:, 1], "pix", "centroid on the image, along rows, 0-based"),
    }
    for name, (values, unit, description) in columns.items():
        table[name] = values
        table[name].unit, table[name].description = unit, description
    for name in shapes.colnames:
        if name not in ("x", "y"):
            table[name] = shapes[name]
    return table


def _withdraw(shapes: Table, flags: NDArray[np.int32]) -> None:
    """Let a galaxy without a whole stamp be flagged for that alone, not for its NaN pixels."""
    missing = flags != 0
    shapes["flags"][missing] = flags[missing]
    shapes["n_iter"][missing] = 0


def _stack(tables: list[Table]) -> Table:
    from astropy.table import Table

    whole = Table()
    for name in tables[0].colnames:
        whole[name] = np.concatenate([np.asarray(table[name]) for table in tables])
        whole[name].unit = tables[0][name].unit
        whole[name].description = tables[0][name].description
    return whole
