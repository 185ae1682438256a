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
    np.testing.assert_allclose(shapes.sky_offset, [[0.06, -0.05]] * len(JACOBIANS), atol=1e-10)
    np.testing.assert_allclose(shapes.size, shapes.size[0], rtol=1e-6)
    np.testing.assert_allclose(shapes.eg - shapes.eg[0], 0.0, atol=2e-6)
    if name == "exponential":
        np.testing.assert_allclose(shapes.e, [[0.3, 0.2]] * len(JACOBIANS), atol=1e-6)
    else:
        assert abs(shapes.eg[0]) > 0.01  # there is a gradient


G = (0.03, -0.02)
N_ANGLES = 8


@pytest.fixture(scope="module")
def rings():
    """Return half a turn of the galaxy with a gradient, sheared, through each of the Jacobians.

    Stamps (n_jacobian, n_angle, ny, nx), and the stars.
    """
    psf = galsim.Gaussian(half_light_radius=0.5, gsparams=ACCURATE).shear(e1=0.1, e2=0.08)
    galaxy = galaxies()["gradient"]
    seen = []
    for angle in np.arange(N_ANGLES) * (180.0 / N_ANGLES):
        lensed = galaxy.rotate(angle * galsim.degrees).shear(g1=G[0], g2=G[1]).shift(0.06, -0.05)
        seen.append(galsim.Convolve([lensed, psf], gsparams=ACCURATE))
    stamps = np.stack([[draw(one, j, 96) for one in seen] for j in JACOBIANS])
    return stamps, np.stack([draw(psf, j, 96) for j in JACOBIANS])


@pytest.mark.parametrize("number", range(len(JACOBIANS)))
def test_the_shear_of_a_ring_is_that_on_the_sky(number, rings):
    stamps, psf = rings[0][number], fx.Psf.from_image(rings[1][number])
    for statistic in ("frozen", "eta"):
        null = fx.population_null(stamps, psf, jacobian=JACOBIANS[number], statistic=statistic)
        np.testing.assert_allclose(null.g, G, atol=1e-7)
    stack = fx.shear_from_stack(stamps, psf, jacobian=JACOBIANS[number])
    np.testing.assert_allclose(stack.g, G, atol=1e-6)
    on_pixels = fx.population_null(stamps, psf)
    if number in (1, 2, 3, 4, 5):  # mirrored, turned, sheared, not square
        assert np.max(np.abs(on_pixels.g - G)) > 0.01


def test_responses_do_not_depend_on_the_pixels(rings):
    seen = [
        fx.measure_responses(stamps, fx.Psf.from_image(star), jacobian=j, size=0.6)
        for stamps, star, j in zip(*rings, JACOBIANS, strict=True)
    ]
    for one in seen[1:]:
        # Jacobians are rounded to 1/8192 for the weights: a part in 10^5 of v, the same for all.
        np.testing.assert_allclose(one.v, seen[0].v, atol=3e-6)
        np.testing.assert_allclose(one.response, seen[0].response, atol=3e-5)
        np.testing.assert_allclose(one.size, seen[0].size, rtol=3e-5)
    middle = [[0.06, -0.05]]
    for one, j in zip(seen, JACOBIANS, strict=True):
        # The galaxy looks the same upside down: its centroid follows the shear.
        np.testing.assert_allclose((one.centroid - 47.5) @ j.T, middle * N_ANGLES, atol=1e-5)


def test_galaxies_each_behind_pixels_of_its_own(rings):
    stamps, stars = rings
    # All angles through all Jacobians; and one Jacobian for each angle, a ring only on the sky.
    which = np.repeat(np.arange(len(JACOBIANS)), N_ANGLES)
    psf = fx.Psf.from_image(stars, psf_index=which)
    every = stamps.reshape(-1, *stamps.shape[2:])
    null = fx.population_null(every, psf, jacobian=JACOBIANS[which])
    np.testing.assert_allclose(null.g, G, atol=1e-7)
    some = np.arange(N_ANGLES) % len(JACOBIANS)
    mixed = stamps[some, np.arange(N_ANGLES)]
    psf = fx.Psf.from_image(stars, psf_index=some)
    for statistic in ("frozen", "eta"):
        null = fx.population_null(mixed, psf, jacobian=JACOBIANS[some], statistic=statistic)
        # No angle has the weight of another, by what Jacobians are rounded to: 1/2048.
        np.testing.assert_allclose(null.g, G, atol=5e-6)


@pytest.mark.parametrize("centroids", [False, True])
def test_a_stack_of_galaxies_each_behind_pixels_of_its_own(centroids, rings):
    stamps, stars = rings
    some = np.arange(N_ANGLES) % len(JACOBIANS)
    mixed = stamps[some, np.arange(N_ANGLES)]
    psf = fx.Psf.from_image(stars, psf_index=some)
    options = {}
    if centroids:
        there = np.linalg.solve(JACOBIANS[some], np.tile([0.06, -0.05], (N_ANGLES, 1))[..., None])
        options = {"centroids": 47.5 + there[..., 0]}
    stack = fx.shear_from_stack(mixed, psf, jacobian=JACOBIANS[some], **options)
    np.testing.assert_allclose(stack.g, G, atol=1e-6)
    assert (stack.n_used, stack.n_excluded) == (N_ANGLES, 0)
    parts = fx.shear_from_stack(mixed, psf, jacobian=JACOBIANS[some], chunk_size=3, **options)
    np.testing.assert_allclose(parts.g, stack.g, atol=1e-9)


def test_jacobians_that_are_all_alike_stack_as_one_does(rings):
    stamps, stars = rings
    psf, jacobian = fx.Psf.from_image(stars[3]), JACOBIANS[3]
    one = fx.shear_from_stack(stamps[3], psf, jacobian=jacobian, n_groups=8)
    each = fx.shear_from_stack(stamps[3], psf, jacobian=np.stack([jacobian] * N_ANGLES), n_groups=8)
    np.testing.assert_allclose(each.g, one.g, atol=1e-7)
    # The jackknife by one step of Newton, not to the end.
    np.testing.assert_allclose(each.g_err, one.g_err, rtol=0.05)


def test_noise_makes_no_bias_through_sheared_pixels():
    # Galaxies and their turned copies, the same noise with either sign, for +g and -g.
    n_gal, times, size, g = 64, 6, 40, 0.02
    jacobian = SCALE * turn(0.5) @ np.array([[1.1, 0.12], [0.02, 0.9]]) @ np.diag([-1.0, 1.0])
    psf = galsim.Moffat(beta=3, fwhm=2.85 * SCALE).shear(e1=0.1, e2=0.05)
    rng = np.random.default_rng(12)
    clean = np.empty((2, 2, n_gal, size, size))
    wcs = galsim.JacobianWCS(*jacobian.ravel())
    for row in range(n_gal):
        shape = galsim.Shear(g=0.4 * rng.random(), beta=rng.random() * np.pi * galsim.radians)
        for turned, intrinsic in enumerate((shape, -shape)):
            galaxy = galsim.Exponential(half_light_radius=1.6 * SCALE).shear(intrinsic)
            for minus, sign in enumerate((1.0, -1.0)):
                seen = galsim.Convolve([galaxy.shear(g1=sign * g, g2=0.0), psf])
                image = seen.drawImage(nx=size, ny=size, wcs=wcs, dtype=float)
                clean[minus, turned, row] = image.array
    star = psf.drawImage(nx=size, ny=size, wcs=wcs, dtype=float).array
    psf = fx.Psf.from_image(star)
    sigma = np.sqrt(np.mean(np.sum(clean**2, axis=(-1, -2)))) / 20.0
    shears = []
    for number in range(times):
        noise = sigma * rng.standard_normal((n_gal, size, size))
        for one in clean:
            stamps = np.concatenate(
                [one[0] + noise, one[1] + noise, one[0] - noise, one[1] - noise]
            )
            null = fx.population_null(
                stamps,
                psf,
                jacobian=jacobian,
                noise_variance=sigma**2,
                identifiers=np.tile(np.arange(n_gal) + n_gal * number, 4),
                noise_symmetry=np.repeat([0, 0, 4, 4], n_gal),
            )
            shears.append(null.g)
    shears = np.reshape(shears, (times, 2, 2))
    m = (shears[:, 0, 0] - shears[:, 1, 0]) / (2.0 * g) - 1.0
    c = np.mean(shears, axis=1)
    for value, most in ((m, 0.01), (c[:, 0], 2e-3), (c[:, 1], 2e-3)):
        error = np.std(value, ddof=1) / np.sqrt(times)
        assert error < most
        assert abs(np.mean(value)) < 4.0 * error  # Student's t: once in 200 times


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
