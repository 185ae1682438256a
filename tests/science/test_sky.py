"""The same GalSim galaxies through several Jacobians, with and without ellipticity gradient."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

import fdnt_xp as fx
from fdnt_xp.shear import eta_from_matrix, shear_matrix
from science.galsim_images import ACCURATE

SCALE = 0.2


def turn(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


JACOBIANS = SCALE * np.stack(
    [
        np.eye(2),
        np.diag([-1.0, 1.0]),
        turn(0.7),
        np.array([[1.05, 0.08], [0.06, 0.96]]),
        np.diag([1.2, 0.85]),
        turn(2.0) @ np.diag([-1.0, 1.0]) @ np.array([[1.1, 0.1], [0.0, 0.93]]),
        1.2 * np.eye(2),
    ]
)


def galaxies():
    """Return an exponential, and a bulge and disc whose shapes differ (SPEC's first galaxy)."""
    bulge = galsim.Sersic(1.5, half_light_radius=0.3, gsparams=ACCURATE).shear(e1=0.05)
    disc = galsim.Exponential(half_light_radius=0.9, gsparams=ACCURATE)
    both = 0.2 * bulge + 0.8 * disc.shear(e=0.3, beta=20 * galsim.degrees)
    plain = galsim.Exponential(half_light_radius=0.6, gsparams=ACCURATE).shear(e1=0.3, e2=0.2)
    return {"exponential": plain, "gradient": both}


def draw(profile, jacobian, n=128):
    # Without the pixel: through other pixels it would be another PSF, and another weight.
    wcs = galsim.JacobianWCS(*jacobian.ravel())
    return profile.drawImage(nx=n, ny=n, wcs=wcs, method="no_pixel", dtype=float).array


@pytest.fixture(scope="module")
def drawn():
    """Return the stamps of each galaxy through each of the Jacobians, and the PSFs."""
    psf = galsim.Gaussian(half_light_radius=0.5, gsparams=ACCURATE).shear(e1=0.1, e2=0.08)
    stars = np.stack([draw(psf, j) for j in JACOBIANS])
    stamps = {}
    for name, galaxy in galaxies().items():
        seen = galsim.Convolve([galaxy.shift(0.06, -0.05), psf], gsparams=ACCURATE)
        stamps[name] = np.stack([draw(seen, j) for j in JACOBIANS])
    return stamps, fx.Psf.from_image(stars)


@pytest.mark.parametrize("name", ["exponential", "gradient"])
def test_a_galaxy_has_one_shape_through_any_pixels(name, drawn):
    shapes = fx.measure_shapes(drawn[0][name], drawn[1], jacobian=JACOBIANS)
    assert np.all(shapes.measured)
    # Sums over other modes of the sky: 6e-8. Jacobians rounded for the weights: 2e-7.
    np.testing.assert_allclose(shapes.eta - shapes.eta[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(shapes.sky_offset, [[0.06, -0.05]] * len(JACOBIANS), atol=1e-5)
    # The size is matched by a table, to 3e-6, in the units of each kind of pixel.
    np.testing.assert_allclose(shapes.size, shapes.size[0], rtol=1e-4)
    np.testing.assert_allclose(shapes.eg - shapes.eg[0], 0.0, atol=1e-5)
    if name == "exponential":
        np.testing.assert_allclose(shapes.e, [[0.3, 0.2]] * len(JACOBIANS), atol=1e-6)
    else:
        assert abs(shapes.eg[0]) > 0.01  # there is a gradient


def test_moving_the_shape_of_the_pixels_is_not_the_same(drawn):
    # The map of a shape measured on the pixels holds for round profiles alone: a weight that
    # is round on the pixels sees core and outskirts otherwise. This is what the above is for.
    stamps, psf = drawn
    pixels = fx.measure_shapes(stamps["gradient"], psf)
    unit = JACOBIANS / np.sqrt(np.abs(np.linalg.det(JACOBIANS)))[:, None, None]
    moved = eta_from_matrix(unit @ shear_matrix(pixels.eta))
    error = np.max(np.abs(moved - moved[0]), axis=1)
    assert np.all(error[[1, 2, 6]] < 1e-6)  # mirrored, turned, larger
    assert error[3] > 1e-3  # sheared
    assert error[5] > 1e-3
