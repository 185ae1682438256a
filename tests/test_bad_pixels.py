"""The same bad pixels through every input are missing, or flag the galaxy, in the same way."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits

import fdnt_xp as fx
from fdnt_xp.data.adapters import exposure_from_galsim, exposures_from_observations
from fdnt_xp.data.exposures import ExposureBatch
from fdnt_xp.data.images import read_image
from fdnt_xp.data.ivar import IvarSource
from fdnt_xp.data.meds import open_meds
from fdnt_xp.data.stamps import cube_stamps
from fdnt_xp.flags import Flag
from images import galaxies, star
from meds_files import Cutout, MedsObject, write_meds

galsim = pytest.importorskip("galsim")
h5py = pytest.importorskip("h5py")

CELL = 32
IVAR = 1e10
AT = (CELL // 2, CELL // 2)
FAR = (3, 4)


def through_files(write, image, weight, mask):
    """Return stamps and inverse variances as `fdnt-xp measure` makes them."""
    sources = {}
    for what, pixels in (("image", image), ("weight", weight), ("mask", mask)):
        source = cube_stamps(read_image(write(what, pixels), ndim=(3,)))
        sources[what] = source if what == "image" else sources["image"].beside(source.pixels, what)
    chunk = sources["image"].read(0, 1)
    ivar = IvarSource(mask=sources["mask"], weight=sources["weight"]).read(chunk)
    return chunk.stamps, ivar


def through_fits(folder, *pixels):
    def write(what, cube):
        fits.PrimaryHDU(cube[None]).writeto(folder / f"{what}.fits")
        return folder / f"{what}.fits"

    return through_files(write, *pixels)


def through_hdf5(folder, *pixels):
    def write(what, cube):
        with h5py.File(folder / "all.h5", "a") as file:
            file[what] = cube[None]
        return f"{folder / 'all.h5'}::{what}"

    return through_files(write, *pixels)


def through_meds(folder, image, weight, mask):
    cutout = Cutout(
        image=image,
        psf=star((CELL, CELL)),
        row=15.5,
        col=15.5,
        jacobian=(0, 1, 1, 0),
        weight=weight,
        bmask=mask,
    )
    with open_meds(write_meds(folder / "m.fits", [MedsObject(id=1, cutouts=[cutout])])) as meds:
        batch = meds.read(np.array([0]))
    return batch.stamps, batch.ivar


def through_galsim(_folder, image, weight, mask):
    one = exposure_from_galsim(
        galsim.Image(image), star((CELL, CELL)), weight=galsim.Image(weight), mask=mask
    )
    batch = ExposureBatch.of([[one]])
    return batch.stamps, batch.ivar


def through_observations(_folder, image, weight, mask):
    slopes = {"dudrow": 0.0, "dudcol": 1.0, "dvdrow": 1.0, "dvdcol": 0.0}
    one = SimpleNamespace(
        image=image,
        weight=weight,
        bmask=mask,
        jacobian=SimpleNamespace(row0=15.5, col0=15.5, **slopes),
        psf=SimpleNamespace(image=star((CELL, CELL))),
    )
    batch = ExposureBatch.of([exposures_from_observations(one)])
    return batch.stamps, batch.ivar


INPUTS = [through_fits, through_hdf5, through_meds, through_galsim, through_observations]
CASES = {
    # name: (image, weight, mask) at a pixel, the inverse variance there, and the flags of the
    # methods "ft", "hybrid" and "gl".
    "good": ((None, IVAR, 0), IVAR, (0, 0, 0)),
    "weight 0": ((None, 0.0, 0), 0.0, (Flag.MASKED, Flag.FILLED, 0)),
    "a bit of the mask": ((None, IVAR, 64), 0.0, (Flag.MASKED, Flag.FILLED, 0)),
    "NaN that is masked": ((np.nan, IVAR, 1), 0.0, (Flag.MASKED, Flag.FILLED, 0)),
    "NaN of weight 0": ((np.nan, 0.0, 0), 0.0, (Flag.MASKED, Flag.FILLED, 0)),
    "bad weight that is masked": ((None, np.nan, 2), 0.0, (Flag.MASKED, Flag.FILLED, 0)),
    "NaN": ((np.nan, IVAR, 0), IVAR, (Flag.NON_FINITE_PIXEL,) * 3),
    "infinity": ((np.inf, IVAR, 0), IVAR, (Flag.NON_FINITE_PIXEL,) * 3),
    "NaN as weight": ((None, np.nan, 0), np.nan, (Flag.NON_FINITE_PIXEL,) * 3),
    "negative weight": ((None, -1.0, 0), -1.0, (Flag.NON_FINITE_PIXEL,) * 3),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_pixels_are_the_same_for_all(case, tmp_path):
    (value, weight_there, bits), expected, flags = CASES[case]
    image = galaxies(np.array([[0.2, -0.1]]), (CELL, CELL))[0]
    weight, mask = np.full(image.shape, IVAR), np.zeros(image.shape, dtype="i4")
    place = AT if expected == 0.0 else FAR
    image[place] = image[place] if value is None else value
    weight[place], mask[place] = weight_there, bits
    stamps = []
    for number, through in enumerate(INPUTS):
        folder = tmp_path / str(number)
        folder.mkdir()
        pixels, ivar = through(folder, image, weight, mask)
        np.testing.assert_array_equal(pixels[0], image)
        wanted = np.full(image.shape, IVAR)
        wanted[place] = expected
        np.testing.assert_array_equal(ivar[0], wanted)
        stamps.append((pixels, ivar))
    pixels, ivar = stamps[0]
    psf = fx.Psf.from_image(star((CELL, CELL)))
    for transform, flag in zip(("ft", "hybrid", "gl"), flags, strict=True):
        shapes = fx.measure_shapes(pixels, psf, ivar=ivar, transform=transform, order=8)
        assert shapes.flags.tolist() == [int(flag)], transform
