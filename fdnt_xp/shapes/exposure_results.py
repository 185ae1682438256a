"""What a measurement of many exposures returns: the shapes of objects, and what stamps counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Self

import numpy as np

from fdnt_xp.arrays import Array, array_namespace, device_of, to_numpy
from fdnt_xp.shapes.results import ShapeResult

if TYPE_CHECKING:
    from astropy.table import Table

    from fdnt_xp.shapes.psf_shapes import PsfShapes


@dataclass(frozen=True, kw_only=True)
class ObjectShapes(ShapeResult):
    """Shapes of objects that several exposures show; row i is object i.

    See `ShapeResult` for what is not told here, and `ExposureResult`.

    Parameters
    ----------
    n_exposures, n_used : array, shape (n_obj,), int32
        Stamps that were given, and that count.
    band_flux, band_snr : array, shape (n_obj, n_band), optional
        Flux and S/N in each band; NaN without exposures there.
    """

    n_exposures: Array
    n_used: Array
    band_flux: Array | None = None
    band_snr: Array | None = None


@dataclass(frozen=True, kw_only=True)
class ExposureResult(ObjectShapes):
    """Shapes of objects, each from all of its exposures, and a record of every stamp.

    A `ShapeResult` whose rows are objects: what works on shapes works on it.

    Parameters
    ----------
    eta, eta_cov, eg, size, flags, n_iter, status, masked_fraction
        As in `ShapeResult`, of the object; `size` is that of the weights of all exposures, in
        the unit of the sky, and `masked_fraction` the mean of its stamps.
    centroid : array, shape (n_obj, 2)
        (x, y) on the first of its stamps that counts.
    sky_offset : array, shape (n_obj, 2)
        (u, v) of the centroid from the point that is at `origin` on each stamp.
    flux : array, shape (n_obj,)
        Mean over the exposures by inverse variance, which means something if their images
        are of one scale.
    snr : array, shape (n_obj,)
        That flux over its error; with bands the root of the sum of the squares of theirs.
    n_exposures, n_used, band_flux, band_snr
        As in `ObjectShapes`.
    stamp_flags : array, shape (n_stamp,), int32
        Why a stamp does not count, bits of `fdnt_xp.flags.Flag`; 0 if it does.
    stamp_snr : array, shape (n_stamp,)
        S/N of each exposure, the root of its weight: of t0, the scale of the null tests, at
        a first look; NaN if it did not come to that, or without a noise variance.
    object_index : array, shape (n_stamp,), int64
        Which object each stamp shows.
    """

    stamp_flags: Array
    stamp_snr: Array
    object_index: Array

    @classmethod
    def of(cls, objects: ObjectShapes, **stamps: Array) -> Self:
        """Make it of shapes and the record of the stamps."""
        return cls(**objects.columns(), **stamps)

    @classmethod
    def concat(cls, parts: Sequence[Self]) -> Self:
        """Join results, at least one; their objects and their stamps follow each other."""
        xp = array_namespace(eta=parts[0].eta)
        joined = {
            name: xp.concat([getattr(part, name) for part in parts], axis=0)
            for name in (*parts[0].columns(), "stamp_flags", "stamp_snr")
        }
        firsts = np.cumsum([0, *(part.n_gal for part in parts)])
        index = [part.object_index + int(n) for part, n in zip(parts, firsts, strict=False)]
        return cls(**joined, object_index=xp.concat(index, axis=0))

    @property
    def stamp_used(self) -> Array:
        """True where a stamp counts, shape (n_stamp,), bool."""
        return self.stamp_flags == 0

    def columns(self) -> dict[str, Array]:
        """Return the fields that there are of objects, by name."""
        named = {f.name: getattr(self, f.name) for f in fields(ObjectShapes)}
        return {name: column for name, column in named.items() if column is not None}

    def take(self, rows: Array) -> Self:
        """Return the given objects (integer array), each once, with their stamps.

        The stamps are those of the first object, then those of the next: a host read.
        """
        xp = array_namespace(eta=self.eta, rows=rows)
        index, wanted = to_numpy(self.object_index), to_numpy(rows)
        place = np.full(self.n_gal, -1, dtype=np.int64)
        place[wanted] = np.arange(len(wanted))
        new = place[index]
        stamps = np.argsort(new, kind="stable")[np.count_nonzero(new < 0) :]
        like = {"dtype": xp.int64, "device": device_of(self.eta)}
        chosen = xp.asarray(stamps, **like)
        return type(self)(
            **{name: xp.take(column, rows, axis=0) for name, column in self.columns().items()},
            stamp_flags=xp.take(self.stamp_flags, chosen, axis=0),
            stamp_snr=xp.take(self.stamp_snr, chosen, axis=0),
            object_index=xp.asarray(new[stamps], **like),
        )

    def to_numpy(self) -> Self:
        """Return the same result with NumPy arrays, copied to the host."""
        names = [f.name for f in fields(self) if getattr(self, f.name) is not None]
        return type(self)(**{name: to_numpy(getattr(self, name)) for name in names})

    def to_table(self, psf_shapes: PsfShapes | None = None) -> Table:
        """Return the objects as an `astropy.table.Table`; see `ShapeResult.to_table`.

        There is no `x` and `y`, as no one stamp has the object; bands have `flux_0`, `snr_0`
        and so on.
        """
        table = super().to_table(psf_shapes)
        table.remove_columns(["x", "y"])
        host = self.to_numpy()
        for name, text in (("n_exposures", "stamps given"), ("n_used", "stamps that count")):
            table[name] = getattr(host, name)
            table[name].description = text
        for name in ("flux", "snr"):
            values = getattr(host, f"band_{name}")
            for band in range(0 if values is None else values.shape[1]):
                table[f"{name}_{band}"] = values[:, band]
                table[f"{name}_{band}"].description = f"{name} in band {band}"
        table["u"].description = "centroid from the object's origin on the sky, along u"
        table["v"].description = "centroid from the object's origin on the sky, along v"
        return table
