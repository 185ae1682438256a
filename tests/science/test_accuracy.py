"""Shapes without noise, to the bounds of docs/accuracy.md; NumPy, float64."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

import fdnt_xp as fx
from science.galsim_images import (
    ACCURATE_AIRY,
    GREAT08_PSF,
    psf_image,
    relative_error,
    sersic_stamps,
)


def gaussian_psf(half_light_radius):
    psf = galsim.Gaussian(half_light_radius=half_light_radius)
    return psf.shear(e=0.14, beta=28.6 * galsim.degrees)


def measure(stamps, psf, **options):
    shapes = fx.measure_shapes(stamps, psf, **options)
    assert np.all(shapes.measured)
    return shapes


@pytest.mark.parametrize(("ratio", "bound"), [(0.5, 1e-6), (1.0, 1e-6), (2.0, 3e-5)])
def test_gaussian_psf(ratio, bound):
    psf = gaussian_psf(3.0 * ratio)
    stamps, e = sersic_stamps(psf, "no_pixel")
    shapes = measure(stamps, fx.Psf.from_image(psf_image(psf, "no_pixel"), floor=1e-6))
    assert np.max(relative_error(shapes.e, e)) <= bound


@pytest.mark.parametrize(
    "psf",
    [galsim.Moffat(beta=3, fwhm=4), galsim.Kolmogorov(fwhm=3.5)],
    ids=["moffat", "kolmogorov"],
)
def test_ground_based_psf_with_pixel(psf):
    stamps, e = sersic_stamps(psf, "auto")
    shapes = measure(stamps, fx.Psf.from_image(psf_image(psf, "auto"), floor=1e-6))
    assert np.max(relative_error(shapes.e, e)) <= 1e-5


@pytest.mark.parametrize(("padding", "bound"), [(1, 2e-5), (2, 5e-6)])
def test_airy_psf_with_pixel(padding, bound):
    # Its wings reach past the stamp; what that costs goes down with a finer k grid.
    psf = galsim.Airy(lam_over_diam=2.5, obscuration=0.3)
    stamps, e = sersic_stamps(psf, "auto", gsparams=ACCURATE_AIRY)
    star = fx.Psf.from_image(psf_image(psf, "auto", gsparams=ACCURATE_AIRY), floor=1e-6)
    shapes = measure(stamps, star, padding=padding)
    assert np.max(relative_error(shapes.e, e)) <= bound


def test_airy_psf_and_galaxies_along_a_side_of_the_stamp():
    # The stamp cuts the wings of the most elongated; the finer grid sees that it does.
    psf = galsim.Airy(lam_over_diam=2.5, obscuration=0.3)
    stamps, e = sersic_stamps(psf, "auto", sersic=(0.5,), angle=3.0, gsparams=ACCURATE_AIRY)
    star = fx.Psf.from_image(psf_image(psf, "auto", gsparams=ACCURATE_AIRY), floor=1e-6)
    assert 4e-5 < np.max(relative_error(measure(stamps, star).e, e)) < 7e-5
    assert np.max(relative_error(measure(stamps, star, padding=2).e, e)) <= 2e-6


def test_great08_psf_sampled_finely():
    # The star is undersampled; drawn four times finer its transform is not aliased.
    with_pixel = galsim.Convolve([GREAT08_PSF, galsim.Pixel(1.0)])
    fine = with_pixel.drawImage(nx=256, ny=256, scale=0.25, method="no_pixel", dtype=float)
    stamps, e = sersic_stamps(GREAT08_PSF, "auto")
    shapes = measure(stamps, fx.Psf.from_image(fine.array, oversampling=4, floor=1e-6))
    assert np.max(relative_error(shapes.e, e)) <= 1e-4


def test_great08_psf_sampled_as_it_is():
    # Limited by aliasing of the star: 4e-4, but for n = 4 at e = 0.1, where the same
    # absolute error (5e-5, along the PSF) is a larger part of e.
    stamps, e = sersic_stamps(GREAT08_PSF, "auto")
    shapes = measure(stamps, fx.Psf.from_image(psf_image(GREAT08_PSF, "auto"), floor=1e-6))
    error = relative_error(shapes.e, e).reshape(4, 4)
    assert np.max(error[:3, :]) <= 4e-4
    assert np.max(error[3, 1:]) <= 4e-4
    assert error[3, 0] <= 6e-4


def test_centroids_and_both_parities():
    psf = gaussian_psf(3.0)
    star = fx.Psf.from_image(psf_image(psf, "no_pixel"))
    galaxy = galsim.Sersic(1.0, half_light_radius=3.0).shear(e1=0.2, e2=0.3).shift(1.3, -2.1)
    both = galsim.Convolve([galaxy, psf])
    for ny, nx in ((96, 96), (95, 95), (96, 95), (81, 120)):
        drawn = both.drawImage(nx=nx, ny=ny, scale=1.0, method="no_pixel", dtype=float)
        shapes = measure(drawn.array[None], star)
        expected = [[0.5 * (nx - 1) + 1.3, 0.5 * (ny - 1) - 2.1]]
        np.testing.assert_allclose(shapes.centroid, expected, atol=1e-4)
        np.testing.assert_allclose(shapes.e, [[0.2, 0.3]], atol=2e-6)


# --- the same answer another way -----------------------------------------------------


@pytest.fixture(scope="module")
def moffat_galaxies():
    psf = galsim.Moffat(beta=3, fwhm=4)
    stamps, _ = sersic_stamps(psf, "auto", sersic=(1.0, 4.0), n=64)
    image = psf_image(psf, "auto", n=64)
    return stamps, image, measure(stamps, fx.Psf.from_image(image)).eta


@pytest.mark.parametrize("factor", [7.3, 1e-12, 1e9])
def test_normalisation_of_the_psf_does_not_matter(factor, moffat_galaxies):
    stamps, image, eta = moffat_galaxies
    again = measure(stamps, fx.Psf.from_image(factor * image)).eta
    assert np.max(np.abs(again - eta)) < 1e-10


@pytest.mark.parametrize("factor", [1e-9, 3e7])
def test_units_of_the_image_do_not_matter(factor, moffat_galaxies):
    stamps, image, eta = moffat_galaxies
    again = measure(factor * stamps, fx.Psf.from_image(image)).eta
    assert np.max(np.abs(again - eta)) < 1e-10


@pytest.mark.parametrize("offset", [(0.5, 0.5), (-0.31, 0.17), (0.02, -0.49)])
@pytest.mark.parametrize("n", [64, 101, 200])
def test_where_and_how_large_the_star_is_drawn_does_not_matter(offset, n):
    psf = gaussian_psf(3.0)
    stamps, _ = sersic_stamps(psf, "no_pixel", sersic=(1.0,))
    eta = measure(stamps, fx.Psf.from_image(psf_image(psf, "no_pixel"))).eta
    drawn = psf.drawImage(nx=n, ny=n, scale=1.0, method="no_pixel", dtype=float, offset=offset)
    again = measure(stamps, fx.Psf.from_image(drawn.array)).eta
    assert np.max(np.abs(again - eta)) < 1e-6


def test_the_star_may_be_finer_than_the_galaxies():
    psf = galsim.Kolmogorov(fwhm=3.5)
    stamps, e = sersic_stamps(psf, "auto", sersic=(1.0,))
    with_pixel = galsim.Convolve([psf, galsim.Pixel(1.0)])
    fine = with_pixel.drawImage(nx=300, ny=300, scale=1.0 / 3.0, method="no_pixel", dtype=float)
    shapes = measure(stamps, fx.Psf.from_image(fine.array, oversampling=3))
    assert np.max(relative_error(shapes.e, e)) <= 1e-5


def test_the_test_can_fail():
    # Half the PSF's ellipticity left out must be seen.
    psf = gaussian_psf(3.0)
    stamps, e = sersic_stamps(psf, "no_pixel", sersic=(1.0,))
    rounder = galsim.Gaussian(half_light_radius=3.0)
    wrong = fx.measure_shapes(stamps, fx.Psf.from_image(psf_image(rounder, "no_pixel")))
    assert np.min(relative_error(wrong.e, e)) > 1e-2
