"""MEDS files as others write them, by astropy alone, of galaxies that GalSim draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

galsim = pytest.importorskip("galsim")

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


SCALE = 0.263
G = np.array([[0.1, 0.0], [-0.2, 0.15], [0.0, 0.0], [0.05, -0.3]])
WCS = [
    galsim.JacobianWCS(SCALE, 0.0, 0.0, SCALE),
    galsim.JacobianWCS(-0.02, SCALE, -0.27, -0.01),
    galsim.JacobianWCS(-SCALE, 0.03, 0.02, 0.25),
]
SIGMA = 1e-5
SMALL, LARGE = 40, 48


def draw(profile, wcs, box, origin=None):
    """Return the image of a profile whose centre is at (x, y) on it, 0-based."""
    offset = np.zeros(2) if origin is None else np.array(origin) - (box - 1) / 2
    image = profile.drawImage(nx=box, ny=box, wcs=wcs, offset=tuple(offset), method="no_pixel")
    return image.array.astype("f8")


def cutout(row, epoch, box=SMALL):
    """Return an exposure of galaxy `row`: flux 1, each epoch with a PSF and pixels of its own."""
    psf = galsim.Gaussian(sigma=1.7 * SCALE).shear(g1=0.05 * epoch, g2=-0.03)
    galaxy = galsim.Gaussian(sigma=2.0 * SCALE).shear(g1=G[row, 0], g2=G[row, 1])
    wcs = WCS[epoch]
    origin = (box / 2 + 0.3 * epoch, box / 2 - 1.2 + 0.4 * row)
    return Cutout(
        image=draw(galsim.Convolve(galaxy, psf), wcs, box, origin),
        psf=draw(psf, wcs, (25, 28, 24)[epoch]),
        row=origin[1],
        col=origin[0],
        jacobian=(wcs.dudy, wcs.dudx, wcs.dvdy, wcs.dvdx),
        weight=np.full((box, box), SIGMA**-2),
        bmask=np.zeros((box, box), dtype="i4"),
        seg=np.full((box, box), 0, dtype="i4"),
    )


def drawn_cutouts():
    """Return galaxies 0 and 3 with three exposures, 1 with two larger ones; 2 has none."""
    return {
        0: [cutout(0, epoch) for epoch in range(3)],
        1: [cutout(1, epoch, LARGE) for epoch in range(2)],
        3: [cutout(3, epoch) for epoch in (1, 0, 2)],
    }


def objects_of(cutouts):
    return [
        MedsObject(id=100 + i, number=i + 1, cutouts=list(cutouts.get(i, []))) for i in range(4)
    ]
