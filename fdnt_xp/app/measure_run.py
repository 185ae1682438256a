"""What `fdnt-xp measure` does, between its options and its last line."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import fdnt_xp.peers  # noqa: F401  gives its methods their names
from fdnt_xp.app.backends import Backend, load_backend
from fdnt_xp.app.chunks import ChunkSize
from fdnt_xp.app.measure import Inputs, Settings, find_jacobians, open_beside, open_psf, open_source
from fdnt_xp.app.noise import Noise, find_noise
from fdnt_xp.app.parts import PartsReport, PartsRun, Rows
from fdnt_xp.app.responses import common_size, response_measurer
from fdnt_xp.app.resume import files_as_they_are
from fdnt_xp.app.runner import ChunkPsfs, MeasureChunk, measure_rows, shape_measurer
from fdnt_xp.data.catalog import check_catalog
from fdnt_xp.data.images import read_image
from fdnt_xp.data.ivar import IvarSource
from fdnt_xp.data.provenance import Value, provenance
from fdnt_xp.data.row_batches import check_text
from fdnt_xp.data.stamps import StampSource
from fdnt_xp.errors import FdntValueError
from fdnt_xp.shapes.methods import NULL_TEST_METHODS, method_in_noise, shape_method
from fdnt_xp.shears.responses import COLUMNS as RESPONSE_COLUMNS

if TYPE_CHECKING:
    from astropy.table import Table

_FOR_SUMMARY: Final = ("flags", "e1", "e2")


def measure_files(
    inputs: Inputs,
    settings: Settings,
    output: str,
    *,
    overwrite: bool = False,
    jobs: int = 1,
    scheduler: str | None = None,
) -> PartsReport:
    """Measure an image and write the catalog; memory is that of a chunk for each process.

    Parameters
    ----------
    inputs : Inputs
        What to measure.
    settings : Settings
        How.
    output : str
        The catalog. Until it is whole, what is finished is in the folder `OUTPUT.parts`, and
        the same call goes on with it.
    overwrite : bool
        Whether it may replace a file.
    jobs, scheduler
        Who measures: see `fdnt_xp.app.workers.open_workers`. Workers of a cluster must see
        the files under the same names.

    Returns
    -------
    PartsReport
        With the columns that the closing summary needs; none if `settings.quiet`.

    Raises
    ------
    FdntError
        If something cannot be read, measured or written.
    """
    inputs.refuse_as_output(output)
    check_catalog(output, overwrite=overwrite)
    _check(inputs, settings)
    plan, work = _make_plan(inputs, settings)
    check_text(output, work.source.ids, "id")
    run = PartsRun(
        output=Path(output),
        n_gal=work.source.n_gal,
        chunk=work.size.size,
        options=_options(inputs, settings),
        shown={"image": "IMAGE"} | {str(path): f"{path} of" for path in inputs.files()},
        overwrite=overwrite,
    )

    def header(found: Mapping[str, Any]) -> dict[str, Value]:
        return _facts(inputs, settings, work.psfs.backend, plan.noise, found.get("RSTEP"))

    needed = tuple(RESPONSE_COLUMNS) if settings.responses else _FOR_SUMMARY
    _OPEN[plan.token] = work
    try:
        return run.make(
            _PartJob(plan),
            header,
            keep=() if settings.quiet else needed,
            jobs=jobs,
            scheduler=scheduler,
            quiet=settings.quiet,
        )
    finally:
        _OPEN.clear()


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a process is told, to measure the same in the same way.

    Parameters
    ----------
    inputs : Inputs
        With full names of the files.
    settings : Settings
    noise : Noise
        As it was found, once for all.
    size : float or None
        Of the weight, if it is one for all.
    token : str
        Of this run.
    """

    inputs: Inputs
    settings: Settings
    noise: Noise
    size: float | None
    token: str


@dataclass(frozen=True, kw_only=True)
class Work:
    """What is open and made ready in a process.

    Parameters
    ----------
    source : StampSource
    psfs : ChunkPsfs
    measure : callable
        Measures a chunk.
    size : ChunkSize
    """

    source: StampSource
    psfs: ChunkPsfs
    measure: MeasureChunk
    size: ChunkSize


_OPEN: Final[dict[str, Work]] = {}
"""That of the run at hand, by its token, so that each process opens and prepares it once."""


@dataclass(frozen=True)
class _PartJob:
    """Measures a part, in whatever process it finds itself."""

    plan: Plan

    def __call__(self, rows: Rows, *, report: Callable[[int], object] | None) -> Table:
        token = self.plan.token
        if token not in _OPEN:
            _OPEN.clear()
            source, psfs = _open(self.plan.inputs, self.plan.settings)
            _OPEN[token] = _prepare(self.plan, source, psfs)
        work = _OPEN[token]
        return measure_rows(
            work.source, work.psfs, work.measure, rows, size=work.size, report=report
        )


def _check(inputs: Inputs, settings: Settings) -> None:
    """Refuse options that do not go together."""
    if settings.responses and settings.method != "fdnt-ft":
        raise FdntValueError("--method chooses how shapes are measured, not --responses")
    if settings.responses and (inputs.mask or inputs.weight):
        raise FdntValueError("--mask and --weight are for shapes, not for --responses")


def _make_plan(inputs: Inputs, settings: Settings) -> tuple[Plan, Work]:
    """Open all files, find the noise, and get ready."""
    shape_method(settings.method)  # a wrong name is said before any file is
    source, psfs = _open(inputs, settings)
    mask = open_beside(source, inputs.mask, "mask")
    blank = None
    if inputs.noise_image is not None:
        blank = read_image(inputs.noise_image, ndim=(2, 3), what="noise image")
    mapped = inputs.weight is not None
    noise = find_noise(source, settings.noise_variance, blank, mask=mask, mapped=mapped)
    size = settings.size
    if settings.responses:
        jacobians = find_jacobians(inputs, settings.method, source)
        size = size or common_size(source, psfs, noise, jacobians)
    plan = Plan(
        inputs=inputs.absolute(),
        settings=settings,
        noise=noise,
        size=size,
        token=secrets.token_hex(8),
    )
    return plan, _prepare(plan, source, psfs)


def _open(inputs: Inputs, settings: Settings) -> tuple[StampSource, ChunkPsfs]:
    backend = load_backend(settings.backend, settings.device, settings.dtype)
    source = open_source(inputs)
    pixels = open_psf(inputs, source, settings.oversampling)
    return source, ChunkPsfs.of(pixels, source, backend, settings.oversampling)


def _prepare(plan: Plan, source: StampSource, psfs: ChunkPsfs) -> Work:
    inputs, settings, noise = plan.inputs, plan.settings, plan.noise
    jacobians = find_jacobians(inputs, settings.method, source)
    if settings.responses:
        measure = response_measurer(
            source,
            backend=psfs.backend,
            noise=noise,
            size=plan.size,
            seed=settings.seed,
            jacobians=jacobians,
        )
    else:
        mask = open_beside(source, inputs.mask, "mask")
        weight = open_beside(source, inputs.weight, "weight map")
        ivar = None
        if mask is not None or weight is not None:
            ivar = IvarSource(mask=mask, weight=weight, variance=noise.variance)
        coloured = None
        if noise.power is not None and ivar is None:
            coloured = method_in_noise(settings.method, psfs.backend.from_numpy(noise.power))
        measure = shape_measurer(
            coloured or shape_method(settings.method),
            backend=psfs.backend,
            noise_variance=None if coloured else noise.variance,
            ivar=ivar,
            size=plan.size,
            jacobians=jacobians,
        )
    size = ChunkSize(settings.chunk, psfs.backend)
    return Work(source=source, psfs=psfs, measure=measure, size=size)


def _correlated(inputs: Inputs, settings: Settings, noise: Noise) -> bool | None:
    """Return whether noise was taken for correlated; None for shapes where it was not."""
    if settings.responses:
        return noise.power is not None
    known = settings.method in NULL_TEST_METHODS and not (inputs.mask or inputs.weight)
    return (noise.power is not None and known) or None


def _options(inputs: Inputs, settings: Settings) -> dict[str, Any]:
    """Return what must be the same when a run is resumed: the files too, as they are now."""
    options = {**asdict(inputs), **asdict(settings)}
    del options["quiet"]
    return options | files_as_they_are(inputs.files())


def _facts(
    inputs: Inputs, settings: Settings, backend: Backend, noise: Noise, step: float | None
) -> dict[str, Value]:
    """Return the header of the catalog."""
    positions = inputs.layout == "positions"
    return provenance(
        method="responses" if settings.responses else settings.method,
        backend=backend.library,
        libver=backend.version,
        device=backend.device,
        dtype=backend.dtype,
        image=inputs.image,
        psfimage=inputs.psf,
        psfmodel=None if inputs.psf_model == "image" else inputs.psf_model,
        layout=inputs.layout,
        cell=inputs.cell,
        poscat=inputs.positions,
        stampsiz=inputs.stamp_size,
        xcolumn=inputs.x_column if positions else None,
        ycolumn=inputs.y_column if positions else None,
        origin=inputs.origin if positions else None,
        oversamp=settings.oversampling,
        noisevar=noise.variance,
        noiseerr=noise.relative_err,
        noisesrc=noise.origin,
        noiseimg=inputs.noise_image,
        maskimg=inputs.mask,
        ivarimg=inputs.weight,
        noisecor=_correlated(inputs, settings, noise),
        jacobian="wcs" if inputs.wcs else _short(inputs.jacobian),
        bordlvl=noise.border.level if noise.border else None,
        wtsize=settings.size,
        chunk=settings.chunk,
        seed=settings.seed if settings.responses else None,
        rstep=step,
    )


def _short(jacobian: str | None) -> str | None:
    """Return the numbers of a Jacobian with as many digits as a card of a header holds."""
    if jacobian is None:
        return None
    return ",".join(f"{float(part):.6g}" for part in jacobian.split(","))
