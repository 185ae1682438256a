"""The shear of a stack: galaxies of any shape, any centroid, many PSFs, and bad stamps."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.errors import (
    FdntTypeError,
    FdntValueError,
    FdntWarning,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.shear import add_shears, distortion_from_eta, eta_from_reduced_shear, shear_matrix
from images import PSF_COVARIANCE, gaussian_covariance, gaussian_image, star

SIDE = 48


def covariance_of(eta, sigma):
    """Return the covariance of a round Gaussian that is sheared by eta."""
    matrix = shear_matrix(np.asarray(eta))
    return sigma**2 * matrix @ matrix


def ring(g, psf_covariances, *, n=16, length=0.4, flux=None):
    """Return Gaussian galaxies off the centre, in 90 degree pairs, lensed by g exactly."""
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    shapes = length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    shapes = shapes.reshape(2, n // 2, 2).swapaxes(0, 1).reshape(n, 2)  # pairs are neighbours
    lens = eta_from_reduced_shear(np.asarray(g)[None, :])
    centre = np.random.default_rng(2).uniform(-1.5, 1.5, (n, 2))
    flux = np.ones(n) if flux is None else flux
    return centre, np.stack(
        [
            gaussian_image(
                covariance_of(eta, 2.2) + psf_covariances[i % len(psf_covariances)],
                (SIDE, SIDE),
                centre=tuple(centre[i]),
                flux=flux[i],
            )
            for i, eta in enumerate(add_shears(lens, shapes))
        ]
    )


@pytest.mark.parametrize("angle", [0.0, 0.9, np.pi / 2, 4.0])
def test_the_shear_comes_back(angle, xp, dtype, to_xp):
    g = 0.05 * np.array([np.cos(angle), np.sin(angle)])
    _, stamps = ring(g, [PSF_COVARIANCE])
    psf = fx.Psf.from_image(to_xp(star(), dtype))
    estimate = fx.shear_from_stack(to_xp(stamps, dtype), psf)
    atol = 1e-8 if dtype == xp.float64 else 2e-5
    assert_close(estimate.g, to_xp(g, dtype), rtol=0, atol=atol, xp=xp)
    assert estimate.g_err.dtype == dtype
    assert (estimate.n_used, estimate.n_excluded, estimate.method) == (16, 0, "stack")


@pytest.mark.skip_backend("jax", reason="compiles anew for each shape")
def test_centroids_may_be_given(to_xp, to_np):
    centre, stamps = ring([0.03, -0.02], [PSF_COVARIANCE])
    psf = fx.Psf.from_image(to_xp(star()))
    estimate = fx.shear_from_stack(to_xp(stamps), psf, centroids=to_xp(centre + 0.5 * (SIDE - 1)))
    np.testing.assert_allclose(to_np(estimate.g), [0.03, -0.02], atol=1e-8)


@pytest.mark.skip_backend("jax", reason="compiles anew for each shape")
def test_every_galaxy_may_have_its_own_psf(to_xp, to_np):
    covariances = [
        gaussian_covariance((0.1, -0.06), 1.8),
        gaussian_covariance((-0.2, 0.1), 1.5),
        gaussian_covariance((0.0, 0.15), 2.0),
    ]
    _, stamps = ring([0.03, -0.02], covariances, n=18)
    images = np.stack([gaussian_image(covariances[i % 3], (SIDE, SIDE)) for i in range(18)])
    psf = fx.Psf.from_image(to_xp(images))
    estimate = fx.shear_from_stack(to_xp(stamps), psf, chunk_size=5)
    np.testing.assert_allclose(to_np(estimate.g), [0.03, -0.02], atol=1e-6)


@pytest.mark.parametrize("quarters", [1, 2])
def test_rotating_the_images_rotates_the_shear(quarters):
    _, stamps = ring([0.04, -0.02], [PSF_COVARIANCE], n=6)
    first = fx.shear_from_stack(stamps[:5], fx.Psf.from_image(star()))
    turned = np.ascontiguousarray(np.rot90(stamps[:5], quarters, axes=(-2, -1)))
    psf = np.ascontiguousarray(np.rot90(star(), quarters))
    second = fx.shear_from_stack(turned, fx.Psf.from_image(psf))
    np.testing.assert_allclose(second.g, (-1) ** quarters * first.g, atol=1e-9)
    np.testing.assert_allclose(second.g_err, first.g_err, rtol=1e-6)


def test_rotating_the_galaxies_by_45_degrees_exchanges_components():
    g = np.array([0.04, -0.02])
    turned_psf = gaussian_covariance((0.06, 0.1), 1.8)  # PSF_COVARIANCE, by 45 degrees
    _, first = ring(g, [PSF_COVARIANCE])
    _, second = ring([-g[1], g[0]], [turned_psf])
    a = fx.shear_from_stack(first, fx.Psf.from_image(star()))
    b = fx.shear_from_stack(second, fx.Psf.from_image(gaussian_image(turned_psf, (SIDE, SIDE))))
    np.testing.assert_allclose(b.g, [-a.g[1], a.g[0]], atol=1e-8)


@pytest.mark.skip_backend("jax", reason="compiles anew for each shape")
def test_chunks_change_nothing(to_xp, to_np):
    _, stamps = ring([0.03, -0.02], [PSF_COVARIANCE])
    psf = fx.Psf.from_image(to_xp(star()))
    whole = fx.shear_from_stack(to_xp(stamps), psf)
    parts = fx.shear_from_stack(to_xp(stamps), psf, chunk_size=3)
    np.testing.assert_allclose(to_np(parts.g), to_np(whole.g), atol=1e-11)
    np.testing.assert_allclose(to_np(parts.g_err), to_np(whole.g_err), rtol=1e-9)


def test_fluxes_count_unless_normalised():
    # The brighter of every pair has eta2 >= 0, and so has the mean.
    flux = np.where(np.arange(16) % 2 == 0, 5.0, 1.0)
    _, stamps = ring([0.03, -0.02], [PSF_COVARIANCE], flux=flux)
    psf = fx.Psf.from_image(star())
    bright = fx.shear_from_stack(stamps, psf)
    assert np.max(np.abs(bright.g - [0.03, -0.02])) > 1e-2
    for options in ({"normalise": True}, {"galaxy_weight": 1.0 / flux}):
        estimate = fx.shear_from_stack(stamps, psf, **options)
        np.testing.assert_allclose(estimate.g, [0.03, -0.02], atol=1e-6)


def test_the_error_is_the_scatter_of_samples():
    rng = np.random.default_rng(5)
    shapes = 0.3 * rng.normal(size=(400, 2))
    stamps = np.stack(
        [gaussian_image(covariance_of(e, 2.2) + PSF_COVARIANCE, (SIDE, SIDE)) for e in shapes]
    )
    psf = fx.Psf.from_image(star())
    middle = np.full((40, 2), 0.5 * (SIDE - 1))
    samples = [
        fx.shear_from_stack(stamps[i : i + 40], psf, centroids=middle) for i in range(0, 400, 40)
    ]
    scatter = np.std([s.g for s in samples], ddof=1)
    predicted = np.sqrt(np.mean([s.g_err**2 for s in samples]))
    # Twenty numbers fix the scatter to 16 %.
    assert predicted / scatter == pytest.approx(1.0, abs=0.4)
    mean = np.mean([np.linalg.norm(e) for e in distortion_from_eta(shapes)])
    assert predicted < mean / np.sqrt(40)


def through_pixels(g, jacobians):
    """Return the ring on the sky seen through a Jacobian for each galaxy, and its PSFs."""
    n = len(jacobians)
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    shapes = 0.4 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    lens = eta_from_reduced_shear(np.asarray(g)[None, :])
    stamps, stars = [], []
    for eta, jacobian in zip(add_shears(lens, shapes), jacobians, strict=True):
        back = np.linalg.inv(jacobian)
        galaxy = back @ (covariance_of(eta, 2.2) + PSF_COVARIANCE) @ back.T
        stamps.append(gaussian_image(galaxy, (SIDE, SIDE), centre=(0.4, -0.3)))
        stars.append(gaussian_image(back @ PSF_COVARIANCE @ back.T, (SIDE, SIDE)))
    return np.stack(stamps), np.stack(stars)


def test_every_galaxy_may_have_its_own_pixels(xp, dtype, to_xp, to_np):
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    kinds = [np.diag([-1.0, 1.0]), turn, np.array([[1.1, 0.1], [0.0, 0.95]])]
    jacobians = np.stack([kinds[i % 3] for i in range(12)])
    stamps, stars = through_pixels([0.03, -0.02], jacobians)
    psf = fx.Psf.from_image(to_xp(stars, dtype))
    estimate = fx.shear_from_stack(to_xp(stamps, dtype), psf, jacobian=to_xp(jacobians, dtype))
    assert estimate.g.dtype == dtype
    atol = 1e-6 if dtype == xp.float64 else 1e-4
    np.testing.assert_allclose(to_np(estimate.g), [0.03, -0.02], atol=atol)
    # Where it is not said how the pixels lie, there is no common shear.
    plain = fx.shear_from_stack(to_xp(stamps, dtype), psf)
    assert np.max(np.abs(to_np(plain.g) - [0.03, -0.02])) > 1e-2


def test_pixels_may_be_of_many_sizes():
    # In the unit of the largest, wave numbers behind the smallest go beyond pi.
    jacobians = np.stack([(0.7, 1.0, 1.65)[i % 3] * np.eye(2) for i in range(12)])
    stamps, stars = through_pixels([0.03, -0.02], jacobians)
    estimate = fx.shear_from_stack(stamps, fx.Psf.from_image(stars), jacobian=jacobians)
    np.testing.assert_allclose(estimate.g, [0.03, -0.02], atol=1e-5)
    null = fx.population_null(stamps, fx.Psf.from_image(stars), jacobian=jacobians, statistic="eta")
    np.testing.assert_allclose(null.g, [0.03, -0.02], atol=1e-5)


def test_a_bad_jacobian_is_left_out():
    jacobians = np.stack([np.eye(2)] * 16)
    stamps, stars = through_pixels([0.03, -0.02], jacobians)
    jacobians[[0, 8]] = [[[1.0, 1.0], [1.0, 1.0]], [[np.nan, 0.0], [0.0, 1.0]]]
    with pytest.warns(FdntWarning, match="2 of 16 stamps left out"):
        estimate = fx.shear_from_stack(stamps, fx.Psf.from_image(stars), jacobian=jacobians)
    assert (estimate.n_used, estimate.n_excluded) == (14, 2)
    np.testing.assert_allclose(estimate.g, [0.03, -0.02], atol=0.02)
    # Degrees among arcsec would make one unit of length for all of no use.
    jacobians = np.stack([np.eye(2)] * 16)
    jacobians[[0, 8]] /= 3600.0
    with pytest.warns(FdntWarning, match="2 of 16 stamps left out"):
        fx.shear_from_stack(stamps, fx.Psf.from_image(stars), jacobian=jacobians)
    jacobians[:] = 0.0
    with pytest.raises(FdntValueError, match="0 usable stamps in 0 groups"):
        fx.shear_from_stack(stamps, fx.Psf.from_image(stars), jacobian=jacobians)
    with pytest.raises(FdntValueError, match="the stack has no shape"):
        fx.shear_from_stack(-stamps, fx.Psf.from_image(stars), jacobian=np.stack([np.eye(2)] * 16))


def test_noisy_galaxies_stack_alike_as_images_and_as_tests():
    _, stamps = ring([0.03, -0.02], [PSF_COVARIANCE], n=64)
    noise = np.random.default_rng(4).standard_normal(stamps.shape)
    noisy = stamps + np.sqrt(np.sum(stamps[0] ** 2)) / 20.0 * noise
    psf = fx.Psf.from_image(star())
    images = fx.shear_from_stack(noisy, psf)
    tests = fx.shear_from_stack(noisy, psf, jacobian=np.stack([np.eye(2)] * 64))
    np.testing.assert_allclose(tests.g, images.g, atol=1e-7)
    np.testing.assert_allclose(tests.g_err, images.g_err, rtol=0.01)


# --- galaxies that are no ellipses ---------------------------------------------------


def test_a_bulge_off_the_centre_of_its_disc():
    # The torture of SPEC.md 5: its dipole follows the shear only where the weight does.
    galsim = pytest.importorskip("galsim")
    params = galsim.GSParams(folding_threshold=1e-3, stepk_minimum_hlr=15, kvalue_accuracy=1e-7)

    def sersic(flux, n, radius, e1, e2):
        profile = galsim.Sersic(n, half_light_radius=radius, flux=flux, gsparams=params)
        return profile.shear(e1=e1, e2=e2)

    def draw(profile):
        return profile.drawImage(nx=128, ny=128, scale=1.0, method="no_pixel", dtype=float).array

    galaxy = sersic(0.3, 4.0, 2.5, 0.1, 0.4).shift(4.0, 3.0) + sersic(0.7, 1.0, 9.0, 0.5, 0.0)
    psf = galsim.Gaussian(half_light_radius=2.0, gsparams=params).shear(
        e=0.14, beta=0.5 * galsim.radians
    )
    lens = galsim.Shear(g1=0.03, g2=-0.02)
    stamps = np.stack(
        [
            draw(
                galsim.Convolve(
                    [galaxy.rotate(a * galsim.degrees).shear(lens), psf], gsparams=params
                )
            )
            for a in np.arange(16) * 22.5
        ]
    )
    star_image = fx.Psf.from_image(draw(psf))
    estimate = fx.shear_from_stack(stamps, star_image)
    np.testing.assert_allclose(estimate.g, [0.03, -0.02], atol=1e-6)
    # What it takes: centroids that do not follow the shear are seen at once.
    shapes = fx.measure_shapes(stamps, star_image)
    off = fx.shear_from_stack(stamps, star_image, centroids=shapes.centroid)
    assert np.max(np.abs(off.g - [0.03, -0.02])) > 1e-4


# --- stamps and calls that cannot be used --------------------------------------------


@pytest.mark.skip_backend("jax", reason="compiles anew for each shape")
def test_bad_stamps_are_left_out_and_counted(to_xp, to_np):
    _, stamps = ring([0.03, -0.02], [PSF_COVARIANCE], n=20)
    bad = stamps.copy()
    bad[4, 3, 3] = np.nan
    bad[5] = 0.0
    psf = fx.Psf.from_image(to_xp(star()))
    with pytest.warns(FdntWarning, match="2 of 20 stamps left out"):
        estimate = fx.shear_from_stack(to_xp(bad), psf, n_groups=10)
    assert (estimate.n_used, estimate.n_excluded) == (18, 2)
    alone = fx.shear_from_stack(to_xp(np.delete(stamps, [4, 5], axis=0)), psf, n_groups=9)
    np.testing.assert_allclose(to_np(estimate.g), to_np(alone.g), atol=1e-10)
    # Without noise the errors are 1e-10, of which the rounding of g is more than a millionth.
    np.testing.assert_allclose(to_np(estimate.g_err), to_np(alone.g_err), rtol=1e-6, atol=1e-15)


def test_bad_psfs_and_centroids_and_fluxes_are_left_out():
    centre, stamps = ring([0.03, -0.02], [PSF_COVARIANCE])
    images = np.stack([star()] * 16)
    images[2:4] = np.nan
    with pytest.warns(FdntWarning, match="2 of 16"):
        estimate = fx.shear_from_stack(stamps, fx.Psf.from_image(images))
    np.testing.assert_allclose(estimate.g, [0.03, -0.02], atol=1e-3)
    centre[:2] = np.nan
    psf = fx.Psf.from_image(star())
    with pytest.warns(FdntWarning, match="2 of 16"):
        fx.shear_from_stack(stamps, psf, centroids=centre + 0.5 * (SIDE - 1))
    stamps[6:8] *= -1.0
    with pytest.warns(FdntWarning, match="2 of 16"):
        fx.shear_from_stack(stamps, psf, normalise=True)


def test_stacks_without_a_shape():
    _, stamps = ring([0.0, 0.0], [PSF_COVARIANCE])
    psf = fx.Psf.from_image(star())
    with pytest.raises(FdntValueError, match="the stack has no shape: "):
        fx.shear_from_stack(-stamps, psf)
    with pytest.raises(FdntValueError, match="1 usable stamps in 1 groups"):
        fx.shear_from_stack(stamps, psf, galaxy_weight=np.eye(16)[3])
    with pytest.raises(FdntValueError, match="stamps holds 1 galaxies"):
        fx.shear_from_stack(stamps[:1], psf)
    with pytest.raises(FdntValueError, match="stamps holds 0 galaxies"):
        fx.shear_from_stack(stamps[:0], psf)
    with pytest.raises(FdntValueError, match="0 usable stamps in 0 groups"):
        fx.shear_from_stack(np.full_like(stamps, np.nan), psf)


def test_bad_calls():
    _, stamps = ring([0.0, 0.0], [PSF_COVARIANCE])
    psf = fx.Psf.from_image(star())
    with pytest.raises(FdntTypeError, match="psf must be a Psf"):
        fx.shear_from_stack(stamps, star())
    with pytest.raises(ShapeMismatchError, match="centroids must have the shape"):
        fx.shear_from_stack(stamps, psf, centroids=np.zeros((3, 2)))
    with pytest.raises(ShapeMismatchError, match="galaxy_weight must have the shape"):
        fx.shear_from_stack(stamps, psf, galaxy_weight=np.ones(3))
    with pytest.raises(FdntValueError, match="not negative"):
        fx.shear_from_stack(stamps, psf, galaxy_weight=-np.ones(16))
    for name, bad in (("n_groups", 1), ("padding", 0), ("chunk_size", 0), ("n_groups", 2.5)):
        with pytest.raises(RangeError, match=name):
            fx.shear_from_stack(stamps, psf, **{name: bad})
