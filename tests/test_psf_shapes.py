"""Shape and size of the PSF beside those of the galaxies."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.errors import FdntTypeError, ShapeMismatchError
from fdnt_xp.shapes.psf_shapes import measure_psf_shapes
from fdnt_xp.shapes.results import PSF_COLUMNS
from fdnt_xp.shear import eta_from_distortion
from images import galaxies, gaussian_covariance, gaussian_image
from tolerances import tolerance

E = np.array([[0.1, -0.06], [-0.2, 0.15], [0.0, 0.0]])
SIGMA = (1.8, 2.0, 2.2)


def covariances():
    return [gaussian_covariance(tuple(e), s) for e, s in zip(E, SIGMA, strict=True)]


def stars(oversampling=1.0, jacobian=None):
    inverse = np.linalg.inv(np.eye(2) if jacobian is None else jacobian) * oversampling
    n = int(48 * oversampling)
    return np.stack([gaussian_image(inverse @ c @ inverse.T, (n, n)) for c in covariances()])


SIZES = SIGMA * (1.0 - np.sum(E**2, axis=1)) ** 0.25
ETA = eta_from_distortion(E)


def test_gaussian_stars(xp, dtype, to_xp):
    found = measure_psf_shapes(fx.Psf.from_image(to_xp(stars(), dtype)))
    assert_close(found.eta, to_xp(ETA, dtype), **tolerance("shapes", dtype), xp=xp)
    assert_close(found.size, to_xp(SIZES, dtype), **tolerance("sizes", dtype), xp=xp)


def test_in_pixels_of_the_galaxies():
    found = measure_psf_shapes(fx.Psf.from_image(stars(2.0), oversampling=2.0))
    np.testing.assert_allclose(found.eta, ETA, atol=2e-6)
    np.testing.assert_allclose(found.size, SIZES, rtol=2e-3)


def test_on_the_sky():
    j = np.array([[0.1, 1.0], [-1.1, 0.05]])
    for jacobian in (j, np.stack([j, j, j])):
        found = measure_psf_shapes(fx.Psf.from_image(stars(1.0, j)), jacobian=jacobian)
        np.testing.assert_allclose(found.eta, ETA, atol=2e-6)
        np.testing.assert_allclose(found.size, SIZES, rtol=2e-3)
    # One star for galaxies on pixels of three sizes, the last of which are none.
    many = np.stack([np.eye(2), 2.0 * np.eye(2), np.zeros((2, 2))])
    found = measure_psf_shapes(fx.Psf.from_image(stars()[0]), jacobian=many)
    np.testing.assert_allclose(found.eta[:2], ETA[[0, 0]], atol=2e-6)
    np.testing.assert_allclose(found.size[1], 2.0 * found.size[0], rtol=1e-12)
    assert np.all(np.isnan(found.eta[2]))
    assert np.isnan(found.size[2])


def test_shared_and_unusable_stars():
    images = stars()
    images[1, 4, 4] = np.nan
    found = measure_psf_shapes(fx.Psf.from_image(images, psf_index=np.array([2, 0, 1, 0])))
    np.testing.assert_allclose(found.eta[[0, 1, 3]], ETA[[2, 0, 0]], atol=2e-6)
    assert np.all(np.isnan(found.eta[2]))
    assert np.isnan(found.size[2])


def test_columns_of_the_table():
    psf = fx.Psf.from_image(stars()[0])
    shapes = fx.measure_shapes(galaxies(E), psf)
    table = shapes.to_table(measure_psf_shapes(psf))
    np.testing.assert_allclose(table["psf_eta1"], ETA[0, 0], atol=2e-6)
    np.testing.assert_allclose(table["psf_eta2"], ETA[0, 1], atol=2e-6)
    np.testing.assert_allclose(table["psf_size"], SIZES[0], rtol=2e-3)
    assert all(table[name].description for name in PSF_COLUMNS)
    assert not set(PSF_COLUMNS) & set(shapes.to_table().colnames)


def test_calls_that_mean_nothing():
    with pytest.raises(FdntTypeError, match="psf must be a Psf"):
        measure_psf_shapes(stars())
    psf = fx.Psf.from_image(stars())
    with pytest.raises(ShapeMismatchError, match="jacobian"):
        measure_psf_shapes(psf, jacobian=np.ones((2, 2, 2)))
    shapes = fx.measure_shapes(galaxies(E[:2]), fx.Psf.from_image(stars()[0]))
    with pytest.raises(ShapeMismatchError, match="psf_shapes are of 3 galaxies, but there are 2"):
        shapes.to_table(measure_psf_shapes(psf))
