"""MEDS files as others write them, by astropy alone, from the page of the format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

_EMPTY = -9999


@dataclass(kw_only=True)
class Cutout:
    """One cutout: `jacobian` is dudrow, dudcol, dvdrow, dvdcol; row and col are of the object."""

    image: np.ndarray
    psf: np.ndarray
    row: float
    col: float
    jacobian: tuple[float, float, float, float]
    weight: np.ndarray | None = None
    bmask: np.ndarray | None = None
    seg: np.ndarray | None = None


@dataclass(kw_only=True)
class MedsObject:
    """An object and its cutouts, all of one size; `number` is that of the segmentation map."""

    id: int
    cutouts: list[Cutout] = field(default_factory=list)
    number: int = 0


def write_meds(path: Path, objects: Sequence[MedsObject], **changes: Any) -> Path:
    """Write a MEDS file with PSFs; `changes` replace or (None) remove columns of the table."""
    widest = 2 + max((len(one.cutouts) for one in objects), default=0)
    data: dict[str, np.ndarray] = {
        "id": np.array([one.id for one in objects]),
        "number": np.array([one.number for one in objects]),
        "ncutout": np.array([len(one.cutouts) for one in objects]),
        "box_size": np.array([len(o.cutouts[0].image) if o.cutouts else 32 for o in objects]),
    }
    per_cutout = ("start_row", "psf_start_row", "psf_row_size", "psf_col_size")
    per_cutout += ("cutout_row", "cutout_col", "dudrow", "dudcol", "dvdrow", "dvdcol")
    for name in per_cutout:
        dtype = "i8" if "start" in name or "size" in name else "f8"
        data[name] = np.full((len(objects), widest), _EMPTY, dtype=dtype)
    planes: dict[str, list[np.ndarray]] = {}
    length = {"image": 0, "psf": 0}
    for i, one in enumerate(objects):
        for j, cutout in enumerate(one.cutouts):
            values = (length["image"], length["psf"], *cutout.psf.shape, cutout.row, cutout.col)
            for name, value in zip(per_cutout, (*values, *cutout.jacobian), strict=True):
                data[name][i, j] = value
            length["image"] += cutout.image.size
            length["psf"] += cutout.psf.size
            for name in ("image", "psf", "weight", "bmask", "seg"):
                if getattr(cutout, name) is not None:
                    planes.setdefault(name, []).append(getattr(cutout, name))
    data |= changes
    columns = [
        fits.Column(
            name,
            format=f"{values.size // max(len(values), 1)}{'D' if values.dtype == 'f8' else 'K'}",
            array=values,
        )
        for name, values in data.items()
        if values is not None
    ]
    hdus = [fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns, name="object_data")]
    for name, parts in planes.items():
        flat = np.concatenate([part.reshape(-1) for part in parts])
        hdus.append(fits.ImageHDU(flat, name="psf" if name == "psf" else f"{name}_cutouts"))
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path
