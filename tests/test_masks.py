"""Missing pixels: filled from the others where they are few, left out where they are not."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.errors import FdntTypeError, FdntValueError, NamespaceError, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.missing import fill_missing
from images import SHEAR, galaxies, ring, star
from tolerances import tolerance

E = np.array([[0.3, 0.1], [-0.2, 0.4], [0.0, 0.0]])


def random_mask(shape, fraction, seed=0):
    return np.random.default_rng(seed).uniform(size=shape) < fraction


@pytest.fixture
def psf(to_xp, dtype):
    return fx.Psf.from_image(to_xp(star(), dtype))


# --- the filling ---------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [0.005, 0.05])
def test_what_is_missing_comes_back(fraction, psf, xp, dtype, to_xp):
    images = galaxies(E)
    missing = random_mask(images.shape, fraction)
    spoilt = np.where(missing, 1e3, images)
    filled = fill_missing(to_xp(spoilt, dtype), to_xp(missing), psf)
    assert filled.dtype == dtype
    # A neighbour's mean, the usual remedy, is off by 5 % of the peak in the middle.
    atol = 2e-3 * float(np.max(images))
    assert_close(filled, to_xp(images, dtype), rtol=0, atol=atol, xp=xp)


def test_the_pixels_that_are_there_stay_as_they_are(psf, dtype, to_xp, to_np):
    images = galaxies(E)
    missing = random_mask(images.shape, 0.02)
    given = to_xp(images, dtype)
    filled = to_np(fill_missing(given, to_xp(missing), psf))
    np.testing.assert_array_equal(filled[~missing], to_np(given)[~missing])


def test_each_stamp_by_itself():
    images, psf = galaxies(E), fx.Psf.from_image(star())
    missing = random_mask(images.shape, 0.03)
    missing[2] = False
    together = fill_missing(images, missing, psf)
    np.testing.assert_array_equal(together[2], images[2])
    for i in range(2):
        alone = fill_missing(images[i : i + 1], missing[i : i + 1], psf)
        np.testing.assert_allclose(together[i], alone[0], rtol=0, atol=1e-13)
    stars = fx.Psf.from_image(np.stack([star()] * 3))
    np.testing.assert_allclose(fill_missing(images, missing, stars), together, atol=1e-13)
    assert fill_missing(images, np.zeros_like(missing), psf) is images


def test_it_is_linear():
    rng, psf = np.random.default_rng(3), fx.Psf.from_image(star())
    a, b = rng.standard_normal((2, 1, 48, 48))
    missing = random_mask(a.shape, 0.03)
    both = fill_missing(2.0 * a + b, missing, psf)
    apart = 2.0 * fill_missing(a, missing, psf) + fill_missing(b, missing, psf)
    np.testing.assert_allclose(both, apart, atol=1e-10)


def test_rectangles_and_oversampled_stars():
    images = galaxies(E, (40, 49))
    missing = random_mask(images.shape, 0.02)
    filled = fill_missing(images, missing, fx.Psf.from_image(star()))
    np.testing.assert_allclose(filled, images, atol=2e-3 * np.max(images))


# --- in the estimates ----------------------------------------------------------------


def holes(n, where):
    """Return masks of n stamps with holes in the given rows of the sample."""
    mask = np.zeros((n, 48, 48), dtype=bool)
    for row, pixels in where.items():
        mask[(row, *pixels)] = True
    return mask


MIDDLE = (slice(22, 24), 25)
COLUMN = (slice(None), 26)
CORNER = (slice(0, 8), slice(0, 8))


def test_stamps_with_holes_are_left_out(psf, xp, dtype, to_xp):
    images = np.concatenate([ring(SHEAR), ring(SHEAR)[:2]])
    mask = holes(10, {8: MIDDLE, 9: CORNER})
    images[mask] = np.nan
    estimate = fx.population_null(to_xp(images, dtype), psf, mask=to_xp(mask))
    assert_close(estimate.g, to_xp(SHEAR, dtype), **tolerance("nulls", dtype), xp=xp)
    assert (estimate.n_used, estimate.n_excluded) == (8, 2)
    assert (estimate.n_masked, estimate.n_filled) == (2, 0)


def test_small_holes_are_filled_and_large_ones_left_out(psf, xp, dtype, to_xp):
    images = ring(SHEAR, n=16)
    mask = holes(16, {0: MIDDLE, 3: CORNER, 8: COLUMN})
    mask[5:7] = random_mask((2, 48, 48), 0.02)
    spoilt = np.where(mask, np.nan, images)
    result = fx.measure_responses(to_xp(spoilt, dtype), psf, mask=to_xp(mask), masked="fill")
    clean = fx.measure_responses(to_xp(images, dtype), psf)
    flags = np.zeros(16, dtype=np.int32)
    flags[[0, 3, 5, 6]] = int(Flag.FILLED)
    flags[8] = int(Flag.MASKED)
    assert_close(result.flags, to_xp(flags), rtol=0, atol=0, xp=xp)
    rows = to_xp(np.delete(np.arange(16), 8))
    assert_close(result.take(rows).v, clean.take(rows).v, rtol=0, atol=1e-3, xp=xp)
    assert bool(xp.all(xp.isnan(result.v[8, :])))
    estimate = fx.population_null(
        to_xp(spoilt, dtype), psf, mask=to_xp(mask), masked="fill", chunk_size=5
    )
    assert (estimate.n_used, estimate.n_masked, estimate.n_filled) == (15, 1, 4)


def test_a_mask_of_nothing_changes_nothing():
    images, psf = ring(SHEAR), fx.Psf.from_image(star())
    plain = fx.population_null(images, psf)
    for masked in ("drop", "fill"):
        same = fx.population_null(images, psf, mask=holes(8, {}), masked=masked)
        np.testing.assert_array_equal(same.g, plain.g)
        assert (same.n_masked, same.n_filled) == (0, 0)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"mask": np.zeros((8, 48, 48))}, FdntTypeError, "mask must be boolean"),
        ({"mask": np.zeros((8, 4, 4), dtype=bool)}, ShapeMismatchError, "mask must have the shape"),
        ({"masked": "ignore"}, FdntValueError, 'masked must be "drop" or "fill"'),
        ({"mask": [[[True]]]}, FdntTypeError, "mask must be an array"),
    ],
)
def test_what_is_no_mask(options, error, message):
    with pytest.raises(error, match=message):
        fx.population_null(ring(SHEAR), fx.Psf.from_image(star()), **options)


def test_a_mask_of_another_library():
    torch = pytest.importorskip("torch")
    mask = torch.zeros((8, 48, 48), dtype=torch.bool)
    with pytest.raises(NamespaceError, match="mask is a torch array but stamps"):
        fx.population_null(ring(SHEAR), fx.Psf.from_image(star()), mask=mask)
