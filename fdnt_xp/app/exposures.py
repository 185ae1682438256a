"""What `fdnt-xp measure-exposures` does: from MEDS files to a catalog, some objects at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.app.backends import Backend, load_backend
from fdnt_xp.app.chunks import ChunkSize
from fdnt_xp.app.parts import PartsReport, PartsRun, Rows
from fdnt_xp.app.resume import files_as_they_are
from fdnt_xp.arrays import Array, to_numpy
from fdnt_xp.data.bands import join_bands
from fdnt_xp.data.catalog import check_catalog
from fdnt_xp.data.exposures import ExposureBatch
from fdnt_xp.data.images import image_file, native_pixels, read_image
from fdnt_xp.data.meds import MedsFile, MedsOptions, Segments, open_meds
from fdnt_xp.data.meds_index import Cutouts, chunk_ranges, equal_boxes
from fdnt_xp.data.provenance import Value, provenance
from fdnt_xp.errors import CatalogError, ShapeMismatchError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.exposure_results import ExposureResult
from fdnt_xp.shapes.exposures import Fill, measure_exposures
from fdnt_xp.shapes.psf_shapes import PsfShapes, measure_psf_shapes

if TYPE_CHECKING:
    from astropy.table import Table

METHODS: Final[dict[str, Fill]] = {"fdnt-ft": "ft", "fdnt-hybrid": "hybrid"}
"""What becomes of exposures with missing pixels, by the names that `measure` has for it."""
_PIXELS: Final = {True: 2**22, False: 2**26}
"""Of a chunk at most, if it is of several objects: of those that have a hundred exposures."""


@dataclass(frozen=True, kw_only=True)
class ExposureInputs:
    """What to measure, by the options of the command line.

    Parameters
    ----------
    files : tuple of str
        MEDS files of the same objects, one for each band.
    psf : str or None
        Image of the PSF of all exposures, in place of those in the files.
    cutouts : {"all", "epochs", "first"}
    bad_bits : int or None
    segments : {"mask", "ignore"}
    noise_variance : float or None
        See `fdnt_xp.data.meds.MedsOptions`.
    """

    files: tuple[str, ...]
    psf: str | None = None
    cutouts: Cutouts = "all"
    bad_bits: int | None = None
    segments: Segments = "mask"
    noise_variance: float | None = None

    def options(self) -> MedsOptions:
        """Return what is taken of each file, with the PSF that was named."""
        star = None if self.psf is None else native_pixels(read_image(self.psf, what="PSF image"))
        return MedsOptions(
            cutouts=self.cutouts,
            bad_bits=self.bad_bits,
            segments=self.segments,
            noise_variance=self.noise_variance,
            star=star,
        )

    def paths(self) -> list[Path]:
        """Return the files that are read."""
        star = [] if self.psf is None else [image_file(self.psf)]
        return [*map(Path, self.files), *star]

    def absolute(self) -> ExposureInputs:
        """Return the same with full names of the files."""
        psf = None if self.psf is None else str(Path(self.psf).absolute())
        files = tuple(str(Path(path).absolute()) for path in self.files)
        return replace(self, files=files, psf=psf)

    def refuse_as_output(self, output: str) -> None:
        """Raise `CatalogError` if the output would replace one of the inputs."""
        for path in self.paths():
            if path.resolve() == Path(output).resolve():
                raise CatalogError(f"{output} is an input; choose another name for the output")


@dataclass(frozen=True, kw_only=True)
class ExposureSettings:
    """How to measure it.

    Parameters
    ----------
    backend, device, dtype : str
        See `fdnt_xp.app.backends.load_backend`.
    method : str
        One of `METHODS`.
    oversampling : int
        PSF pixels per image pixel.
    size : float or None
        Weight size on the sky, if fixed.
    chunk : int or None
        Objects at a time, at most.
    quiet : bool
        No progress bar.
    """

    backend: str = "numpy"
    device: str | None = None
    dtype: str = "float64"
    method: str = "fdnt-ft"
    oversampling: int = 1
    size: float | None = None
    chunk: int | None = None
    quiet: bool = False


def measure_exposure_files(
    inputs: ExposureInputs,
    settings: ExposureSettings,
    output: str,
    *,
    overwrite: bool = False,
    jobs: int = 1,
    scheduler: str | None = None,
) -> PartsReport:
    """Measure the objects of MEDS files and write the catalog, as `measure_files` does.

    Memory is that of a chunk for each process. Until the catalog is whole, what is finished is
    in the folder `OUTPUT.parts`, and the same call goes on with it.

    Parameters
    ----------
    inputs : ExposureInputs
    settings : ExposureSettings
    output : str
        The catalog.
    overwrite : bool
        Whether it may replace a file.
    jobs, scheduler
        Who measures: see `fdnt_xp.app.workers.open_workers`.

    Returns
    -------
    PartsReport
        With the columns that the closing summary needs.

    Raises
    ------
    ShapeMismatchError
        If the files are of different objects.
    FdntError
        If something cannot be read, measured or written.
    """
    inputs.refuse_as_output(output)
    check_catalog(output, overwrite=overwrite)
    backend = load_backend(settings.backend, settings.device, settings.dtype)
    size = ChunkSize(settings.chunk, backend).size
    with _opened(inputs) as files:
        n_objects = files[0].index.n_objects
        facts = _facts(inputs, settings, backend, files)
    run = PartsRun(
        output=Path(output),
        n_gal=n_objects,
        chunk=1,
        largest_part=size,  # of many stamps each: a kill should not cost more
        command="measure-exposures",
        options=_options(inputs, settings),
        shown={"files": "FILE"} | {str(path): f"{path} of" for path in inputs.paths()},
        overwrite=overwrite,
    )
    return run.make(
        partial(measure_part, inputs=inputs.absolute(), settings=settings),
        lambda _found: facts,
        keep=() if settings.quiet else ("flags", "e1", "e2"),
        jobs=jobs,
        scheduler=scheduler,
        quiet=settings.quiet,
    )


def measure_part(
    rows: Rows,
    *,
    inputs: ExposureInputs,
    settings: ExposureSettings,
    report: Callable[[int], object] | None,
) -> Table:
    """Measure some objects, in whatever process; see `fdnt_xp.app.parts.PartJob`."""
    backend = load_backend(settings.backend, settings.device, settings.dtype)
    size = ChunkSize(settings.chunk, backend)
    with _opened(inputs) as files:

        def measure(start: int, stop: int) -> Table:
            table = _measure_chunk(files, slice(start, stop), settings, backend)
            if report is not None:
                report(len(table))
            return table

        pixels = np.sum([file.index.pixels_per_object for file in files], axis=0)[slice(*rows)]
        most = _PIXELS[backend.on_cpu]
        tables: list[Table] = []
        for part in chunk_ranges(pixels, most_objects=size.size, most_pixels=most):
            tables += size.each(rows.start + part.start, rows.start + part.stop, measure)
        # An empty file still gives its one table, of no rows.
        return _stacked(tables or [measure(rows.start, rows.stop)])


@contextmanager
def _opened(inputs: ExposureInputs) -> Iterator[list[MedsFile]]:
    """Open the files of all bands, and see that they are of the same objects."""
    options = inputs.options()
    with ExitStack() as stack:
        files = [stack.enter_context(open_meds(path, options)) for path in inputs.files]
        _check_objects(files)
        yield files


def _options(inputs: ExposureInputs, settings: ExposureSettings) -> dict[str, Any]:
    """Return what must be the same when a run is resumed: the files too, as they are now."""
    options = {**asdict(inputs), **asdict(settings), "files": list(inputs.files)}
    del options["quiet"]
    return options | files_as_they_are(inputs.paths())


def _check_objects(files: list[MedsFile]) -> None:
    for other in files[1:]:
        if not np.array_equal(files[0].index.ids, other.index.ids):
            raise ShapeMismatchError(
                f"{other.path} is of other objects than {files[0].path}: the column id must be "
                "the same in the files of all bands"
            )


def _measure_chunk(
    files: list[MedsFile], rows: slice, settings: ExposureSettings, backend: Backend
) -> Table:
    """Measure some objects, those with equal stamps together; return them in their order."""
    boxes = np.max([file.index.largest_box for file in files], axis=0)
    groups = equal_boxes(boxes, rows)
    measured = (_measure(_read(files, group), settings, backend) for group in groups)
    tables = [_with_bands(table, len(files)) for table in measured]
    table = _stacked(tables)[np.argsort(np.concatenate(groups))]
    ra_dec = files[0].index.ra_dec
    if ra_dec is not None:
        for place, name in enumerate(("ra", "dec")):
            table.add_column(ra_dec[rows, place], name=name, index=1 + place)
            table[name].unit = "deg"
            table[name].description = f"{name} of the object in the file"
    return table


def _read(files: list[MedsFile], rows: NDArray[np.int64]) -> ExposureBatch:
    batches = [file.read(rows) for file in files]
    return batches[0] if len(batches) == 1 else join_bands(batches)


def _measure(batch: ExposureBatch, settings: ExposureSettings, backend: Backend) -> Table:
    arguments = batch.arguments(backend.from_numpy, oversampling=settings.oversampling)
    transform = METHODS[settings.method]
    result = measure_exposures(**arguments, transform=transform, size=settings.size)
    table = result.to_table(_mean_psfs(result, arguments["psf"], arguments["jacobian"]))
    table.add_column(batch.ids, name="id", index=0)
    table["id"].description = "name or number of the object"
    return table


def _mean_psfs(result: ExposureResult, psf: Psf, jacobian: Array) -> PsfShapes:
    """Return the mean PSF of each object, of the exposures that count, each as (S/N)²."""
    nan = np.full(result.n_gal, np.nan)
    if psf.n_gal == 0:
        return PsfShapes(eta=np.stack([nan, nan], axis=-1), size=nan)
    psfs = measure_psf_shapes(psf, jacobian=jacobian)
    index, snr = to_numpy(result.object_index), to_numpy(result.stamp_snr)
    values = np.concatenate([to_numpy(psfs.eta), to_numpy(psfs.size)[:, None]], axis=1)
    weight = np.where(np.isfinite(snr), snr, 1.0) ** 2
    weight = np.where(to_numpy(result.stamp_used) & np.isfinite(values[:, 2]), weight, 0.0)
    sums = [
        np.bincount(index, weight * np.where(weight > 0, column, 0.0), minlength=result.n_gal)
        for column in (*values.T, np.ones(len(index)))
    ]
    with np.errstate(invalid="ignore"):
        eta1, eta2, size = (one / sums[-1] for one in sums[:-1])
    return PsfShapes(eta=np.stack([eta1, eta2], axis=-1), size=size)


def _with_bands(table: Table, n_bands: int) -> Table:
    """Return a table with columns for all bands: of some a chunk may have no exposures."""
    names = [f"{what}_{band}" for what in ("flux", "snr") for band in range(n_bands)]
    if n_bands == 1:
        return table
    for name in set(names) - set(table.colnames):
        table[name] = np.full(len(table), np.nan)
        table[name].description = "{} in band {}".format(*name.split("_"))
    return table[[name for name in table.colnames if name not in names] + names]


def _stacked(tables: list[Table]) -> Table:
    from astropy.table import vstack

    return vstack(tables, join_type="exact", metadata_conflicts="silent")


def _facts(
    inputs: ExposureInputs, settings: ExposureSettings, backend: Backend, files: list[MedsFile]
) -> dict[str, Value]:
    """Return the header of the catalog."""
    weighted = all("weight" in file.pixels for file in files)
    source = "weight map" if weighted else "given" if inputs.noise_variance else None
    return provenance(
        method=settings.method,
        backend=backend.library,
        libver=backend.version,
        device=backend.device,
        dtype=backend.dtype,
        image=",".join(inputs.files),
        psfimage=inputs.psf,
        layout="meds",
        cutouts=inputs.cutouts,
        badbits=inputs.bad_bits,
        segments=inputs.segments,
        oversamp=settings.oversampling,
        noisevar=inputs.noise_variance,
        noisesrc=source,
        wtsize=settings.size,
        chunk=settings.chunk,
    )
