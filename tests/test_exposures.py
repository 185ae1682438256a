"""Many exposures of each object: one shape, one centroid, whatever the exposures are like.

Gaussians sampled at pixel centres, as in `test_sky`, and GalSim's drawings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import galsim
import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.arrays import to_numpy
from fdnt_xp.errors import (
    FdntError,
    FdntTypeError,
    FdntValueError,
    NamespaceError,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.flags import Flag, flag_names
from fdnt_xp.fourier.transform import deconvolve
from fdnt_xp.nulltests.exposures import ExposureTests
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.exposure_stamps import check_exposures
from fdnt_xp.shapes.job import prepare
from fdnt_xp.shear import shear_matrix
from images import eta_of, galaxies, gaussian_covariance, gaussian_image, star
from tolerances import tolerance

SCALE = 0.25


def turn(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s], [s, c]])


MIRROR = np.diag([-1.0, 1.0])
JACOBIANS = SCALE * np.stack(
    [np.eye(2), turn(40.0), turn(-70.0) @ MIRROR @ [[1.05, 0.1], [0.0, 0.94]], np.diag([1.1, 0.9])]
)
"""The pixels as they are, turned, all of it, not square."""
PSFS = [
    gaussian_covariance(e, SCALE * sigma)
    for e, sigma in (((0.1, -0.06), 1.8), ((-0.1, 0.1), 2.2), ((0, 0.15), 1.6), ((0.02, -0.1), 2.4))
]
E = np.array([[0.3, -0.2], [0.0, 0.0], [-0.5, 0.4], [0.1, 0.05]])
OFFSETS = np.array([[0.12, -0.07], [0.0, 0.2], [-0.3, 0.1], [0.05, 0.05]])
NOISE = 1e-8


@dataclass
class Drawn:
    """Four objects with four exposures each, object by object, as NumPy arrays."""

    stamps: np.ndarray
    stars: np.ndarray
    origin: np.ndarray
    jacobian: np.ndarray
    object_index: np.ndarray
    psf_index: np.ndarray

    def measured(self, rows=slice(None), **options):
        """Measure some of the stamps, with other arguments where they are given."""
        psf = fx.Psf.from_image(self.stars, psf_index=self.psf_index[rows])
        given = {
            "object_index": self.object_index[rows],
            "origin": self.origin[rows],
            "jacobian": self.jacobian[rows],
            "noise_variance": NOISE,
        }
        stamps = options.pop("stamps", self.stamps[rows])
        return fx.measure_exposures(stamps, options.pop("psf", psf), **(given | options))


def drawn_objects(covariances, offsets, shape=(56, 56), seed=1):
    """Draw the objects with these covariances on the sky through all PSFs, with dithers."""
    rng = np.random.default_rng(seed)
    stamps, origins = [], []
    inverse = np.linalg.inv(JACOBIANS)
    for covariance, offset in zip(covariances, offsets, strict=True):
        for inv, psf in zip(inverse, PSFS, strict=True):
            dither = rng.uniform(-2.0, 2.0, 2)
            seen = inv @ (covariance + psf) @ inv.T
            stamps.append(gaussian_image(seen, shape, centre=tuple(inv @ offset + dither)))
            origins.append(0.5 * (np.array(shape[::-1]) - 1.0) + dither)
    n = len(covariances)
    return Drawn(
        stamps=np.stack(stamps),
        stars=np.stack(
            [gaussian_image(i @ p @ i.T, (56, 56)) for i, p in zip(inverse, PSFS, strict=True)]
        ),
        origin=np.stack(origins),
        jacobian=np.tile(JACOBIANS, (n, 1, 1)),
        object_index=np.repeat(np.arange(n), 4),
        psf_index=np.tile(np.arange(4), n),
    )


@pytest.fixture(scope="module")
def drawn():
    return drawn_objects([gaussian_covariance(tuple(e), 2.4 * SCALE) for e in E], OFFSETS)


@pytest.fixture(scope="module")
def reference(drawn):
    return drawn.measured()


def names(flags):
    return [flag_names(int(flag)) for flag in to_numpy(flags)]


SAME = ("eta", "eta_cov", "eg", "sky_offset", "size", "flux", "snr")


def assert_same(result, expected, rtol=1e-9):
    for name in SAME:
        one, other = getattr(result, name), getattr(expected, name)
        np.testing.assert_allclose(one, other, rtol=rtol, atol=rtol, err_msg=name)


def assert_found_alike(result, expected):
    """One root, found by two searches; the rest is that of a point 1e-6 or so off it."""
    for name, rtol, atol in (
        ("eta", 1e-8, 1e-9),
        ("centroid", 1e-8, 0.0),
        ("eg", 0.0, 1e-5),
        ("eta_cov", 1e-4, 1e-13),
        ("size", 1e-5, 0.0),
        ("flux", 1e-5, 0.0),
        ("snr", 1e-5, 0.0),
    ):
        one, other = getattr(result, name), getattr(expected, name)
        np.testing.assert_allclose(one, other, rtol=rtol, atol=atol, err_msg=name)


# --- one exposure ---------------------------------------------------------------------


@pytest.mark.parametrize("noise", ["variance", "ivar", "none"])
def test_one_exposure_is_measure_shapes(noise):
    rng = np.random.default_rng(3)
    e = np.array([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.45], [0.05, -0.95]])
    stamps = galaxies(e, centres=np.array([[0.0, 0.0], [0.4, -0.3], [-2.2, 1.7], [0.5, 0.5]]))
    stamps = stamps + 1e-4 * rng.standard_normal(stamps.shape)
    options = {
        "variance": {"noise_variance": 1e-8},
        "ivar": {"ivar": np.full_like(stamps, 1e8)},
        "none": {},
    }[noise]
    psf = fx.Psf.from_image(star())
    alone = fx.measure_shapes(stamps, psf, **options)
    shapes = fx.measure_exposures(stamps, psf, object_index=np.arange(4), **options)
    assert_found_alike(shapes, alone)
    assert names(shapes.flags) == names(alone.flags)
    assert names(alone.flags)[3] == ["FINE_GRID"]
    np.testing.assert_allclose(shapes.sky_offset, alone.centroid - 23.5, atol=1e-9)


def test_one_exposure_on_the_sky_is_measure_shapes(drawn):
    alone = fx.measure_shapes(
        drawn.stamps,
        fx.Psf.from_image(drawn.stars, psf_index=drawn.psf_index),
        jacobian=drawn.jacobian,
        noise_variance=NOISE,
    )
    shapes = drawn.measured(object_index=np.arange(16))
    assert_found_alike(shapes, alone)


# --- the truth ------------------------------------------------------------------------


def test_common_shape_and_centroid(drawn, xp, dtype, to_xp):
    shapes = fx.measure_exposures(
        to_xp(drawn.stamps, dtype),
        fx.Psf.from_image(to_xp(drawn.stars, dtype), psf_index=to_xp(drawn.psf_index)),
        object_index=to_xp(drawn.object_index),
        origin=to_xp(drawn.origin, dtype),
        jacobian=to_xp(drawn.jacobian, dtype),
        noise_variance=NOISE,
        band=to_xp(drawn.psf_index),
    )
    assert_close(shapes.e, to_xp(E, dtype), **tolerance("shapes", dtype), xp=xp)
    offsets = to_xp(OFFSETS, dtype)
    assert_close(shapes.sky_offset, offsets, **tolerance("centroids", dtype), xp=xp)
    size = 2.4 * SCALE * (1.0 - np.sum(E**2, axis=1)) ** 0.25
    assert_close(shapes.size, to_xp(size, dtype), **tolerance("sizes", dtype), xp=xp)
    ones = to_xp(np.ones((4, 4)), dtype)
    assert_close(shapes.band_flux, ones, **tolerance("sizes", dtype), xp=xp)
    assert to_numpy(shapes.n_used).tolist() == [4] * 4
    assert shapes.stamp_flags.dtype == shapes.n_exposures.dtype == xp.int32


def test_libraries_agree(drawn, reference, to_xp):
    shapes = fx.measure_exposures(
        to_xp(drawn.stamps),
        fx.Psf.from_image(to_xp(drawn.stars), psf_index=to_xp(drawn.psf_index)),
        object_index=to_xp(drawn.object_index),
        origin=to_xp(drawn.origin),
        jacobian=to_xp(drawn.jacobian),
        noise_variance=NOISE,
    ).to_numpy()
    assert_same(shapes, reference)
    np.testing.assert_allclose(shapes.stamp_snr, reference.stamp_snr, rtol=1e-6)


def test_galsim_through_four_wcs():
    # Elliptical isophotes, so that the shape is that of the shear, behind any PSF.
    params = galsim.GSParams(folding_threshold=1e-4, maxk_threshold=1e-4, kvalue_accuracy=1e-6)
    galaxy = galsim.Exponential(half_light_radius=0.7, gsparams=params)
    galaxy = galaxy.shear(e1=0.3, e2=-0.2).shift(0.1, -0.06)
    stamps, stars, origins = [], [], []
    dithers = [(0.3, -0.2), (-1.4, 0.6), (2.2, 1.1), (0.0, -0.5)]
    psfs = [
        galsim.Gaussian(fwhm=0.9).shear(g1=0.05, g2=0.02),
        galsim.Moffat(beta=3.5, fwhm=1.1).shear(g1=-0.03, g2=0.04),
        galsim.Gaussian(fwhm=1.2),
        galsim.Moffat(beta=3.0, fwhm=0.8).shear(g1=0.0, g2=-0.06),
    ]
    for jacobian, psf, dither in zip(JACOBIANS, psfs, dithers, strict=True):
        wcs = galsim.JacobianWCS(*jacobian.ravel())
        psf = psf.withGSParams(params)
        image = galsim.Convolve(galaxy, psf, gsparams=params).drawImage(
            nx=95, ny=95, wcs=wcs, offset=dither, dtype=float
        )
        stamps.append(image.array)
        stars.append(psf.drawImage(nx=95, ny=95, wcs=wcs, dtype=float).array)
        origins.append(47.0 + np.array(dither))
    shapes = fx.measure_exposures(
        np.stack(stamps),
        fx.Psf.from_image(np.stack(stars)),
        object_index=np.zeros(4, dtype=np.int64),
        origin=np.stack(origins),
        jacobian=JACOBIANS,
    )
    np.testing.assert_allclose(shapes.e[0], [0.3, -0.2], rtol=0, atol=1e-5)
    np.testing.assert_allclose(shapes.sky_offset[0], [0.1, -0.06], rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def rings():
    """Return rings of galaxies with a gradient: a bulge of e = 0.05 in a disc of e = 0.3."""
    lens, parts = shear_matrix(eta_of((0.03, -0.02))), []
    for e, sigma, flux in ((0.05, 1.6, 0.3), (0.3, 3.0, 0.7)):
        shapes = []
        for angle in 0.1 + np.pi * np.arange(8) / 8:
            eta = np.arctanh(e) * np.array([np.cos(2 * angle), np.sin(2 * angle)])
            matrix = lens @ shear_matrix(eta)
            shapes.append((SCALE * sigma) ** 2 * matrix @ matrix.T)
        parts.append((flux, drawn_objects(shapes, np.tile(OFFSETS, (2, 1)))))
    (bulge, one), (disc, other) = parts
    other.stamps = bulge * one.stamps + disc * other.stamps
    return other


def test_ring_through_four_exposures(rings):
    # One exposure leaves 1e-4 of the shear by the third order of EG; so do four.
    biases = [
        np.abs(fx.shear_from_shapes(rings.measured(rows)).g / [0.03, -0.02] - 1.0)
        for rows in (slice(0, None, 4), slice(None))
    ]
    assert np.max(biases[0]) < 2e-4
    assert np.max(biases[1]) < 2e-4


def test_slopes_of_the_sums(drawn):
    given = check_exposures(
        np,
        drawn.stamps,
        object_index=drawn.object_index,
        n_objects=None,
        origin=drawn.origin,
        jacobian=drawn.jacobian,
        noise_variance=None,
        ivar=None,
        band=None,
    )
    psf = given.seen_by(fx.Psf.from_image(drawn.stars, psf_index=drawn.psf_index))
    job = prepare(np, drawn.stamps, psf, padding=1).take(np.arange(16))
    (batch,) = given.batches(16)
    factor = np.linspace(0.5, 2.0, 16)
    factor[5] = 0.0
    tests = ExposureTests(
        stamps=NullTests(
            grid=job.coarse,
            galaxies=deconvolve(drawn.stamps, job.psf.inverse_transfer(job.coarse), job.coarse),
            weight=job.weight,
            length=job.length,
        ),
        exposures=replace(batch.exposures, factor=factor, share=factor),
    )
    x = np.random.default_rng(5).uniform(-0.2, 0.2, (4, 4))
    _, jac = tests.evaluate(x)
    for j, step in enumerate(1e-5 * np.eye(4)):
        difference = (tests.evaluate(x + step)[0] - tests.evaluate(x - step)[0]) / 2e-5
        np.testing.assert_allclose(jac[:, :, j], difference, **tolerance("test slopes", "float64"))
    some = tests.take(np.array([2, 1]))
    np.testing.assert_allclose(some.evaluate(x[[2, 1]])[1], jac[[2, 1]], rtol=1e-12)


# --- noise ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def noisy():
    """Return a galaxy in four exposures 600 times, S/N 50, 100, 50 and 25, and without noise."""
    clean = drawn_objects([gaussian_covariance((0.2, -0.1), 2.4 * SCALE)], OFFSETS[:1], (40, 40))
    signal = np.sqrt(np.sum(clean.stamps**2, axis=(1, 2)))
    sigma = signal / np.array([50.0, 100.0, 50.0, 25.0])
    n = 600
    rng = np.random.default_rng(11)
    noise = rng.standard_normal((n, 4, 40, 40)) * sigma[:, None, None]
    many = Drawn(
        stamps=(clean.stamps + noise).reshape(-1, 40, 40),
        stars=clean.stars,
        origin=np.tile(clean.origin, (n, 1)),
        jacobian=np.tile(clean.jacobian, (n, 1, 1)),
        object_index=np.repeat(np.arange(n), 4),
        psf_index=np.tile(np.arange(4), n),
    )
    return many, np.tile(sigma**2, n), clean.stamps


def test_scatter_is_that_of_the_covariance(noisy):
    many, variance, clean = noisy
    shapes = many.measured(noise_variance=variance)
    assert bool(np.all(shapes.measured))
    eta = np.arctanh(np.hypot(0.2, 0.1)) * np.array([0.2, -0.1]) / np.hypot(0.2, 0.1)
    expected = np.sqrt(np.mean(shapes.eta_cov[:, [0, 1], [0, 1]], axis=0))
    # A standard deviation of 600 is known to 3 %, a mean to 4 % of it.
    scatter = np.sqrt(np.mean((shapes.eta - eta) ** 2, axis=0))
    np.testing.assert_allclose(scatter, expected, rtol=0.09)
    np.testing.assert_allclose(np.mean(shapes.eta, axis=0), eta, atol=4 * 0.04 * expected[0])
    # As good as the mean of single shapes with the weights that are best for it.
    alone = many.measured(
        slice(0, 4), stamps=clean, object_index=np.arange(4), noise_variance=variance[:4]
    )
    best = 1.0 / np.sum(1.0 / alone.eta_cov[:, [0, 1], [0, 1]], axis=0)
    np.testing.assert_allclose(expected**2, best, rtol=0.05)


def test_errors_go_with_the_root_of_the_exposures(drawn):
    same = np.zeros(16, dtype=np.int64)
    options = {
        "jacobian": None,
        "psf": fx.Psf.from_image(drawn.stars[0]),
        "origin": drawn.origin[same],
    }
    many = drawn.measured(stamps=drawn.stamps[same], object_index=same, **options)
    one = drawn.measured(slice(0, 1), **(options | {"origin": drawn.origin[:1]}))
    # The noise of a common size is left out; it moves no test of an ellipse but by rounding.
    np.testing.assert_allclose(16.0 * many.eta_cov, one.eta_cov, rtol=1e-6)
    np.testing.assert_allclose(many.snr, 4.0 * one.snr, rtol=1e-9)
    np.testing.assert_allclose(many.flux, one.flux, rtol=1e-9)


def test_faint_exposures_are_worth_one_deep():
    # 36 of S/N 8 and one of S/N 48, on average. Were each exposure's size its own, 1.3.
    psf = gaussian_covariance((0.0, 0.1), 1.8)
    stamp = gaussian_image(gaussian_covariance((0.3, 0.0), 2.4) + psf, (40, 40))
    sigma = np.sqrt(np.sum(stamp**2)) / 8.0
    noise = sigma * np.random.default_rng(4).standard_normal((40 * 36, 40, 40))
    star_ = fx.Psf.from_image(gaussian_image(psf, (40, 40)))
    faint = fx.measure_exposures(
        stamp + noise, star_, object_index=np.repeat(np.arange(40), 36), noise_variance=sigma**2
    )
    deep = fx.measure_shapes(stamp[None], star_, noise_variance=sigma**2 / 36)
    assert bool(np.all(faint.measured))
    ratio = np.median(faint.eta_cov[:, [0, 1], [0, 1]], axis=0) / deep.eta_cov[0, [0, 1], [0, 1]]
    assert np.all(np.abs(np.sqrt(ratio) - 1.0) < 0.08)


def test_the_same_exposure_twice_is_that_exposure(rings):
    rows = np.repeat(np.arange(8), 2)
    options = {"jacobian": JACOBIANS[2]}
    psf = fx.Psf.from_image(rings.stars[2])
    one = rings.measured(np.arange(2, 32, 4), psf=psf, **options)
    two = rings.measured(np.repeat(np.arange(2, 32, 4), 2), psf=psf, object_index=rows, **options)
    for name in ("eta", "eg", "size", "sky_offset"):
        np.testing.assert_allclose(getattr(two, name), getattr(one, name), atol=1e-11)
    # The noise of the size is left out, of a galaxy with a gradient.
    cov = one.eta_cov[:, [0, 1], [0, 1]]
    np.testing.assert_allclose(2.0 * two.eta_cov[:, [0, 1], [0, 1]], cov, rtol=0.02)


def test_units_of_an_exposure_do_not_matter(drawn, reference):
    scale = np.tile([1.0, 1e-6, 30.0, 1e4], 4)
    shapes = drawn.measured(
        stamps=drawn.stamps * scale[:, None, None], noise_variance=NOISE * scale**2
    )
    for name in ("eta", "eta_cov", "sky_offset", "size"):
        np.testing.assert_allclose(
            getattr(shapes, name), getattr(reference, name), rtol=1e-8, atol=1e-12
        )
    np.testing.assert_allclose(shapes.stamp_snr, reference.stamp_snr, rtol=1e-8)


def test_ivar_is_the_inverse_of_the_variance(drawn, reference):
    shapes = drawn.measured(noise_variance=None, ivar=np.full_like(drawn.stamps, 1.0 / NOISE))
    assert_same(shapes, reference, rtol=1e-7)
    np.testing.assert_allclose(shapes.stamp_snr, reference.stamp_snr, rtol=1e-7)


def test_without_noise_there_are_no_errors(drawn, reference):
    shapes = drawn.measured(noise_variance=None)
    np.testing.assert_allclose(shapes.eta, reference.eta, atol=1e-12)
    for values in (shapes.eta_cov, shapes.snr, shapes.stamp_snr):
        assert np.all(np.isnan(values))


def test_bands(drawn, reference):
    band = np.tile([0, 2, 0, 2], 4)
    colour = np.where(band == 2, 3.0, 1.0)
    shapes = drawn.measured(stamps=drawn.stamps * colour[:, None, None], band=band)
    np.testing.assert_allclose(shapes.band_flux[:, 0], 1.0, rtol=1e-6)
    np.testing.assert_allclose(shapes.band_flux[:, 2], 3.0, rtol=1e-6)
    assert np.all(np.isnan(shapes.band_flux[:, 1]) & np.isnan(shapes.band_snr[:, 1]))
    total = np.sqrt(np.nansum(shapes.band_snr**2, axis=1))
    np.testing.assert_allclose(shapes.snr, total, rtol=1e-12)
    one = drawn.measured(band=np.zeros(16, dtype=np.int64))
    np.testing.assert_allclose(one.band_snr[:, 0], reference.snr, rtol=1e-9)


# --- exposures that fail --------------------------------------------------------------


def broken(drawn):
    """Return arguments with one bad exposure of each kind, their rows, and the reasons."""
    stamps, jacobian, origin = (
        array.copy() for array in (drawn.stamps, drawn.jacobian, drawn.origin)
    )
    variance = np.full(16, NOISE)
    stars = np.concatenate([drawn.stars, np.full((1, 56, 56), np.nan)])
    which = drawn.psf_index.copy()
    stamps[0, 3, 3] = np.nan
    jacobian[5] = [[1.0, 2.0], [2.0, 4.0]]
    origin[6] = [-3.0, 20.0]
    variance[9] = np.nan
    which[10] = 4
    stamps[12] = 7.0
    stamps[13] *= -1.0
    reasons = {
        0: "NON_FINITE_PIXEL",
        5: "BAD_JACOBIAN",
        6: "OFF_IMAGE",
        9: "BAD_NOISE",
        10: "BAD_PSF",
        12: "NO_SIGNAL",
        13: "NO_SIGNAL",
    }
    options = {
        "stamps": stamps,
        "jacobian": jacobian,
        "origin": origin,
        "noise_variance": variance,
        "psf": fx.Psf.from_image(stars, psf_index=which),
    }
    return options, reasons


def test_exposures_that_fail_are_recorded_and_change_nothing(drawn):
    options, reasons = broken(drawn)
    shapes = drawn.measured(**options)
    assert names(shapes.stamp_flags) == [[reasons[i]] if i in reasons else [] for i in range(16)]
    good = np.array([i for i in range(16) if i not in reasons])
    assert shapes.stamp_used.tolist() == [i in good for i in range(16)]
    assert shapes.n_used.tolist() == [3, 2, 2, 2]
    assert shapes.n_exposures.tolist() == [4] * 4
    without = drawn.measured(good)
    assert_same(shapes, without)
    np.testing.assert_allclose(shapes.centroid, without.centroid, atol=1e-9)
    np.testing.assert_allclose(shapes.e, E, atol=2e-6)


def test_objects_without_exposures_and_with_bad_ones_only(drawn, reference):
    index = drawn.object_index.copy()
    index[index == 2] = 5
    stamps = drawn.stamps.copy()
    stamps[4:8] = np.inf
    shapes = drawn.measured(stamps=stamps, object_index=index, n_objects=8)
    empty = ["NO_EXPOSURE"]
    assert names(shapes.flags) == [[], empty, empty, [], empty, [], empty, empty]
    assert shapes.n_exposures.tolist() == [4, 4, 0, 4, 0, 4, 0, 0]
    assert shapes.n_used.tolist() == [4, 0, 0, 4, 0, 4, 0, 0]
    assert np.all(np.isnan(shapes.eta[~shapes.measured]))
    assert np.all(np.isnan(shapes.sky_offset[~shapes.measured]))
    assert np.all(np.isnan(shapes.centroid[~shapes.measured]))
    np.testing.assert_allclose(shapes.eta[[0, 5, 3]], reference.eta[[0, 2, 3]], atol=1e-12)


def test_no_stamps_at_all():
    psf = fx.Psf.from_image(star())
    stamps, index = np.zeros((0, 48, 48)), np.zeros(0, dtype=np.int64)
    band = index
    shapes = fx.measure_exposures(stamps, psf, object_index=index, n_objects=3, band=band)
    assert names(shapes.flags) == [["NO_EXPOSURE"]] * 3
    assert fx.measure_exposures(stamps, psf, object_index=index).n_gal == 0


def test_an_object_that_is_not_there_fails_alone(drawn, reference):
    rng = np.random.default_rng(2)
    stamps = drawn.stamps.copy()
    stamps[4:8] = 1e-4 * rng.standard_normal((4, 56, 56))
    shapes = drawn.measured(stamps=stamps)
    assert shapes.flags[1] != 0
    kept = [0, 2, 3]
    np.testing.assert_allclose(shapes.eta[kept], reference.eta[kept], atol=1e-12)


# --- missing pixels -------------------------------------------------------------------


def test_smaller_stamps_are_padded(drawn):
    # A quarter of each stamp is no pixels at all: the galaxies end before.
    small = drawn_objects(
        [gaussian_covariance(tuple(e), 2.0 * SCALE) for e in E], OFFSETS, (46, 50)
    )
    stamps, ivar = np.full((16, 56, 56), np.nan), np.zeros((16, 56, 56))
    place = small.origin + np.array([2.0, 5.0])
    middle = np.rint(small.origin - [24.5, 22.5]).astype(int)
    for i, (dx, dy) in enumerate(middle):
        # Cut around the object, as such stamps are.
        whole = np.pad(small.stamps[i], 4)
        rows, columns = slice(4 + dy, 4 + dy + 46), slice(4 + dx, 4 + dx + 50)
        stamps[i, 5:51, 2:52] = whole[rows, columns]
        ivar[i, 5:51, 2:52] = 1.0 / NOISE
        place[i] -= [dx, dy]
    options = {"noise_variance": None, "ivar": ivar, "stamps": stamps, "origin": place}
    shapes = small.measured(**options)
    assert names(shapes.stamp_flags) == [[]] * 16
    np.testing.assert_allclose(shapes.e, E, atol=2e-5)
    assert np.all(shapes.masked_fraction == 0)
    # With the object elsewhere in it, the rectangle was cut by an edge.
    place[3] += [3.0, 0.0]
    assert names(small.measured(**options).stamp_flags)[3] == ["MASKED"]


def test_missing_pixels_are_left_out_or_filled(drawn, reference):
    ivar = np.full_like(drawn.stamps, 1.0 / NOISE)
    stamps = drawn.stamps.copy()
    for i in (1, 7, 15):
        ivar[i, 20:23, 30:32] = 0.0
        stamps[i, 20:23, 30:32] = np.nan
    options = {"noise_variance": None, "ivar": ivar, "stamps": stamps}
    without = drawn.measured(**options)
    assert [i for i, one in enumerate(names(without.stamp_flags)) if one == ["MASKED"]] == [
        1,
        7,
        15,
    ]
    np.testing.assert_allclose(without.masked_fraction[0], 6.0 / 4 / 56**2)
    filled = drawn.measured(transform="hybrid", **options)
    assert filled.n_used.tolist() == [4] * 4
    assert names(filled.flags) == [["FILLED"], ["FILLED"], [], ["FILLED"]]
    np.testing.assert_allclose(filled.e, E, atol=1e-4)
    # What is filled has noise of its own, but less than what is left out.
    assert np.all(filled.eta_cov[:, 0, 0] < without.eta_cov[:, 0, 0] + 1e-15)
    assert np.all(filled.eta_cov[:, 0, 0] > 0.99 * reference.eta_cov[:, 0, 0])


# --- any order, any chunk -------------------------------------------------------------


@pytest.mark.parametrize("chunk_size", [None, 1, 5])
def test_any_order_and_any_chunk(drawn, chunk_size):
    # 1, 2, 3 and 4 exposures of the objects, shuffled.
    rows = np.array([11, 4, 0, 14, 8, 12, 5, 15, 9, 13])
    expected = drawn.measured(np.sort(rows))
    shapes = drawn.measured(rows, chunk_size=chunk_size)
    assert shapes.n_exposures.tolist() == [1, 2, 3, 4]
    assert_same(shapes, expected)
    np.testing.assert_allclose(shapes.stamp_snr, expected.stamp_snr[np.argsort(np.argsort(rows))])
    first = [rows.tolist().index(i) for i in (0, 4, 11, 14)]
    centroid = (
        drawn.origin[rows[first]]
        + np.linalg.solve(drawn.jacobian[rows[first]], shapes.sky_offset[:, :, None])[:, :, 0]
    )
    np.testing.assert_allclose(shapes.centroid, centroid, atol=1e-9)


def test_elongated_objects_get_the_fine_grid_with_their_exposures(drawn):
    e = np.array([[0.1, 0.2], [0.93, 0.0], [-0.3, 0.1]])
    long = drawn_objects(
        [gaussian_covariance(tuple(one), 4.5 * SCALE) for one in e], OFFSETS[:3], (96, 96)
    )
    ivar = np.full_like(long.stamps, 1.0 / NOISE)
    ivar[6, 50:52, 44] = 0.0
    shapes = long.measured(noise_variance=None, ivar=ivar, transform="hybrid", chunk_size=12)
    assert names(shapes.flags) == [[], ["FINE_GRID", "FILLED"], []]
    np.testing.assert_allclose(shapes.e, e, atol=1e-4)


def test_a_fixed_size_is_one_on_the_sky(drawn):
    shapes = drawn.measured(size=2.0 * SCALE)
    np.testing.assert_allclose(shapes.size, 2.0 * SCALE, rtol=1e-12)
    np.testing.assert_allclose(shapes.e, E, atol=2e-6)
    assert names(shapes.flags) == [["SIZE_FIXED"]] * 4


# --- the result -----------------------------------------------------------------------


def test_objects_are_taken_with_their_stamps(drawn, to_xp, to_np):
    shapes = fx.measure_exposures(
        to_xp(drawn.stamps[:7]),
        fx.Psf.from_image(to_xp(drawn.stars[:1])),
        object_index=to_xp(np.array([2, 0, 1, 2, 0, 0, 3])),
        noise_variance=NOISE,
    )
    some = shapes.take(to_xp(np.array([2, 0])))
    assert type(some) is fx.ExposureResult
    assert to_np(some.object_index).tolist() == [0, 0, 1, 1, 1]
    assert to_np(some.n_exposures).tolist() == [2, 3]
    snr = to_np(shapes.stamp_snr)
    np.testing.assert_array_equal(to_np(some.stamp_snr), snr[[0, 3, 1, 4, 5]])
    np.testing.assert_array_equal(to_np(some.eta), to_np(shapes.eta)[[2, 0]])
    both = fx.ExposureResult.concat([some, shapes])
    assert to_np(both.object_index).tolist() == [0, 0, 1, 1, 1, 4, 2, 3, 4, 2, 2, 5]
    assert both.n_gal == 6
    assert isinstance(both.to_numpy().stamp_flags, np.ndarray)


def test_table(drawn):
    table = drawn.measured(band=drawn.psf_index // 2).to_table()
    assert {"eta1", "u", "v", "n_exposures", "n_used", "flux_0", "snr_1"} <= set(table.colnames)
    assert not {"x", "y"} & set(table.colnames)
    assert all(table[name].description for name in table.colnames)


# --- bad calls ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"object_index": np.zeros(15, dtype=int)}, ShapeMismatchError, "object_index must have"),
        ({"object_index": np.zeros(16)}, FdntTypeError, "whole numbers"),
        ({"object_index": np.arange(16) - 1}, FdntValueError, "must not be negative"),
        ({"n_objects": 3}, FdntValueError, "n_objects is 3"),
        ({"n_objects": -1}, RangeError, "n_objects"),
        ({"origin": np.zeros((16, 3))}, ShapeMismatchError, r"origin must have the shape \(16, 2"),
        ({"origin": np.zeros((16, 2), dtype="f4")}, NamespaceError, "origin has dtype"),
        ({"jacobian": np.zeros((2, 2))}, FdntValueError, "singular"),
        ({"jacobian": np.ones((3, 2, 2))}, ShapeMismatchError, "jacobian must have"),
        ({"jacobian": np.ones((16, 2, 2), dtype="f4")}, NamespaceError, "jacobian has dtype"),
        ({"ivar": np.ones((16, 56, 56))}, FdntValueError, "cannot both"),
        ({"ivar": np.ones((16, 56)), "noise_variance": None}, ShapeMismatchError, "ivar must"),
        ({"noise_variance": np.ones(3)}, ShapeMismatchError, "noise_variance must"),
        ({"noise_variance": -1.0}, RangeError, "noise_variance"),
        ({"band": np.zeros(16)}, FdntTypeError, "band must hold whole numbers"),
        ({"band": np.zeros((16, 1), dtype=int)}, ShapeMismatchError, "band must have"),
        ({"band": np.full(16, 10**9)}, RangeError, "band = 1e.09 is outside"),
        ({"object_index": np.arange(16) + 10**12}, FdntValueError, "it counts objects from 0"),
        ({"transform": "gl"}, FdntValueError, "no transform 'gl'"),
        ({"transform": "hybrid", "order": 99}, FdntError, "order"),
        ({"chunk_size": 0}, RangeError, "chunk_size"),
        ({"size": 0.0}, RangeError, "size"),
        ({"max_iter": -1}, RangeError, "max_iter"),
        ({"psf": "star"}, FdntTypeError, "psf must be a Psf"),
        ({"psf": fx.Psf.from_image(np.stack([star()] * 3))}, ShapeMismatchError, "16 stamps"),
    ],
)
def test_bad_calls_say_what_is_wrong(drawn, options, error, text):
    with pytest.raises(error, match=text):
        drawn.measured(**options)


def test_flags_are_known():
    assert flag_names(int(Flag.NO_EXPOSURE | Flag.BAD_NOISE)) == ["NO_EXPOSURE", "BAD_NOISE"]
