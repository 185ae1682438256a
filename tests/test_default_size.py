"""The default size of the frozen weight: that of the galaxies, within bounds, on every library."""

from __future__ import annotations

import numpy as np
import pytest

import fdnt_xp as fx
from fdnt_xp.shears.sample import default_size
from images import galaxies, star

VARIANCE = 1e-8  # S/N about 1000 for galaxies of flux 1


def sample(sigma, n=12):
    return galaxies(np.random.default_rng(4).normal(0.0, 0.2, (n, 2)), sigma=sigma)


@pytest.fixture
def psf(to_xp, dtype):
    return fx.Psf.from_image(to_xp(star(), dtype))


@pytest.mark.parametrize("sigma", [1.6, 2.2])
def test_it_follows_the_galaxies(sigma, psf, to_xp, dtype):
    stamps = to_xp(sample(sigma), dtype)
    # Under a weight that were a Gaussian the size would be exact.
    assert default_size(stamps, psf, noise_variance=VARIANCE) == pytest.approx(
        1.15 * sigma, rel=0.05
    )


@pytest.mark.parametrize(("sigma", "side"), [(0.2, 48), (4.0, 32)])
def test_it_stays_in_bounds(sigma, side):
    psf = fx.Psf.from_image(star((side, side)))
    shapes = np.zeros((3, 2))
    size = default_size(galaxies(shapes, (side, side), sigma=sigma), psf, noise_variance=VARIANCE)
    expected = 3.0 / psf.largest_kmax if sigma < 1.0 else side / 16.0
    assert size == pytest.approx(expected)


def test_lost_galaxies_have_no_say():
    stamps, psf = sample(2.0), fx.Psf.from_image(star())
    broken = np.concatenate([np.full((40, 48, 48), np.nan), stamps])
    options = {"noise_variance": VARIANCE}
    assert default_size(broken, psf, **options) == default_size(stamps, psf, **options)


def test_without_noise_or_galaxies_it_is_that_of_the_psf():
    stamps, psf = sample(2.0), fx.Psf.from_image(star())
    expected = pytest.approx(4.5 / psf.largest_kmax)
    assert default_size(stamps, psf) == expected
    assert default_size(np.full_like(stamps, np.nan), psf, noise_variance=VARIANCE) == expected
    assert default_size(stamps[:0], psf, noise_variance=VARIANCE) == expected


def test_it_is_what_the_estimators_take():
    rng = np.random.default_rng(1)
    stamps, psf = sample(2.2, n=64), fx.Psf.from_image(star())
    stamps = stamps + 5e-3 * rng.standard_normal(stamps.shape)
    noise = {"noise_variance": 2.5e-5}
    size = default_size(stamps, psf, **noise)
    null, given = (fx.population_null(stamps, psf, **noise, size=s) for s in (None, size))
    np.testing.assert_array_equal(null.g, given.g)
    size = default_size(stamps, psf, **noise, max_shear=0.01)
    own, given = (fx.measure_responses(stamps, psf, **noise, size=s) for s in (None, size))
    np.testing.assert_array_equal(own.v, given.v)


def test_it_makes_the_errors_of_large_galaxies_smaller():
    rng = np.random.default_rng(2)
    stamps, psf = sample(3.0, n=256), fx.Psf.from_image(star())
    stamps = stamps + 3e-3 * rng.standard_normal(stamps.shape)
    noise = {"noise_variance": 9e-6}
    own, of_psf = (
        fx.population_null(stamps, psf, **noise, size=size)
        for size in (None, 4.5 / psf.largest_kmax)
    )
    assert np.all(own.g_err_noise < 0.97 * of_psf.g_err_noise)
