"""From a source of stamps to one table, chunk by chunk."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from fdnt_xp.app.backends import Backend
from fdnt_xp.app.chunks import ChunkSize
from fdnt_xp.arrays import Array
from fdnt_xp.data.fits_pixels import let_go
from fdnt_xp.data.images import Pixels, native_pixels
from fdnt_xp.data.ivar import IvarSource
from fdnt_xp.data.model_stars import ModelStars
from fdnt_xp.data.stamps import StampChunk, StampSource
from fdnt_xp.errors import FdntValueError, ShapeMismatchError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shapes.methods import ShapeMethod
from fdnt_xp.shapes.psf_shapes import PsfShapes, measure_psf_shapes
from fdnt_xp.shapes.results import PSF_COLUMNS

if TYPE_CHECKING:
    from astropy.table import Table

IMAGE_COLUMNS: Final[dict[str, tuple[str | None, str]]] = {
    "id": (None, "name or number of the galaxy"),
    "x": ("pix", "position given, along columns, 0-based"),
    "y": ("pix", "position given, along rows, 0-based"),
    "x_image": ("pix", "centroid on the image, along columns, 0-based"),
    "y_image": ("pix", "centroid on the image, along rows, 0-based"),
}
"""Unit and description of the columns that come before those measured."""

MeasureChunk: TypeAlias = "Callable[[StampChunk, Array, Psf], Table]"
"""Measures the stamps of a chunk, with their PSF, both where the backend computes."""


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
    psfs = ChunkPsfs.of(psf_pixels, source, backend, oversampling)
    measure = shape_measurer(
        method,
        backend=backend,
        noise_variance=noise_variance,
        ivar=ivar,
        size=size,
        jacobians=jacobians,
    )
    return measure_chunks(source, psfs, measure, chunk=chunk, quiet=quiet)


def shape_measurer(
    method: ShapeMethod,
    *,
    backend: Backend,
    noise_variance: float | None,
    ivar: IvarSource | None,
    size: float | None,
    jacobians: NDArray[np.float64] | None = None,
) -> MeasureChunk:
    """Return what measures the shapes of a chunk; the parameters are those of `measure_source`."""

    def measure(part: StampChunk, stamps: Array, psf: Psf) -> Table:
        options: dict[str, Any] = {"size": size}
        if ivar is None:
            options["noise_variance"] = noise_variance
        else:
            options["ivar"] = backend.from_numpy(ivar.read(part))
        if jacobians is not None:
            options["jacobian"] = jacobian_of(jacobians, part.rows, backend)
        return method(stamps, psf, **options).to_table()

    return measure


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
    common_shape : PsfShapes or None
        Its shape.
    """

    pixels: Pixels | ModelStars
    backend: Backend
    oversampling: float
    common: Psf | None = None
    common_shape: PsfShapes | None = None

    @classmethod
    def of(
        cls, pixels: Pixels | ModelStars, source: StampSource, backend: Backend, oversampling: float
    ) -> ChunkPsfs:
        """Return the PSFs of the galaxies of a source.

        Raises
        ------
        ShapeMismatchError
            If there are PSFs for another number of galaxies.
        """
        if isinstance(pixels, ModelStars):
            return cls(pixels=pixels, backend=backend, oversampling=oversampling)
        if pixels.ndim == 3 and len(pixels) not in (1, source.n_gal):
            raise ShapeMismatchError(
                f"there are {len(pixels)} PSF images but {source.n_gal} galaxies; "
                "give one PSF, or one for each"
            )
        if pixels.ndim == 3 and len(pixels) == 1:
            pixels = pixels[0]
        psfs = cls(pixels=pixels, backend=backend, oversampling=oversampling)
        if pixels.ndim == 3:
            return psfs
        common = psfs._make(pixels)
        return replace(psfs, common=common, common_shape=_psf_shapes(common))

    def rows(self, rows: slice) -> Psf:
        """Return the PSF of a range of galaxies."""
        return self.common or self._make(self.pixels[rows])

    def shapes(self, psf: Psf) -> PsfShapes:
        """Return the shapes of what `rows` returned."""
        return self.common_shape or _psf_shapes(psf)

    def _make(self, pixels: Pixels) -> Psf:
        image = self.backend.from_numpy(native_pixels(pixels))
        let_go(self.pixels)
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
    size = ChunkSize(chunk, psfs.backend)
    with galaxy_bar(source.n_gal, quiet=quiet) as bar:
        return measure_rows(source, psfs, measure, (0, source.n_gal), size=size, report=bar.update)


def measure_rows(
    source: StampSource,
    psfs: ChunkPsfs,
    measure: MeasureChunk,
    rows: tuple[int, int],
    *,
    size: ChunkSize,
    report: Callable[[int], object] | None = None,
) -> Table:
    """Measure rows `start` to `stop - 1` of a source, as `measure_chunks` does.

    Parameters
    ----------
    source, psfs, measure
        As for `measure_chunks`.
    rows : tuple of int
        start and stop; there may be none.
    size : ChunkSize
        Galaxies at a time.
    report : callable, optional
        Is told after each chunk how many galaxies it had.
    """

    def one(start: int, stop: int) -> Table:
        part = source.read(start, stop)
        psf = psfs.rows(part.rows)
        measured = measure(part, psfs.backend.from_numpy(part.stamps), psf)
        table = _table(source, part, measured, psfs.shapes(psf))
        if report is not None:
            report(len(table))
        return table

    # No galaxies still give their one table, of no rows.
    return _stack(list(size.each(*rows, one)) or [one(*rows)])


def galaxy_bar(n_gal: int, *, quiet: bool, n_before: int = 0) -> tqdm:
    """Return a progress bar; it shows nothing if quiet, or where stderr is not a terminal."""
    return tqdm(
        total=n_gal,
        initial=n_before,
        unit=" galaxies",
        leave=False,
        disable=quiet or not sys.stderr.isatty(),
    )


def _psf_shapes(psf: Psf) -> PsfShapes:
    """Return the shapes of PSFs, NaN where their images have too few pixels for any."""
    try:
        return measure_psf_shapes(psf)
    except FdntValueError:
        n_star = len(psf.image)
        nan = np.full(n_star, np.nan)
        return PsfShapes(eta=np.full((n_star, 2), np.nan), size=nan)


def _table(source: StampSource, part: StampChunk, measured: Table, shapes: PsfShapes) -> Table:
    """Put the columns of the image before those that were measured, and the PSF behind."""
    from astropy.table import Table

    centroid = np.stack([measured["x"], measured["y"]], axis=-1) + source.corners[part.rows]
    _withdraw(measured, part.flags)
    table = Table(meta=measured.meta)
    of_image = {
        "id": source.ids[part.rows],
        "x": source.positions[part.rows, 0],
        "y": source.positions[part.rows, 1],
        "x_image": centroid[:, 0],
        "y_image": centroid[:, 1],
    }
    _add(table, of_image, IMAGE_COLUMNS)
    for name in measured.colnames:
        if name not in ("x", "y"):
            table[name] = measured[name]
    _add(table, shapes.columns(len(measured)), PSF_COLUMNS)
    return table


def _add(
    table: Table,
    columns: Mapping[str, NDArray[Any]],
    described: Mapping[str, tuple[str | None, str]],
) -> None:
    for name, values in columns.items():
        table[name] = values
        table[name].unit, table[name].description = described[name]


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
