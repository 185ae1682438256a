"""One set of a GREAT08 challenge: its catalog, and what each estimator says of its shear."""

from __future__ import annotations

import math
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

import fdnt_xp.peers  # noqa: F401  gives its methods their names
from fdnt_xp.app.backends import Backend, load_backend
from fdnt_xp.app.noise import Noise, find_noise
from fdnt_xp.app.runner import measure_source
from fdnt_xp.app.summary import measured_rows
from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.data.provenance import Value, provenance
from fdnt_xp.data.stamps import StampSource
from fdnt_xp.errors import FdntValueError, FdntWarning, RangeError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.great08.challenge import ChallengeSet
from fdnt_xp.shapes.methods import shape_method
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.from_shapes import shear_from_eta
from fdnt_xp.shears.population import population_null
from fdnt_xp.shears.stacking import shear_from_stack

if TYPE_CHECKING:
    from astropy.table import Table

_CELLS_AT_MOST: Final = 1_000_000
"""Of one set, so that no two galaxies of a challenge have one number."""
_ONE_AT_A_TIME: Final = threading.Lock()
"""A Dask worker may have several threads, but memory for one set, and warnings are recorded
for a whole process."""


@dataclass(frozen=True, kw_only=True)
class MeasureOptions:
    """How every set is measured.

    Parameters
    ----------
    estimators : tuple of str
        Names of `ESTIMATORS`, in the order of the rows.
    method : str
        Of the shapes in the catalog, by its name in `fdnt_xp.shapes.methods`. With another
        than "fdnt-ft" the only estimator is "responsivity": the others see no shapes.
    backend, device, dtype : str
        See `fdnt_xp.app.backends.load_backend`.
    noise_variance : float or None
        Per pixel; measured on the borders of the stamps if None.
    chunk : int or None
        Galaxies at a time.
    seed : int
        Of the synthetic noise, which is another for each galaxy of each set.

    Raises
    ------
    FdntValueError
        If a name is unknown, or options do not go together.
    RangeError
        If the variance is not positive.
    """

    estimators: tuple[str, ...] = ("null",)
    method: str = "fdnt-ft"
    backend: str = "numpy"
    device: str | None = None
    dtype: str = "float64"
    noise_variance: float | None = None
    chunk: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be measured, before any set is opened."""
        shape_method(self.method)
        if not self.estimators or len(set(self.estimators)) < len(self.estimators):
            raise FdntValueError(f"name each estimator once, not {', '.join(self.estimators)!r}")
        for name in self.estimators:
            if name not in ESTIMATORS:
                raise FdntValueError(f"no estimator {name!r}; known are {', '.join(ESTIMATORS)}")
            if name != "responsivity" and self.method != "fdnt-ft":
                raise FdntValueError(
                    f"the estimator {name!r} does not see the shapes that --method {self.method} "
                    "measures: give --estimator responsivity"
                )
        if self._needs_int64 and (self.backend, self.dtype) == ("jax", "float32"):
            raise FdntValueError(
                "the nulls need 64-bit integers, which JAX has with --dtype float64 only"
            )
        v = self.noise_variance
        if v is not None and not (math.isfinite(v) and v > 0):
            raise RangeError("noise_variance", v, 0.0, None)

    @property
    def _needs_int64(self) -> bool:
        return any(name.startswith("null") for name in self.estimators)


@dataclass(frozen=True, kw_only=True)
class SetShear:
    """What one estimator says of a set.

    Parameters
    ----------
    estimator : str
        Its name.
    g1, g2, g1_err, g2_err : float
        Reduced shear and its standard errors; NaN if there is none.
    g1_err_noise, g2_err_noise : float
        Standard errors by the noise of the pixels alone; NaN where they are not known.
    n_used : int
        Galaxies that enter.
    failure : str or None
        Why there is none.
    """

    estimator: str
    g1: float = math.nan
    g2: float = math.nan
    g1_err: float = math.nan
    g2_err: float = math.nan
    g1_err_noise: float = math.nan
    g2_err_noise: float = math.nan
    n_used: int = 0
    failure: str | None = None


@dataclass(frozen=True, kw_only=True)
class SetResult:
    """What is known of a set once it is measured.

    Parameters
    ----------
    number : int
        Of the set.
    name : str
        "set0001".
    n_gal, n_measured : int
        Galaxies, and those of the catalog that have a shape.
    noise_variance, noise_err : float or None
        Per pixel, and its relative error if it was measured.
    noise_origin : str
        Where it came from.
    seconds : float
        That it took.
    warnings : tuple of str
        Said while it was measured, each once.
    shears : tuple of SetShear
        One for each estimator.
    """

    number: int
    name: str
    n_gal: int
    n_measured: int
    noise_variance: float | None
    noise_err: float | None
    noise_origin: str
    seconds: float
    warnings: tuple[str, ...]
    shears: tuple[SetShear, ...]

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows of the set in a submission."""
        shared = {"set": self.number, "n_gal": self.n_gal}
        return [{**asdict(shear), **shared} for shear in self.shears]

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON has it, NaN as None."""
        content = asdict(self)
        content["shears"] = [
            {name: None if value != value else value for name, value in row.items()}
            for row in content["shears"]
        ]
        return content

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> SetResult:
        """Return what `to_dict` was called on."""
        shears = [
            SetShear(**{name: value for name, value in row.items() if value is not None})
            for row in content["shears"]
        ]
        return cls(**{**content, "warnings": tuple(content["warnings"]), "shears": tuple(shears)})


def measure_set(one: ChallengeSet, options: MeasureOptions) -> tuple[Table, SetResult]:
    """Measure a set; return its catalog with provenance, and the shears.

    Galaxies are read from disk a chunk at a time for the catalog. The nulls and the stack
    hold all stamps of the set.

    Raises
    ------
    FdntError
        If the set cannot be read or measured. An estimator that finds no shear raises
        nothing: its `SetShear.failure` says why.
    """
    with _ONE_AT_A_TIME, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FdntWarning)
        start = time.perf_counter()
        backend = load_backend(options.backend, options.device, options.dtype)
        source = one.open_stamps()
        psf_pixels, oversampling = one.read_psf()
        noise = find_noise(source, options.noise_variance)
        table = measure_source(
            source,
            psf_pixels,
            backend=backend,
            method=shape_method(options.method),
            noise_variance=noise.variance,
            oversampling=oversampling,
            chunk=options.chunk,
        )
        table.meta = _facts(one, options, backend, noise, oversampling)
        sample = _Sample(
            number=one.number,
            source=source,
            psf_pixels=psf_pixels,
            oversampling=oversampling,
            noise_variance=noise.variance,
            catalog=table,
            options=options,
            backend=backend,
        )
        shears = tuple(_shear(name, sample) for name in options.estimators)
        seconds = time.perf_counter() - start
    said = [str(w.message) for w in caught if issubclass(w.category, FdntWarning)]
    return table, SetResult(
        number=one.number,
        name=one.name,
        n_gal=source.n_gal,
        n_measured=int(np.sum(measured_rows(table))),
        noise_variance=noise.variance,
        noise_err=noise.relative_err,
        noise_origin=noise.origin,
        seconds=round(seconds, 3),
        warnings=tuple(dict.fromkeys(said)),
        shears=shears,
    )


@dataclass(frozen=True, kw_only=True)
class _Sample:
    """The galaxies of a set, for the estimators."""

    number: int
    source: StampSource
    psf_pixels: NDArray[Any]
    oversampling: float
    noise_variance: float | None
    catalog: Table
    options: MeasureOptions
    backend: Backend

    def stamps_and_psf(self) -> tuple[Array, Psf]:
        """Return all stamps and their PSF, where they are computed with."""
        stamps = self.source.read(0, self.source.n_gal).stamps
        psf = Psf.from_image(
            self.backend.from_numpy(self.psf_pixels), oversampling=self.oversampling
        )
        return self.backend.from_numpy(stamps), psf


def _shear(name: str, sample: _Sample) -> SetShear:
    """Return what an estimator says, or why it says nothing."""
    try:
        found = ESTIMATORS[name](sample).to_dict()
    except FdntValueError as error:
        return SetShear(estimator=name, failure=" ".join(str(error).split()))
    return SetShear(
        estimator=name,
        g1=float(found["g1"]),
        g2=float(found["g2"]),
        g1_err=float(found["g1_err"]),
        g2_err=float(found["g2_err"]),
        g1_err_noise=float(found.get("g1_err_noise", math.nan)),
        g2_err_noise=float(found.get("g2_err_noise", math.nan)),
        n_used=int(found["n_used"]),
    )


def _null(sample: _Sample, statistic: Literal["frozen", "eta"]) -> ShearEstimate:
    stamps, psf = sample.stamps_and_psf()
    xp = array_namespace(stamps=stamps)
    cells = xp.arange(sample.source.n_gal, dtype=xp.int64, device=device_of(stamps))
    return population_null(
        stamps,
        psf,
        statistic=statistic,
        noise_variance=sample.noise_variance,
        seed=sample.options.seed,
        identifiers=sample.number * _CELLS_AT_MOST + cells,
        chunk_size=sample.options.chunk,
    )


def _frozen_null(sample: _Sample) -> ShearEstimate:
    return _null(sample, "frozen")


def _eta_null(sample: _Sample) -> ShearEstimate:
    return _null(sample, "eta")


def _responsivity(sample: _Sample) -> ShearEstimate:
    # A galaxy that is lost leaves its partner at 90 degrees alone, and the most elongated are
    # lost first: without a bound they are most of the error.
    return shear_from_catalog(sample.catalog, "lorentzian")


def shear_from_catalog(catalog: Table, weight: str, **options: Any) -> ShearEstimate:
    """Return the shear of the shapes in a catalog; see `shear_from_eta` for the options."""
    good = catalog[measured_rows(catalog)]
    eta = np.stack([np.asarray(good["eta1"]), np.asarray(good["eta2"])], axis=-1)
    cross = np.asarray(good["eta12_cov"])
    rows = [[good["eta1_var"], cross], [cross, good["eta2_var"]]]
    eta_cov = np.moveaxis(np.array(rows, dtype=np.float64), -1, 0)
    return shear_from_eta(eta, weight, eg=np.asarray(good["eg"]), eta_cov=eta_cov, **options)


def _stack(sample: _Sample) -> ShearEstimate:
    stamps, psf = sample.stamps_and_psf()
    return shear_from_stack(stamps, psf, chunk_size=sample.options.chunk)


ESTIMATORS: Final[dict[str, Callable[[_Sample], ShearEstimate]]] = {
    "null": _frozen_null,
    "null-eta": _eta_null,
    "responsivity": _responsivity,
    "stack": _stack,
}
"""By name: the population null, frozen and of solved shapes, the responsivity of the shapes in
the catalog, of weight 1/(1 + eta²), with their ellipticity gradients, and the null of the stack."""


def _facts(
    one: ChallengeSet,
    options: MeasureOptions,
    backend: Backend,
    noise: Noise,
    oversampling: float,
) -> dict[str, Value]:
    """Return the header of the catalog."""
    return provenance(
        method=options.method,
        backend=backend.library,
        libver=backend.version,
        device=backend.device,
        dtype=backend.dtype,
        image=one.image.name,  # its folder is in run.json
        psfimage=one.psf.name,
        layout="grid",
        cell=one.cell,
        oversamp=oversampling,
        noisevar=noise.variance,
        noiseerr=noise.relative_err,
        noisesrc=noise.origin,
        bordlvl=noise.border.level if noise.border else None,
        chunk=options.chunk,
    )
