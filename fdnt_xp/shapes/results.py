"""What a shape measurement returns: one row per galaxy, in the library it was asked in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Self

from fdnt_xp.arrays import Array, array_namespace, device_of, has_any, to_numpy
from fdnt_xp.flags import FAILED, Flag
from fdnt_xp.nulltests.dogleg import Status

if TYPE_CHECKING:
    import numpy as np
    from astropy.table import Table

    from fdnt_xp.shapes.psf_shapes import PsfShapes
from fdnt_xp.shear import distortion_from_eta, reduced_shear_from_eta


@dataclass(frozen=True, kw_only=True)
class ShapeResult:
    """Shapes of a batch of galaxies.

    All arrays share one library, dtype and device, that of the stamps; row i is galaxy i.
    Where `flags` holds a bit of `fdnt_xp.flags.FAILED`, the float columns but
    `masked_fraction` are NaN. Where a Jacobian was given, shapes are those on the sky, and
    lengths in its units but for `centroid`.

    Parameters
    ----------
    eta : array, shape (n_gal, 2)
        Conformal shear of the galaxy before the PSF: `a/b = exp(|eta|)`.
    eta_cov : array, shape (n_gal, 2, 2)
        Covariance of `eta` from the pixel noise; NaN if no noise variance was given.
    eg : array, shape (n_gal,)
        Ellipticity gradient EG: the shape responds to shear by `1/(1 - EG)` along its axis.
    centroid : array, shape (n_gal, 2)
        (x, y) in pixels of the stamp, 0-based, integer at pixel centres.
    size : array, shape (n_gal,)
        sigma_g of the Gaussian factor of the weight, in the frame where the galaxy is
        round; in pixels, or in the units of the sky.
    flux : array, shape (n_gal,)
        Amplitude of the best Gaussian galaxy of this size and shape, in units of the image.
    snr : array, shape (n_gal,)
        `flux` over its error at fixed weight; NaN if no noise variance was given.
    flags : array, shape (n_gal,), int32
        Bits of `fdnt_xp.flags.Flag`.
    n_iter : array, shape (n_gal,), int32
        Evaluations of the null tests.
    status : array, shape (n_gal,), int32
        Status of the solver, `fdnt_xp.nulltests.dogleg.Status`.
    masked_fraction : array, shape (n_gal,), optional
        Part of the stamp's pixels that is missing, of galaxies without a shape too. 0 if
        not given.
    sky_offset : array, shape (n_gal, 2), optional
        (u, v) of the centroid from the centre of the stamp, on the sky; None without a
        Jacobian.
    """

    eta: Array
    eta_cov: Array
    eg: Array
    centroid: Array
    size: Array
    flux: Array
    snr: Array
    flags: Array
    n_iter: Array
    status: Array
    masked_fraction: Array = None
    sky_offset: Array | None = None

    def __post_init__(self) -> None:
        if self.masked_fraction is None:
            xp = array_namespace(size=self.size)
            object.__setattr__(self, "masked_fraction", xp.zeros_like(self.size))

    @classmethod
    def unmeasured(cls, stamps: Array) -> ShapeResult:
        """Return NaN and `NO_ATTEMPT` for each stamp, in the stamps' dtype and place."""
        xp = array_namespace(stamps=stamps)
        n_gal = int(stamps.shape[0])
        device = device_of(stamps)

        def nan(*shape: int) -> Array:
            return xp.full((n_gal, *shape), float("nan"), dtype=stamps.dtype, device=device)

        def code(value: int) -> Array:
            return xp.full((n_gal,), value, dtype=xp.int32, device=device)

        return ShapeResult(
            eta=nan(2),
            eta_cov=nan(2, 2),
            eg=nan(),
            centroid=nan(2),
            size=nan(),
            flux=nan(),
            snr=nan(),
            flags=code(int(Flag.NO_ATTEMPT)),
            n_iter=code(0),
            status=code(int(Status.RUNNING)),
            masked_fraction=nan(),
        )

    @classmethod
    def concat(cls, parts: Sequence[Self]) -> Self:
        """Join results, at least one, in the order given."""
        xp = array_namespace(eta=parts[0].eta)
        return cls(
            **{
                name: xp.concat([getattr(part, name) for part in parts], axis=0)
                for name in parts[0].columns()
            }
        )

    @property
    def n_gal(self) -> int:
        """Number of galaxies, measured or not."""
        return int(self.eta.shape[0])

    @property
    def e(self) -> Array:
        """Distortion `e = (a² - b²)/(a² + b²)`, shape (n_gal, 2)."""
        return distortion_from_eta(self.eta)

    @property
    def g(self) -> Array:
        """Reduced shear `g = (a - b)/(a + b)`, shape (n_gal, 2)."""
        return reduced_shear_from_eta(self.eta)

    @property
    def measured(self) -> Array:
        """True where the galaxy has a shape, shape (n_gal,), bool."""
        return ~has_any(self.flags, int(FAILED))

    def take(self, rows: Array) -> Self:
        """Return the galaxies with the given row numbers (integer array), in that order."""
        xp = array_namespace(eta=self.eta, rows=rows)
        return type(self)(
            **{name: xp.take(column, rows, axis=0) for name, column in self.columns().items()}
        )

    def to_numpy(self) -> Self:
        """Return the same result with NumPy arrays, copied to the host."""
        return type(self)(**{name: to_numpy(column) for name, column in self.columns().items()})

    def columns(self) -> dict[str, Array]:
        """Return the fields that there are, by name."""
        named = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: column for name, column in named.items() if column is not None}

    def to_table(self, psf_shapes: PsfShapes | None = None) -> Table:
        """Return the result as an `astropy.table.Table`, with units and descriptions.

        Vectors are spread over scalar columns (`eta1`, `eta2`, ...), as survey catalogs
        have them; `e1`, `g1` and their companions are added, and `u` and `v` where there is
        a `sky_offset`. They and `size` then have no unit: it is that of the Jacobian.

        Parameters
        ----------
        psf_shapes : PsfShapes, optional
            Of the same galaxies, or one for all: `psf_eta1`, `psf_eta2` and `psf_size` are
            added.
        """
        from astropy.table import Table

        host = self.to_numpy()
        columns: dict[str, np.ndarray[Any, Any]] = {
            "x": host.centroid[:, 0],
            "y": host.centroid[:, 1],
            "eta1": host.eta[:, 0],
            "eta2": host.eta[:, 1],
            "eta1_var": host.eta_cov[:, 0, 0],
            "eta2_var": host.eta_cov[:, 1, 1],
            "eta12_cov": host.eta_cov[:, 0, 1],
            "e1": host.e[:, 0],
            "e2": host.e[:, 1],
            "g1": host.g[:, 0],
            "g2": host.g[:, 1],
            "eg": host.eg,
            "size": host.size,
            "flux": host.flux,
            "snr": host.snr,
            "flags": host.flags,
            "n_iter": host.n_iter,
            "status": host.status,
            "masked_fraction": host.masked_fraction,
        }
        described = dict(COLUMNS)
        if host.sky_offset is not None:
            columns["u"], columns["v"] = host.sky_offset[:, 0], host.sky_offset[:, 1]
            described |= SKY_COLUMNS
        if psf_shapes is not None:
            columns |= psf_shapes.columns(self.n_gal)
            described |= PSF_COLUMNS
        table = Table(columns)
        for name, (unit, description) in described.items():
            table[name].unit = unit
            table[name].description = description
        return table


COLUMNS: dict[str, tuple[str | None, str]] = {
    "x": ("pix", "centroid along columns, 0-based, integer at pixel centres"),
    "y": ("pix", "centroid along rows, 0-based, integer at pixel centres"),
    "eta1": (None, "conformal shear, component along x; a/b = exp(|eta|)"),
    "eta2": (None, "conformal shear, component along the diagonal"),
    "eta1_var": (None, "variance of eta1 from pixel noise"),
    "eta2_var": (None, "variance of eta2 from pixel noise"),
    "eta12_cov": (None, "covariance of eta1 and eta2 from pixel noise"),
    "e1": (None, "distortion (a^2-b^2)/(a^2+b^2), component 1"),
    "e2": (None, "distortion, component 2"),
    "g1": (None, "reduced shear (a-b)/(a+b), component 1"),
    "g2": (None, "reduced shear, component 2"),
    "eg": (None, "ellipticity gradient: response to shear along the axis is 1/(1 - eg)"),
    "size": ("pix", "sigma of the Gaussian factor of the weight"),
    "flux": (None, "flux of the matched Gaussian galaxy, in units of the image"),
    "snr": (None, "flux over its error at fixed weight"),
    "flags": (None, "measurement flags, bits of fdnt_xp.flags.Flag"),
    "n_iter": (None, "evaluations of the null tests"),
    "status": (None, "status of the solver"),
    "masked_fraction": (None, "part of the stamp's pixels that is missing"),
}
"""Unit and description of every column of `ShapeResult.to_table`."""

SKY_COLUMNS: dict[str, tuple[str | None, str]] = {
    "size": (None, "sigma of the Gaussian factor of the weight, on the sky"),
    "u": (None, "offset of the centroid from the centre of the stamp on the sky, along u"),
    "v": (None, "offset of the centroid from the centre of the stamp on the sky, along v"),
}
"""Those that a Jacobian adds or changes; lengths are in its units."""

PSF_COLUMNS: dict[str, tuple[str | None, str]] = {
    "psf_eta1": (None, "conformal shear of the PSF, pixel response included, component 1"),
    "psf_eta2": (None, "conformal shear of the PSF, pixel response included, component 2"),
    "psf_size": (None, "sigma of the weight matched to the PSF, in the unit of size"),
}
"""Those of `fdnt_xp.shapes.psf_shapes.PsfShapes`."""
