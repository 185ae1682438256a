"""Responses to shear, galaxy by galaxy: what a catalog needs for the shear of any part of it.

The frozen quadrupole v of each galaxy, with its noise made round, as it is and under counter-shears
of plus and minus h along both components. The mean of v over any part of a catalog, over
the mean response, is the shear of that part, to second order in the shear; a cut on the
quantities of the same five frames brings its own response along (docs, "Responses").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Final

from fdnt_xp.arrays import Array, array_namespace, device_of, has_any, to_numpy
from fdnt_xp.errors import RangeError
from fdnt_xp.flags import FAILED, Flag
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shears.cuts import QUANTITIES
from fdnt_xp.shears.frames import FrameSample, SampleValues
from fdnt_xp.shears.masks import Masked
from fdnt_xp.shears.sample import NoiseOptions, make_sample

if TYPE_CHECKING:
    from astropy.table import Table

FRAMES: Final = ("", "_1p", "_1m", "_2p", "_2m")
"""Suffixes of columns: as seen, and with shear of +h and -h put on along each component."""
STEP: Final = 0.01
"""Reduced shear of the frames, unless the caller says otherwise."""
_COMMON: Final = ("step", "on_sky")
"""Fields that all galaxies have in common."""
_LARGEST_STEP: Final = 0.1


@dataclass(frozen=True, kw_only=True)
class ResponseResult:
    """The quadrupole of each galaxy, and how it responds to shear.

    All arrays share one library, dtype and device; row i is galaxy i. Where `flags` holds a
    bit of `fdnt_xp.flags.FAILED`, the float columns are NaN.

    Parameters
    ----------
    v : array, shape (n_gal, 2)
        Normalised quadrupole; as g1, g2 are counted, and positive along the galaxy.
    response : array, shape (n_gal, 2, 2)
        `dv_i/dg_j`, g the reduced shear: `<v> = <response> g`.
    snr, flux, size : array, shape (n_gal, 5)
        What cuts may be made on (`FrameQuantities`), in the frames of `FRAMES`; NaN in a
        frame where the galaxy was lost.
    centroid : array, shape (n_gal, 2)
        (x, y) in pixels of the stamp, 0-based.
    flags : array, shape (n_gal,), int32
        Bits of `fdnt_xp.flags.Flag`.
    step : float
        The shear h of the frames, as a reduced shear.
    on_sky : bool
        Whether v, the responses and the sizes are those on the sky: by a Jacobian.
    """

    v: Array
    response: Array
    snr: Array
    flux: Array
    size: Array
    centroid: Array
    flags: Array
    step: float
    on_sky: bool = False

    @property
    def n_gal(self) -> int:
        """Number of galaxies, measured or not."""
        return int(self.v.shape[0])

    @property
    def measured(self) -> Array:
        """True where the galaxy has a response, shape (n_gal,), bool."""
        return ~has_any(self.flags, int(FAILED))

    def take(self, rows: Array) -> ResponseResult:
        """Return the galaxies with the given row numbers (integer array), in that order."""
        xp = array_namespace(v=self.v, rows=rows)
        arrays = {
            f.name: xp.take(getattr(self, f.name), rows, axis=0)
            for f in fields(self)
            if f.name not in _COMMON
        }
        return ResponseResult(step=self.step, on_sky=self.on_sky, **arrays)

    def to_numpy(self) -> ResponseResult:
        """Return the same result with NumPy arrays, copied to the host."""
        arrays = {
            f.name: to_numpy(getattr(self, f.name)) for f in fields(self) if f.name not in _COMMON
        }
        return ResponseResult(step=self.step, on_sky=self.on_sky, **arrays)

    def to_columns(self) -> dict[str, Array]:
        """Return the scalar columns of `COLUMNS`, each of shape (n_gal,)."""
        columns = {"x": self.centroid[:, 0], "y": self.centroid[:, 1]}
        columns |= {"v1": self.v[:, 0], "v2": self.v[:, 1]}
        for i in (0, 1):
            columns |= {f"R{i + 1}{j + 1}": self.response[:, i, j] for j in (0, 1)}
        for name in QUANTITIES:
            values = getattr(self, name)
            columns |= {f"{name}{suffix}": values[:, k] for k, suffix in enumerate(FRAMES)}
        return columns | {"flags": self.flags}

    def to_table(self) -> Table:
        """Return the result as an `astropy.table.Table`, with units and descriptions.

        `meta["RSTEP"]` is the step, which `shear_from_responses` needs with the columns.
        """
        from astropy.table import Table

        table = Table(self.to_numpy().to_columns())
        for name in table.colnames:
            table[name].unit, table[name].description = COLUMNS[name]
            if self.on_sky and name.startswith("size"):
                table[name].unit = None  # that of the Jacobian, which is not said
        table.meta["RSTEP"] = self.step
        return table


def _columns() -> dict[str, tuple[str | None, str]]:
    seen = {
        "": "as seen",
        "_1p": "with g1 = +h put on",
        "_1m": "with g1 = -h put on",
        "_2p": "with g2 = +h put on",
        "_2m": "with g2 = -h put on",
    }
    columns: dict[str, tuple[str | None, str]] = {
        "x": ("pix", "centroid along columns, 0-based, integer at pixel centres"),
        "y": ("pix", "centroid along rows, 0-based, integer at pixel centres"),
        "v1": (None, "normalised quadrupole, component along x"),
        "v2": (None, "normalised quadrupole, component along the diagonal"),
    }
    for i in "12":
        columns |= {f"R{i}{j}": (None, f"response of v{i} to the reduced shear g{j}") for j in "12"}
    for name, unit, text in (
        ("snr", None, "flux over its error"),
        ("flux", None, "flux of a point under the weight, in units of the image"),
        ("size", "pix", "sigma of the galaxy before the PSF"),
    ):
        columns |= {f"{name}{suffix}": (unit, f"{text}, {seen[suffix]}") for suffix in FRAMES}
    return columns | {"flags": (None, "measurement flags, bits of fdnt_xp.flags.Flag")}


COLUMNS: Final = _columns()
"""Unit and description of every column of `ResponseResult.to_table`."""


def measure_responses(
    stamps: Array,
    psf: Psf,
    *,
    noise_variance: float | Array | None = None,
    noise_power: Array | None = None,
    isotropise: bool | None = None,
    seed: int = 0,
    identifiers: Array | None = None,
    noise_symmetry: Array | None = None,
    mask: Array | None = None,
    masked: Masked = "drop",
    size: float | None = None,
    softening: float = 1.0,
    bound: float = 0.0,
    step: float = STEP,
    jacobian: Array | None = None,
    padding: int = 1,
    chunk_size: int | None = None,
) -> ResponseResult:
    """Measure each galaxy's quadrupole and its response to shear.

    Parameters
    ----------
    stamps, psf, noise_variance, noise_power, isotropise, seed, identifiers, noise_symmetry
        As for `population_null`.
    mask, masked
        As for `population_null`; what is left out is flagged `MASKED`, what was filled
        `FILLED`.
    size, softening, bound, padding, chunk_size
        As for `population_null`, statistic "frozen".
    step : float
        Reduced shear h of the frames, up to 0.1. The differences err by a part of order h².

    jacobian : array, shape (2, 2) or (n_gal, 2, 2), optional
        `d(u, v)/d(x, y)` of the pixels, for all stamps or for each, as for `measure_shapes`: shear,
        weight and noise made round are then those on the sky, `size` and sizes in its unit.

    Returns
    -------
    ResponseResult
        A galaxy that is lost in some of the five frames counts 0 there, and is flagged
        `LOST_IN_FRAME`.

    Raises
    ------
    FdntValueError, RangeError, FdntTypeError, NamespaceError, ShapeMismatchError
        As `population_null`; no stamps at all are allowed.
    """
    if not 0.0 < step <= _LARGEST_STEP:
        raise RangeError("step", step, 0.0, _LARGEST_STEP)
    sample = make_sample(
        stamps,
        psf,
        statistic="frozen",
        weight=None,
        size=size,
        softening=softening,
        bound=bound,
        max_shear=step,
        padding=padding,
        chunk_size=chunk_size,
        noise=NoiseOptions(
            noise_variance=noise_variance,
            noise_power=noise_power,
            isotropise=isotropise,
            seed=seed,
            identifiers=identifiers,
            symmetry=noise_symmetry,
        ),
        mask=mask,
        masked=masked,
        jacobian=jacobian,
    )
    return _result(sample, step)


def _result(sample: FrameSample, step: float) -> ResponseResult:
    """Look at a sample in the five frames."""
    xp = array_namespace(stamps=sample.stamps)
    eta = 2.0 * math.atanh(step)
    # To put shear on is to take the opposite shear off.
    frames = ((0.0, 0.0), (-eta, 0.0), (eta, 0.0), (0.0, -eta), (0.0, eta))
    seen = sample.evaluate(frames)
    flags = _flags(seen)
    measured = ~has_any(flags, int(FAILED))
    slopes = [(seen[1 + 2 * j].v - seen[2 + 2 * j].v) / (2.0 * step) for j in (0, 1)]

    def or_nan(column: Array) -> Array:
        keep = xp.reshape(measured, (-1, *[1] * (column.ndim - 1)))
        return xp.where(keep, column, xp.full_like(column, math.nan))

    quantities = {
        name: or_nan(xp.stack([getattr(one.quantities, name) for one in seen], axis=-1))
        for name in QUANTITIES
    }
    ny, nx = (int(n) for n in sample.stamps.shape[1:])
    middle = xp.asarray(
        [0.5 * (nx - 1), 0.5 * (ny - 1)], dtype=seen[0].v.dtype, device=device_of(seen[0].v)
    )
    return ResponseResult(
        v=or_nan(seen[0].v),
        response=or_nan(xp.stack(slopes, axis=-1)),
        centroid=or_nan(seen[0].centroid + middle),
        flags=flags,
        step=step,
        on_sky=sample.regular is not None,
        **quantities,
    )


def _flags(seen: list[SampleValues]) -> Array:
    """Return why galaxies have no response, and which were lost in some frame."""
    flags = seen[0].flags
    xp = array_namespace(flags=flags)
    n_found = sum((xp.astype(one.found, xp.int32) for one in seen), xp.zeros_like(flags))
    usable = ~has_any(flags, int(FAILED))
    lost = usable & (n_found < len(seen))
    return flags + xp.astype(lost, xp.int32) * int(Flag.LOST_IN_FRAME)
