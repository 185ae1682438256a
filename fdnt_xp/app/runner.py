"""From a source of stamps to one table, chunk by chunk."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from fdnt_xp.app.backends import Backend
from fdnt_xp.arrays import Array
from fdnt_xp.data.images import Pixels, native_pixels
from fdnt_xp.data.ivar import IvarSource
from fdnt_xp.data.noise import BorderNoise, measure_border_noise
from fdnt_xp.data.noise_power import NoisePower, measure_noise_power, noise_stamps
from fdnt_xp.data.stamps import StampChunk, StampSource
from fdnt_xp.errors import FdntValueError, FdntWarning, RangeError, ShapeMismatchError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shapes.methods import ShapeMethod

if TYPE_CHECKING:
    from astropy.table import Table

CHUNK_ON_CPU = 256
"""Galaxies at a time, unless told otherwise: the progress bar moves every second or so."""
CHUNK_ON_GPU = 8192
"""Enough to fill a GPU; 64 x 64 pixels in float64 are 268 MB."""


MeasureChunk: TypeAlias = "Callable[[StampChunk, Array, Psf], Table]"
"""Measures the stamps of a chunk, with their PSF, both where the backend computes."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """The noise that is handed to the measurement.

    Parameters
    ----------
    variance : float or None
        Per pixel; None if there is none.
    border : BorderNoise, optional
        What it was measured from: the borders of the stamps,
    blank : NoisePower, optional
        or blank stamps; it was given if both are None.
    mapped : bool
        Whether a map has it for each pixel; there is no number then.
    """

    variance: float | None
    border: BorderNoise | None = None
    blank: NoisePower | None = None
    mapped: bool = False

    @property
    def origin(self) -> str:
        """Where the number came from."""
        if self.mapped:
            return "weight map"
        if self.blank is not None:
            return "noise image"
        return "given" if self.border is None else "stamp borders"

    @property
    def relative_err(self) -> float | None:
        """Relative error of the variance; None if it was given."""
        measured = self.blank or self.border
        if measured is None or self.variance is None:
            return None
        return measured.variance_err / self.variance

    @property
    def power(self) -> NDArray[np.float64] | None:
        """Power spectrum, shape (ny, nx); None if the noise is white as far as is known."""
        return None if self.blank is None or self.blank.is_white else self.blank.power


def find_noise(
    source: StampSource,
    given: float | None = None,
    blank: Pixels | None = None,
    *,
    mask: StampSource | None = None,
    mapped: bool = False,
) -> Noise:
    """Return the variance given, or the noise of blank sky, or that of the stamps' borders.

    Warns (`FdntWarning`) of a background left in the image, and if there is no noise.

    Parameters
    ----------
    source : StampSource
        The stamps.
    given : float, optional
        Variance of a pixel.
    blank : array, shape (height, width) or (n, ny, nx), optional
        Image of noise, or stamps of it of the shape of those of the source.
    mask : StampSource, optional
        Beside the source; pixels of the borders where it is not 0 are left out.
    mapped : bool
        Whether a map has the inverse variance of each pixel, so that none is to be found.
    """
    if mapped and (given is not None or blank is not None):
        raise FdntValueError(
            "--weight says what the noise of each pixel is: give no --noise-variance and no "
            "--noise-image with it"
        )
    if mapped:
        return Noise(variance=None, mapped=True)
    if given is not None and blank is not None:
        raise FdntValueError("give --noise-variance or --noise-image, not both")
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise RangeError("noise_variance", given, 0.0, None)
        return Noise(variance=given)
    if blank is not None:
        measured = measure_noise_power(_blank_stamps(blank, source.stamp_shape))
        return Noise(variance=measured.variance, blank=measured)
    border = measure_border_noise(source, mask)
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
            "and no S/N; give the variance (--noise-variance, --noise-image)",
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
    ivar: IvarSource | None = None,
    method: ShapeMethod = measure_shapes,
    oversampling: float = 1,
    size: float | None = None,
    chunk: int | None = None,
    quiet: bool = True,
    jacobians: NDArray[np.float64] | None = None,
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
        Per pixel; not looked at if there is an `ivar`.
    ivar : IvarSource, optional
        Inverse variance of each pixel.
    method : callable
        One of `fdnt_xp.shapes.methods`.
    oversampling : float
        PSF pixels per image pixel.
    size : float, optional
        Weight size in pixels, if it is not to be solved for.
    chunk : int, optional
        Galaxies at a time.
    quiet : bool
        No progress bar; there is none either where stderr is not a terminal.
    jacobians : array, shape (2, 2) or (n_gal, 2, 2), optional
        Of the pixels, for methods that take them.

    Returns
    -------
    astropy.table.Table
        One row for each galaxy, in order: those without a whole stamp are NaN and flagged.

    Raises
    ------
    ShapeMismatchError
        If there are PSFs for another number of galaxies.
    """

    def measure(part: StampChunk, stamps: Array, psf: Psf) -> Table:
        options: dict[str, Any] = {"size": size}
        if ivar is None:
            options["noise_variance"] = noise_variance
        else:
            options["ivar"] = backend.from_numpy(ivar.read(part))
        if jacobians is not None:
            options["jacobian"] = jacobian_of(jacobians, part.rows, backend)
        return method(stamps, psf, **options).to_table()

    psfs = ChunkPsfs.of(psf_pixels, source, backend, oversampling)
    return measure_chunks(source, psfs, measure, chunk=chunk, quiet=quiet)


def jacobian_of(jacobians: NDArray[np.float64], rows: slice, backend: Backend) -> Array:
    """Return the Jacobian of all galaxies, or those of some, where the backend computes."""
    return backend.from_numpy(jacobians if jacobians.ndim == 2 else jacobians[rows])


@dataclass(frozen=True, kw_only=True)
class ChunkPsfs:
    """The PSF of each chunk of galaxies, made when it is its turn.

    Parameters
    ----------
    pixels : array, shape (ny, nx) or (n_gal, ny, nx)
        The PSF of all, or of each galaxy.
    backend : Backend
        Where to compute.
    oversampling : float
        PSF pixels per image pixel.
    common : Psf or None
        The one of all, if there is one.
    """

    pixels: Pixels
    backend: Backend
    oversampling: float
    common: Psf | None

    @classmethod
    def of(
        cls, pixels: Pixels, source: StampSource, backend: Backend, oversampling: float
    ) -> ChunkPsfs:
        """Return the PSFs of the galaxies of a source.

        Raises
        ------
        ShapeMismatchError
            If there are PSFs for another number of galaxies.
        """
        if pixels.ndim == 3 and len(pixels) not in (1, source.n_gal):
            raise ShapeMismatchError(
                f"there are {len(pixels)} PSF images but {source.n_gal} galaxies; "
                "give one PSF, or one for each"
            )
        if pixels.ndim == 3 and len(pixels) == 1:
            pixels = pixels[0]
        psfs = cls(pixels=pixels, backend=backend, oversampling=oversampling, common=None)
        return replace(psfs, common=psfs._make(pixels)) if pixels.ndim == 2 else psfs

    def rows(self, rows: slice) -> Psf:
        """Return the PSF of a range of galaxies."""
        return self.common or self._make(self.pixels[rows])

    def _make(self, pixels: Pixels) -> Psf:
        image = self.backend.from_numpy(native_pixels(pixels))
        return Psf.from_image(image, oversampling=self.oversampling)


def measure_chunks(
    source: StampSource,
    psfs: ChunkPsfs,
    measure: MeasureChunk,
    *,
    chunk: int | None,
    quiet: bool,
) -> Table:
    """Measure a source chunk by chunk; the columns of the image come before those measured.

    Parameters
    ----------
    source : StampSource
        The stamps.
    psfs : ChunkPsfs
        Their PSFs, and where to compute.
    measure : callable
        Returns a table with the columns `x`, `y` (centroid on the stamp) and `flags`.
    chunk : int or None
        Galaxies at a time.
    quiet : bool
        No progress bar; there is none either where stderr is not a terminal.
    """
    chunk = chunk or (CHUNK_ON_CPU if psfs.backend.on_cpu else CHUNK_ON_GPU)
    tables = []
    bar = tqdm(
        total=source.n_gal, unit=" galaxies", leave=False, disable=quiet or not sys.stderr.isatty()
    )
    with bar:
        # An empty source still gives its one table, of no rows.
        for part in source.chunks(chunk) if source.n_gal else [source.read(0, 0)]:
            stamps = psfs.backend.from_numpy(part.stamps)
            tables.append(_table(source, part, measure(part, stamps, psfs.rows(part.rows))))
            bar.update(len(part.flags))
    return _stack(tables)


def _blank_stamps(blank: Pixels, shape: tuple[int, int]) -> Pixels:
    """Return stamps of a blank image, or the planes of a cube, in memory."""
    if blank.ndim == 2:
        return noise_stamps(native_pixels(blank), shape)
    if blank.shape[1:] != shape:
        raise ShapeMismatchError(
            f"the planes of the noise image have {blank.shape[2]} x {blank.shape[1]} pixels, "
            f"the stamps of the galaxies {shape[1]} x {shape[0]}; they must be the same"
        )
    return native_pixels(blank)


def _table(source: StampSource, part: StampChunk, measured: Table) -> Table:
    """Put the columns of the image before those that were measured."""
    from astropy.table import Table

    centroid = np.stack([measured["x"], measured["y"]], axis=-1) + source.corners[part.rows]
    _withdraw(measured, part.flags)
    table = Table(meta=measured.meta)
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
    for name in measured.colnames:
        if name not in ("x", "y"):
            table[name] = measured[name]
    return table


def _withdraw(measured: Table, flags: NDArray[np.int32]) -> None:
    """Let a galaxy without a whole stamp be flagged for that alone, not for its NaN pixels."""
    missing = flags != 0
    measured["flags"][missing] = flags[missing]
    if "n_iter" in measured.colnames:
        measured["n_iter"][missing] = 0


def _stack(tables: list[Table]) -> Table:
    from astropy.table import Table

    whole = Table(meta=tables[0].meta)
    for name in tables[0].colnames:
        whole[name] = np.concatenate([np.asarray(table[name]) for table in tables])
        whole[name].unit = tables[0][name].unit
        whole[name].description = tables[0][name].description
    return whole
